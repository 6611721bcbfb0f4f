"""BVH files: a skeleton, and for every frame the numbers of its channels. Reading, forward kinematics, writing.

Local rotations are products of the elementary rotations in the order in which the channels are listed, per joint;
position channels take the place of a joint's offset. The format knows neither unit nor up axis nor rest pose.
"""

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from twofold.body.motion import Motion, joint_frames
from twofold.body.skeleton import JOINT_NAMES, PARENTS
from twofold.errors import TwofoldError
from twofold.files import write_bytes
from twofold.geometry.rotations import axis_angle_to_matrix
from twofold.inputs import read_bytes, shown

CHANNELS = ("Xposition", "Yposition", "Zposition", "Xrotation", "Yrotation", "Zrotation")
MAX_BYTES = 2**29
"""Of a file: half an hour of fingers and all at 120 frames a second has 400 MB."""
_LARGEST = 1e7
"""No angle in degrees and no length in any unit is larger."""
_ENDS = {10: (0.0, -0.01, 0.07), 11: (0.0, -0.01, 0.07), 15: (0.0, 0.15, 0.0), 22: (0.08, 0.0, 0.0), 23: (-0.08, 0, 0)}
"""How far the last bones reach, metres: a skeleton of joints does not tell."""


@dataclass(frozen=True)
class BvhJoint:
    """A joint, or an end site (whose name ends in " end" and which has no channels).

    Attributes:
        name: as in the file.
        parent: index of its parent, -1 for a root.
        offset: from the parent, in the file's unit.
        channels: of `CHANNELS`, in the file's order.
    """

    name: str
    parent: int
    offset: tuple[float, float, float]
    channels: tuple[str, ...]


@dataclass(frozen=True)
class Bvh:
    """A BVH file: joints in the file's order (parents first), and one row of channel values for each frame."""

    joints: tuple[BvhJoint, ...]
    values: Float[Tensor, "T C"]
    fps: float


def read_bvh(path: Path | str) -> Bvh:
    """A BVH file as it is: nothing is renamed, scaled or turned.

    Raises:
        TwofoldError: it is missing, no BVH, cut short, or holds something that is no finite number; names the line.
    """
    path = Path(path)
    text = read_bytes(path, MAX_BYTES).decode("utf-8", errors="replace")
    parts = re.split(r"^\s*MOTION\b", text, maxsplit=1, flags=re.MULTILINE | re.IGNORECASE)
    if not re.match(r"\s*HIERARCHY\b", parts[0], re.IGNORECASE) or len(parts) != 2:
        raise TwofoldError(f"{path} is no BVH file: it should have a HIERARCHY and a MOTION section; export it again.")
    joints = _hierarchy(parts[0], path)
    return _with_frames(joints, parts[1], path)


def _hierarchy(text: str, path: Path) -> tuple[BvhJoint, ...]:
    words = [
        (word, number)
        for number, line in enumerate(text.splitlines(), 1)
        for word in line.replace("{", " { ").replace("}", " } ").split()
    ]
    joints: list[BvhJoint] = []
    open_joints: list[int] = []
    i = 1
    while i < len(words):
        word, line = words[i]
        kind = word.lower()
        if kind in ("root", "joint", "end"):
            brace = next((k for k in range(i, len(words)) if words[k][0] == "{"), len(words))
            parent = open_joints[-1] if open_joints else -1
            name = " ".join(w for w, _ in words[i + 1 : brace])
            name = f"{joints[parent].name} end" if kind == "end" and parent >= 0 else name
            joints.append(BvhJoint(name, parent, (0.0, 0.0, 0.0), ()))
            open_joints.append(len(joints) - 1)
            i = brace + 1
        elif kind == "offset" and open_joints:
            numbers = [_number(w, path, n) for w, n in words[i + 1 : i + 4]]
            if len(numbers) != 3:
                raise TwofoldError(f"{path} ends within an OFFSET at line {line}; it is cut short, export it again.")
            joint = joints[open_joints[-1]]
            offset = (numbers[0], numbers[1], numbers[2])
            joints[open_joints[-1]] = BvhJoint(joint.name, joint.parent, offset, joint.channels)
            i += 4
        elif kind == "channels" and open_joints:
            count = int(_number(words[i + 1][0], path, line)) if i + 1 < len(words) else -1
            if count not in range(len(CHANNELS) + 1):
                raise TwofoldError(
                    f"{path}, line {line}: a joint has 0 to 6 CHANNELS, it says {count}; export it again."
                )
            joint = joints[open_joints[-1]]
            channels = tuple(_channel(w, path, n) for w, n in words[i + 2 : i + 2 + count])
            joints[open_joints[-1]] = BvhJoint(joint.name, joint.parent, joint.offset, channels)
            i += 2 + count
        elif kind == "}" and open_joints:
            open_joints.pop()
            i += 1
        else:
            raise TwofoldError(
                f"{path}, line {line}: expected ROOT, JOINT, End Site, OFFSET, CHANNELS or a brace, it says "
                f"{shown(word)}; export the file again."
            )
    if open_joints or not joints:
        raise TwofoldError(f"The HIERARCHY of {path} is not complete: a brace is never closed; export it again.")
    return tuple(joints)


