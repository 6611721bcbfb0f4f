"""BVH: the skeleton and one motion, without the surface."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation, Slerp

from twofold.body.skeleton import JOINT_NAMES, PARENTS
from twofold.errors import TwofoldError
from twofold.files import write_bytes
from twofold.outputs.export.character import Animation, Character
from twofold.outputs.export.options import ExportOptions
from twofold.outputs.export.rig import joint_names

CENTIMETRES = 100.0
_ENDS = {"head": (0.0, 0.18, 0.0), "left_hand": (0.08, 0.0, 0.0), "right_hand": (-0.08, 0.0, 0.0)}
_TOES = (0.0, 0.0, 0.06)
_ROTATIONS = "Zrotation Xrotation Yrotation"


def write_bvh(character: Character, path: Path, options: ExportOptions) -> None:
    """Writes the first clip of a character as BVH, centimetres, y up, T-pose offsets, rotations in the order Z X Y.

    Frames are evenly spaced in a BVH, so a clip that lacks some is interpolated there.

    Raises:
        TwofoldError: the character has no clip, or the file cannot be written.
    """
    if not character.clips:
        raise TwofoldError("A BVH holds a motion, and none was chosen; leave --motion out, or name one.")
    clip = evenly_spaced(character.clips[0])
    lines = ["HIERARCHY", *_hierarchy(character, joint_names(options.rig)), "MOTION", f"Frames: {len(clip.times)}"]
    lines.append(f"Frame Time: {_spacing(clip):.7f}")
    lines += [" ".join(f"{number:.5f}" for number in row) for row in channels(character, clip)]
    write_bytes(path, ("\n".join(lines) + "\n").encode())


def evenly_spaced(clip: Animation) -> Animation:
    """The clip at its smallest frame distance throughout; rotations by slerp, translations linear."""
    if len(clip.times) < 3 or np.allclose(np.diff(clip.times), clip.times[1] - clip.times[0], rtol=1e-3):
        return clip
    step = float(np.diff(clip.times).min())
    count = round((float(clip.times[-1]) - float(clip.times[0])) / step) + 1
    times = np.minimum(clip.times[0] + step * np.arange(count), clip.times[-1])
    turned = [Slerp(clip.times, Rotation.from_rotvec(clip.poses[:, j]))(times).as_rotvec() for j in range(24)]
    places = [np.interp(times, clip.times, clip.translations[:, axis]) for axis in range(3)]
    dtype = clip.poses.dtype
    return Animation(
        clip.name, times.astype(clip.times.dtype), np.stack(turned, 1).astype(dtype), np.stack(places, 1).astype(dtype)
    )


def channels(character: Character, clip: Animation) -> Iterator[list[float]]:
    """The numbers of each frame: position of the pelvis (cm), then Euler angles (degrees), joint by joint as listed."""
    order = list(_depth_first(0))
    pelvis = CENTIMETRES * (clip.translations + character.joints[0])
    rotations = Rotation.from_rotvec(clip.poses[:, order].reshape(-1, 3)).as_euler("ZXY", degrees=True)
    for place, angles in zip(pelvis, rotations.reshape(len(pelvis), -1), strict=True):
        yield [*place.tolist(), *angles.tolist()]


def _spacing(clip: Animation) -> float:
    return float(clip.times[1] - clip.times[0]) if len(clip.times) > 1 else 1 / 30


def _depth_first(joint: int) -> Iterator[int]:
    yield joint
    for child, parent in enumerate(PARENTS):
        if parent == joint:
            yield from _depth_first(child)


def _hierarchy(character: Character, names: tuple[str, ...], joint: int = 0, depth: int = 0) -> Iterator[str]:
    indent = "\t" * depth
    parent = PARENTS[joint]
    offset = character.joints[joint] - character.joints[parent] if parent >= 0 else character.joints[joint]
    yield f"{indent}{'JOINT' if parent >= 0 else 'ROOT'} {names[joint]}"
    yield f"{indent}{{"
    yield f"{indent}\tOFFSET {_row(offset)}"
    where = "" if parent >= 0 else "Xposition Yposition Zposition "
    yield f"{indent}\tCHANNELS {3 if parent >= 0 else 6} {where}{_ROTATIONS}"
    children = [child for child, above in enumerate(PARENTS) if above == joint]
    for child in children:
        yield from _hierarchy(character, names, child, depth + 1)
    if not children:
        end = np.array(_ENDS.get(JOINT_NAMES[joint], _TOES))
        yield from (f"{indent}\tEnd Site", f"{indent}\t{{", f"{indent}\t\tOFFSET {_row(end)}", f"{indent}\t}}")
    yield f"{indent}}}"


def _row(metres: Float[np.ndarray, "3"]) -> str:
    return " ".join(f"{CENTIMETRES * number:.5f}" for number in metres.tolist())
