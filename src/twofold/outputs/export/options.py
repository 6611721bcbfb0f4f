"""Options of every exporter."""

from dataclasses import dataclass
from typing import Literal

from twofold.outputs.export.rig import RigNames


@dataclass(frozen=True)
class ExportOptions:
    """How a character is written.

    Attributes:
        rig: whose names the joints have.
        name: of the person, in the file's metadata.
        author: who made it, in the file's metadata.
        image: how textures are stored inside a file; lossless or small.
        morph_normals: normals change with the morph targets, too.
    """

    rig: RigNames = "smpl"
    name: str = "avatar"
    author: str = "unknown"
    image: Literal["png", "jpeg"] = "png"
    morph_normals: bool = True
