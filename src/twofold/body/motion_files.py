"""Motions from files and by name: which formats there are, and how each becomes a motion of a given body.

A new format is a row of `READERS` (a file ending) or of `LAYOUTS` (names of arrays in an npz).
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import torch

from twofold.body.builtin_motions import BUILTIN_MOTIONS
from twofold.body.bvh import read_bvh
from twofold.body.bvh_retarget import retarget
from twofold.body.motion import Motion, as_single, resampled, started_at_origin
from twofold.body.skeleton import Body, ShapedBody
from twofold.body.smpl_motions import LAYOUTS, read_smpl_motion
from twofold.errors import TwofoldError
from twofold.inputs import is_there, shown_path

__all__ = ["LAYOUTS", "READERS", "MotionOptions", "MotionRead", "read_motion"]


@dataclass(frozen=True)
class MotionOptions:
    """What a user may say about a motion.

    Attributes:
        fps: wanted frames per second; None keeps the file's.
        up: axis that points up in the file, "y" or "z"; None finds it.
        units: of the file's lengths, "m" or "cm"; None finds or assumes it.
        start_at_origin: shift the motion over the floor so that it begins at x = 0, z = 0.
    """

    fps: float | None = None
    up: str | None = None
    units: str | None = None
    start_at_origin: bool = False


@dataclass(frozen=True)
class MotionRead:
    """A motion of the requested body (y up), and what was found in its file.

    Attributes:
        motion: ready to be played.
        format: such as "AMASS SMPL+H".
        frames: in the file.
        fps: of the file.
        up: axis that points up in the file.
        units: of the file's lengths, in words.
        notes: sentences about what was assumed or done.
    """

    motion: Motion
    format: str
    frames: int
    fps: float
    up: str
    units: str
    notes: tuple[str, ...] = ()

    def lines(self) -> list[str]:
        """The report: one fact a line."""
        seconds = (self.frames - 1) / self.fps
        return [
            f"format: {self.format}",
            f"frames: {self.frames} at {self.fps:.4g} fps ({seconds:.2f} s)",
            f"up axis: {self.up}",
            f"units: {self.units}",
            *(f"note: {note}" for note in self.notes),
        ]


BVH_UNITS: dict[str, tuple[float, str]] = {
    "m": (1.0, "metres"),
    "cm": (0.01, "centimetres"),
    "CMU": (0.0254 / 0.45, "CMU units (inches / 0.45)"),
    "in": (0.0254, "inches"),
    "mm": (0.001, "millimetres"),
}
"""Metres per unit, and its name. The one in which the legs are most like a person's is taken."""

_LEG, _LEGS = 0.82, (0.25, 1.4)
"""Thigh and shin of an adult, and what a person's may measure, metres."""


def _read_bvh_motion(path: Path, body: ShapedBody, model: Body | None, options: MotionOptions) -> MotionRead:
    bvh = read_bvh(path)
    result = retarget(bvh, body, path, options.up)
    scale, units = BVH_UNITS[options.units or min(BVH_UNITS, key=lambda u: _unlikely(BVH_UNITS[u][0] * result.leg))]
    leg = result.leg * scale
    if not _LEGS[0] <= leg <= _LEGS[1]:
        given = f"--units {options.units}" if options.units else "any unit that BVH files come in"
        raise TwofoldError(
            f"With {given}, the legs (thigh and shin) of the skeleton in {path} are {leg:.3g} m long, expected about "
            "0.8 m; correct --units or scale the skeleton."
        )
    notes = [f"legs of {leg:.2f} m; rest pose: {result.reference}"]
    notes.append(f"limbs point as in the file within {result.error:.1f} degrees")
    return MotionRead(result.motion, "BVH", len(bvh.values), bvh.fps, result.up, units, tuple(notes))


def _unlikely(leg: float) -> float:
    return max(leg / _LEG, _LEG / leg)


def _read_npz_motion(path: Path, body: ShapedBody, model: Body | None, options: MotionOptions) -> MotionRead:
    found = read_smpl_motion(path, body, model, options.up, options.units)
    return MotionRead(found.motion, found.layout, found.frames, found.motion.fps, found.up, found.units, found.notes)


READERS: dict[str, Callable[[Path, ShapedBody, Body | None, MotionOptions], MotionRead]] = {
    ".bvh": _read_bvh_motion,
    ".npz": _read_npz_motion,
}
"""Which function reads which file ending."""

_REFUSED: dict[str, str] = {
    **dict.fromkeys((".pkl", ".pickle", ".joblib"), "is a pickle, which may run any code when it is opened"),
    **dict.fromkeys((".pt", ".pth"), "is a PyTorch file, a pickle, which may run any code when it is opened"),
    ".npy": "is a single array without a frame rate or translations",
    **dict.fromkeys((".fbx", ".glb", ".gltf", ".amc", ".c3d", ".usd"), "is of a format that is not read"),
}
_ADVICE = (
    "save its arrays in a program that you trust, "
    "np.savez('motion.npz', poses=..., trans=..., fps=...) with poses (T, 72) in radians and trans (T, 3) in metres"
)


def read_motion(
    source: Path | str, body: ShapedBody, options: MotionOptions | None = None, model: Body | None = None
) -> MotionRead:
    """A motion of a body, from a file (see `READERS`) or by the name of a built-in one (see `BUILTIN_MOTIONS`).

    Args:
        source: file, or a name such as "walk".
        body: who is to move, in the T-pose.
        options: what the user says about the file.
        model: the body model; where it is SMPL, a file's betas tell how long the legs were that moved.

    Raises:
        TwofoldError: there is neither such a file nor such a motion, or the file is not as it should be.
    """
    options = options or MotionOptions()
    path, name = Path(source), str(source)
    if name in BUILTIN_MOTIONS and not _is_file(path):
        made = as_single(BUILTIN_MOTIONS[name](body))
        read = MotionRead(made, f"built-in motion {name!r}", len(made), made.fps, "y", "metres")
    else:
        read = _reader(path)(path, body, model, options)
    motion = as_single(read.motion)
    if options.fps is not None:
        motion = resampled(motion, options.fps)
    if options.start_at_origin:
        motion = started_at_origin(motion, body.joints)
    if not (torch.isfinite(motion.poses).all() and torch.isfinite(motion.translations).all()):
        raise TwofoldError(f"The motion in {path} cannot be brought onto the body: its skeleton is degenerate.")
    return replace(read, motion=motion)


def _reader(path: Path) -> Callable[[Path, ShapedBody, Body | None, MotionOptions], MotionRead]:
    ending = path.suffix.lower()
    if ending in READERS and _is_file(path):
        return READERS[ending]
    known = ", ".join(BUILTIN_MOTIONS)
    if not is_there(path) or path.is_dir():
        what = "is a folder" if is_there(path) else "is neither a file nor a built-in motion"
        raise TwofoldError(f"{shown_path(path)} {what}; name a {' or '.join(READERS)} file, or one of {known}.")
    reason = _REFUSED.get(ending, "is of a format that is not read")
    advice = (
        "convert it to BVH, in Blender say" if ending in (".fbx", ".glb", ".gltf", ".amc", ".c3d", ".usd") else _ADVICE
    )
    raise TwofoldError(f"{path} {reason}, expected {' or '.join(READERS)}; {advice}.")


def _is_file(path: Path) -> bool:
    return is_there(path) and path.is_file()
