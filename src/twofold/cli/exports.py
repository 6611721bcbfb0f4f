"""`twofold export`: an avatar as files for other programs."""

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from twofold.cli.console import bar, say, tell, within
from twofold.errors import TwofoldError

if TYPE_CHECKING:
    from twofold.body.motion import Motion
    from twofold.capture.types import Capture
    from twofold.methods.base import Avatar

Formats = Literal["glb", "vrm", "ply", "obj", "bvh"]


def export(
    run: Annotated[Path, tyro.conf.Positional],
    format: tuple[Formats, ...] = ("glb",),
    out: Path | None = None,
    faces: int = 40_000,
    frame: int | None = None,
    motion: tuple[str, ...] = ("capture",),
    branch: Literal["full", "base"] = "full",
    color: str = "full",
    lit: bool = False,
    texture: int = 2048,
    vertex_colors: bool = False,
    image: Literal["png", "jpeg"] = "png",
    morphs: int = 16,
    rig: Literal["smpl", "mixamo", "vrm"] = "smpl",
    name: str = "avatar",
    author: str = "unknown",
    capture: Path | None = None,
    device: str = "auto",
) -> None:
    """Write an avatar as files for other programs: a rigged character, a mesh, a motion.

    Args:
        run: Run folder.
        format: One or several of glb, vrm, ply, obj, bvh.
        out: Folder for the files; by default RUN/exports.
        faces: Number of triangles, roughly, 500 to 2,000,000.
        frame: Write the mesh as it stands in this frame of the capture, without a rig.
        motion: Animations of the character: capture, none, .bvh or .npz files, walk, turn, dance, range-of-motion.
        branch: Surface of the full field, or of the base branch.
        color: full (mean over training poses), base (base branch), or pose:N (the full field in the pose of frame N).
        lit: Keep the capture's light in the colours, where the method could leave it out.
        texture: Rows and columns of the texture, 64 to 8192.
        vertex_colors: Colours at the vertices instead of a texture.
        image: Textures inside the files: png (lossless) or jpeg (small).
        morphs: Largest number of morph targets, 0 to 16.
        rig: Names of the joints.
        name: Of the person, for the files' metadata.
        author: Who made it, for the files' metadata.
        capture: Capture folder, if it has moved since training.
        device: auto, cpu, cuda or cuda:N.
    """
    from twofold.capture.folder import read_capture
    from twofold.outputs.export.bake import BakeConfig
    from twofold.outputs.export.bake_cache import open_cache
    from twofold.outputs.export.options import ExportOptions
    from twofold.outputs.export.write import ExportRequest, require_exportable
    from twofold.outputs.export.write import export as write
    from twofold.training.run import choose_device, find_capture, load, read_recipe, require_same

    within(faces=(faces, 500, 2_000_000), texture=(texture, 64, 8192), morphs=(morphs, 0, 16))
    read_recipe(run)
    where, read = choose_device(device), read_capture(find_capture(run, capture))
    require_same(run, read, motion=True)
    request = ExportRequest(
        tuple(dict.fromkeys(format)),
        BakeConfig(faces, branch, morphs, texture=0 if vertex_colors else texture, lit=lit),
        _color(color), frame, "capture" in motion, options=ExportOptions(rig, name, author, image),
    )  # fmt: skip
    avatar, _ = load(run, where)
    request = replace(request, motions=_motions(avatar, [word for word in motion if word not in _OWN], read))
    require_exportable(request, read)
    folder = out or run / "exports"
    with bar("Exporting") as progress:
        written = write(avatar, read, folder, request, progress, open_cache(run, read, tell))
    names = ", ".join(path.name for path in written)
    say(f"{names} in {folder}.", "open it in Blender, three.js or a game engine; see docs/export.md")


_OWN = ("capture", "none")


def _motions(avatar: "Avatar", words: list[str], capture: "Capture") -> "tuple[Motion, ...]":
    from twofold.body.motion_files import MotionOptions, read_motion
    from twofold.outputs.motion_video import rest_body

    body = rest_body(avatar)
    return tuple(read_motion(word, body, MotionOptions(), capture.body).motion for word in words)


def _color(word: str) -> str | int:
    kind, _, number = word.partition(":")
    if kind == "pose" and number.isdigit():
        return int(number)
    if word not in ("full", "base"):
        raise TwofoldError(f"--color should be full, base or pose:N with the number of a frame; it is {word}.")
    return word