def _number(word: str, path: Path, line: int) -> float:
    try:
        value = float(word)
    except ValueError:
        value = math.nan
    if not abs(value) <= _LARGEST:
        raise TwofoldError(
            f"{path}, line {line}: expected a number of at most {_LARGEST:g}, it says {shown(word)}; export it again."
        )
    return value


def _channel(word: str, path: Path, line: int) -> str:
    for channel in CHANNELS:
        if word.lower() == channel.lower():
            return channel
    raise TwofoldError(f"{path}, line {line}: expected a channel such as Zrotation, it says {shown(word)}.")


def _with_frames(joints: tuple[BvhJoint, ...], text: str, path: Path) -> Bvh:
    head = re.match(r"\s*Frames\s*:\s*(\S+)\s+Frame\s+Time\s*:\s*(\S+)", text, re.IGNORECASE)
    if head is None:
        raise TwofoldError(f"MOTION in {path} should begin with Frames: and Frame Time:; export the file again.")
    count, seconds = _decimal(head[1]), _decimal(head[2])
    if not (count >= 1 and count == int(count)):
        raise TwofoldError(f"{path} should hold at least one frame, it says Frames: {head[1]}; export it again.")
    if not 1e-4 <= seconds <= 10:
        raise TwofoldError(
            f"Frame Time in {path} should be seconds (0.0083 at 120 frames a second), it says {head[2]}."
        )
    columns = sum(len(joint.channels) for joint in joints)
    words = text[head.end() :].split()
    if len(words) != int(count) * columns or not columns:
        raise TwofoldError(
            f"MOTION in {path} should hold {int(count)} frames of {columns} numbers ({int(count) * columns}), it holds "
            f"{len(words)} numbers; it is cut short or damaged."
        )
    try:
        values = np.array(words, dtype=np.float64)
    except ValueError as error:
        raise TwofoldError(f"MOTION in {path} holds something that is no number ({error}); export it again.") from error
    wrong = np.flatnonzero(~(np.abs(values) <= _LARGEST))
    if len(wrong):
        raise TwofoldError(
            f"Frame {wrong[0] // columns} of {path} holds {values[wrong[0]]}, at most {_LARGEST:g} is expected; "
            "repair or leave out that frame."
        )
    return Bvh(joints, torch.from_numpy(values.reshape(-1, columns)), 1 / seconds)


def _decimal(word: str) -> float:
    try:
        return float(word)
    except ValueError:
        return math.nan


def bvh_frames(
    joints: Sequence[BvhJoint], values: Float[Tensor, "T C"]
) -> tuple[Float[Tensor, "T J 3 3"], Float[Tensor, "T J 3"]]:
    """World rotation and position of every joint in every frame, in the file's unit and axes: forward kinematics.

    Args:
        joints: parents first.
        values: of the channels, in the joints' order; angles in degrees.
    """
    frames = len(values)
    rotations: list[Tensor] = []
    positions: list[Tensor] = []
    column = 0
    for joint in joints:
        local = torch.eye(3, dtype=values.dtype).expand(frames, 3, 3)
        place = torch.tensor(joint.offset, dtype=values.dtype).repeat(frames, 1)
        for channel in joint.channels:
            axis = "XYZ".index(channel[0])
            value = values[:, column]
            column += 1
            if channel.endswith("position"):
                place[:, axis] = value
            else:
                vector = torch.zeros(frames, 3, dtype=values.dtype)
                vector[:, axis] = value.deg2rad()
                local = local @ axis_angle_to_matrix(vector)
        if joint.parent < 0:
            rotations.append(local)
            positions.append(place)
        else:
            above = rotations[joint.parent]
            rotations.append(above @ local)
            positions.append(positions[joint.parent] + (above @ place[..., None])[..., 0])
    return torch.stack(rotations, 1), torch.stack(positions, 1)


