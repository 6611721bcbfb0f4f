"""`twofold export`: the files of an avatar, and a record of what is in them."""

import importlib.util
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch

from twofold.body.motion import Motion
from twofold.capture.coverage import coverage_of
from twofold.capture.types import Capture
from twofold.errors import TwofoldError, install_command
from twofold.files import plain_errors, write_json
from twofold.methods.base import Avatar
from twofold.outputs.export.animations import WEIGHED, capture_clip, grounded, motion_clip, turned, upright
from twofold.outputs.export.bake import BakeConfig, Progress
from twofold.outputs.export.bake_cache import BakeCache
from twofold.outputs.export.character import Animation, Character
from twofold.outputs.export.formats import EXPORTERS
from twofold.outputs.export.make import Baked, bake, frame_at, still
from twofold.outputs.export.options import ExportOptions

RECORD = "export.json"


@dataclass(frozen=True)
class ExportRequest:
    """What is to be exported.

    Attributes:
        formats: keys of `EXPORTERS`.
        config: of the character.
        color: "full", "base" or a frame's index; see `bake`.
        frame: a frame in whose pose a mesh without a rig is written; None for the rigged character.
        capture_motion: whether the capture's own motion is among the clips.
        motions: further motions.
        options: of the files.
    """

    formats: tuple[str, ...] = ("glb",)
    config: BakeConfig = BakeConfig()
    color: str | int = "full"
    frame: int | None = None
    capture_motion: bool = True
    motions: tuple[Motion, ...] = ()
    options: ExportOptions = ExportOptions()


def require_exportable(request: ExportRequest, capture: Capture) -> None:
    """Refuses, before anything is baked, what would fail afterwards.

    Raises:
        TwofoldError: formats and options exclude each other, a frame does not exist, or a package is missing.
    """
    for name in request.formats:
        holds = EXPORTERS[name].holds
        if request.frame is not None and holds == "rig":
            raise TwofoldError(
                f"--frame writes a mesh without a rig, which {name} files need; leave --frame or {name}."
            )
        if name == "bvh" and not request.capture_motion and not request.motions:
            raise TwofoldError("A bvh file holds a motion; leave --motion none out, or name a motion.")
    for frame in (request.frame, request.color):
        if isinstance(frame, int):
            frame_at(capture, frame)
    require_packages(request.config)


@torch.no_grad()
def require_surface(avatar: Avatar) -> None:
    """Refuses methods with a level of canonical space that do not answer for it, by the sentence of what they lack."""
    if avatar.level_space == "posed":
        return
    posed = avatar.pose(torch.zeros(24, 3), torch.zeros(3))
    x, matrix = avatar.to_canonical(posed.body.vertices[:1], posed)
    avatar.query(x, posed, matrix)


def require_packages(config: BakeConfig) -> None:
    """Refuses to bake without the packages for it.

    Raises:
        TwofoldError: names those that are missing.
    """
    if missing := missing_packages(config):
        raise TwofoldError(f"Baking a mesh needs {' and '.join(missing)}; run {install_command('export')}.")


def missing_packages(config: BakeConfig) -> list[str]:
    """Packages of the extra `export` that baking needs and that are not installed."""
    needed = ["fast_simplification", *(["xatlas"] if config.texture else [])]
    return [name.replace("_", "-") for name in needed if importlib.util.find_spec(name) is None]


