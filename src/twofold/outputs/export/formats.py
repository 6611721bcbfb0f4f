"""The file formats of `twofold export`: one module each, one line each here."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from twofold.outputs.export.bvh import write_bvh
from twofold.outputs.export.character import Character
from twofold.outputs.export.gltf import write_glb
from twofold.outputs.export.options import ExportOptions
from twofold.outputs.export.ply_obj import write_obj, write_ply
from twofold.outputs.export.vrm import write_vrm


@dataclass(frozen=True)
class Exporter:
    """A file format.

    Attributes:
        write: writes a character to a path.
        holds: "mesh" for the surface in one pose, "rig" for a character that needs its skeleton, "either".
        texture: whether an image is part of it.
    """

    write: Callable[[Character, Path, ExportOptions], None]
    holds: str
    texture: bool


EXPORTERS: dict[str, Exporter] = {
    "glb": Exporter(write_glb, "either", True),
    "vrm": Exporter(write_vrm, "rig", True),
    "ply": Exporter(write_ply, "mesh", False),
    "obj": Exporter(write_obj, "mesh", True),
    "bvh": Exporter(write_bvh, "rig", False),
}
"""By the name that `--format` takes, which is the file's ending, too."""