def write_bvh(
    path: Path | str,
    joints: Float[Tensor, "24 3"],
    motion: Motion,
    names: Sequence[str] = JOINT_NAMES,
    units: str = "cm",
) -> None:
    """Writes a motion as BVH: y up, the T-pose as the pose of all zeros, channels Zrotation Xrotation Yrotation.

    Args:
        path: ends in .bvh.
        joints: of the T-pose, metres.
        motion: y up.
        names: of the 24 joints, in SMPL's order (another rig's names, say).
        units: "m" or "cm".

    Raises:
        TwofoldError: the file cannot be written.
    """
    scale = {"m": 1.0, "cm": 100.0}[units]
    _, positions = joint_frames(joints, motion)
    angles = _zxy_degrees(axis_angle_to_matrix(motion.poses.double()))
    lines = ["HIERARCHY"]
    order: list[int] = []
    _write_joint(0, joints.double() * scale, names, scale, lines, order)
    rows = torch.cat([positions[:, 0] * scale, angles[:, order].flatten(1)], 1)
    lines += ["MOTION", f"Frames: {len(motion)}", f"Frame Time: {1 / motion.fps:.10g}"]
    lines += [" ".join(f"{value:.9g}" for value in row) for row in rows.tolist()]
    write_bytes(path, ("\n".join(lines) + "\n").encode())


def _write_joint(
    joint: int, joints: Float[Tensor, "24 3"], names: Sequence[str], scale: float, lines: list[str], order: list[int]
) -> None:
    depth = 0
    above = joint
    while PARENTS[above] >= 0:
        above, depth = PARENTS[above], depth + 1
    indent, parent = "\t" * depth, PARENTS[joint]
    offset = joints[joint] if parent < 0 else joints[joint] - joints[parent]
    positions = "6 Xposition Yposition Zposition " if parent < 0 else "3 "
    order.append(joint)
    lines += [
        f"{indent}{'ROOT' if parent < 0 else 'JOINT'} {names[joint]}", f"{indent}{{",
        f"{indent}\tOFFSET {' '.join(f'{x:.9g}' for x in offset.tolist())}",
        f"{indent}\tCHANNELS {positions}Zrotation Xrotation Yrotation",
    ]  # fmt: skip
    children = [child for child, its_parent in enumerate(PARENTS) if its_parent == joint]
    for child in children:
        _write_joint(child, joints, names, scale, lines, order)
    if not children:
        end = " ".join(f"{x * scale:.9g}" for x in _ENDS[joint])
        lines += [f"{indent}\tEnd Site", f"{indent}\t{{", f"{indent}\t\tOFFSET {end}", f"{indent}\t}}"]
    lines.append(f"{indent}}}")


def _zxy_degrees(rotations: Float[Tensor, "*b 3 3"]) -> Float[Tensor, "*b 3"]:
    """Angles of R = Rz Rx Ry, degrees."""
    sine = rotations[..., 2, 1].clamp(-1, 1)
    cosine = torch.hypot(rotations[..., 2, 0], rotations[..., 2, 2])
    # Where x is a quarter turn, only the sum of the other two angles is fixed: all of it is given to z.
    locked = cosine < 1e-9
    z = torch.atan2(-rotations[..., 0, 1], rotations[..., 1, 1])
    z = torch.where(locked, torch.atan2(rotations[..., 1, 0], rotations[..., 0, 0]), z)
    y = torch.where(locked, 0.0, torch.atan2(-rotations[..., 2, 0], rotations[..., 2, 2]))
    return torch.stack([z, torch.atan2(sine, cosine), y], -1).rad2deg()