def export(
    avatar: Avatar,
    capture: Capture,
    folder: Path,
    request: ExportRequest,
    progress: Progress = lambda _done, _note: None,
    cache: BakeCache | None = None,
) -> list[Path]:
    """Writes an avatar's files into a folder, and `export.json`, which says what is in them.

    Args:
        avatar: trained.
        capture: that it was trained on.
        folder: for the files.
        request: what is to be written.
        progress: called with the fraction that is done and what comes next.
        cache: of the run that `avatar` was loaded from (`open_cache`).

    Raises:
        TwofoldError: see `require_exportable`; the avatar has no surface; the disk refuses.
    """
    require_exportable(request, capture)
    require_surface(avatar)
    start = time.monotonic()
    options = request.options
    baked = bake(
        avatar, capture, request.config, request.color, options.name,
        lambda done, note: progress(0.85 * done, note), cache,
    )  # fmt: skip
    seconds = time.monotonic() - start
    character = baked.character
    stem = "avatar" if request.frame is None else f"avatar_{request.frame:04d}"
    if request.frame is not None:
        rotation = upright(capture)
        character = still(baked, request.frame, lambda x: x @ rotation.T.to(x))
    elif any(EXPORTERS[name].holds != "mesh" for name in request.formats):
        progress(0.88, "motions")
        clips = clips_of(baked, request.capture_motion, request.motions)
        character = replace(character, clips=tuple(clips))
    progress(0.95, "files")
    written = write_character(baked, character, folder, request.formats, options, stem, seconds)
    progress(1.0, "")
    return written


def write_character(
    baked: Baked, character: Character, folder: Path, formats: Sequence[str], options: ExportOptions,
    stem: str = "avatar", seconds: float | None = None,
) -> list[Path]:  # fmt: skip
    """Writes a character's files into a folder, and `export.json`.

    Args:
        baked: that it came from.
        character: with its clips, or a still mesh.
        folder: made where it is missing.
        formats: keys of `EXPORTERS`.
        options: of the files.
        stem: of their names.
        seconds: that the bake took, for the record.

    Raises:
        TwofoldError: the disk refuses.
    """
    with plain_errors(folder):
        folder.mkdir(parents=True, exist_ok=True)
    written: list[Path] = []
    for name in formats:
        own = standing(character) if EXPORTERS[name].holds == "mesh" and character.rigged else character
        EXPORTERS[name].write(own, folder / f"{stem}.{name}", options)
        written.append(folder / f"{stem}.{name}")
    write_json(folder / RECORD, record(baked, character, written, seconds))
    return written


def clips_of(baked: Baked, capture_motion: bool, motions: Sequence[Motion], weighed: int = WEIGHED) -> list[Animation]:
    """The clips of a character, upright and on the ground.

    Args:
        baked: from `bake`.
        capture_motion: whether the capture's own motion comes first.
        motions: further motions.
        weighed: frames of each motion, besides those that the targets were fitted to, for which the targets' weights
            are worked out.
    """
    character, pelvis = baked.character, baked.character.joints[0]
    clips: list[Animation] = []
    if capture_motion:
        own = capture_clip(baked, weighed=weighed)
        clips.append(grounded(turned(own, upright(baked.capture), pelvis), character))
    for motion in motions:
        clips.append(grounded(motion_clip(baked, motion, weighed), character))
    return clips


def standing(character: Character) -> Character:
    """The mesh in the rest pose without its rig, soles at y = 0."""
    lifted = character.vertices - np.array([0, character.ground, 0], dtype=character.vertices.dtype)
    return replace(character, vertices=lifted, targets=character.targets[:0], clips=(), rigged=False)


def record(baked: Baked, character: Character, written: Sequence[Path], seconds: float | None) -> dict[str, object]:
    """What an export holds and how good it is, for `export.json` and the report."""
    return {
        "files": {path.name: path.stat().st_size for path in written},
        "triangles": len(character.faces),
        "vertices": len(character.vertices),
        "watertight": baked.shape.watertight,
        "morph_targets": len(character.targets),
        "morph_errors_mm": baked.shape.errors,
        "texture": 0 if character.texture is None else len(character.texture),
        "lit": character.lit,
        "clips": {clip.name: len(clip.times) for clip in character.clips},
        "coverage": coverage_of(baked.capture).share,
        "bake_seconds": None if seconds is None else round(seconds, 1),
        "about": {
            "morph_errors_mm": "RMS distance from the full surface of each frame pulled back through the skinning; "
            "targets fitted without every fifth frame, which are the left-out ones",
            "coverage": "share of the body's surface that training images show well",
        },
    }
