"""Stick bodies, and skeletons as the sources of BVH files have them: names, rest poses, axes, units, channel orders."""

import itertools
from dataclasses import dataclass

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from twofold.body.bvh import BvhJoint
from twofold.body.motion import joint_frames
from twofold.body.skeleton import JOINT_NAMES, PARENTS, ShapedBody

_LEFT = {
    "hip": (0.09, -0.30, 0.02), "knee": (0.11, -0.69, 0.03), "ankle": (0.10, -1.09, -0.01), "foot": (0.12, -1.14, 0.12),
    "collar": (0.06, 0.20, 0.0), "shoulder": (0.18, 0.22, 0.0), "elbow": (0.44, 0.21, -0.02),
    "wrist": (0.69, 0.22, -0.02), "hand": (0.78, 0.21, -0.04),
}  # fmt: skip
_MIDDLE = {
    "pelvis": (0, -0.22, 0.03), "spine1": (0, -0.11, 0.02), "spine2": (0, 0.02, 0.02), "spine3": (0, 0.08, 0.03),
    "neck": (0, 0.29, -0.01), "head": (0, 0.37, 0.04),
}  # fmt: skip


def stick_joints(thigh=1.0, shin=1.0, hips=1.0, size=1.0):
    """Joints of a T-pose; thighs, shins and the distance of the hips are scaled, then everything."""
    joints = np.zeros((24, 3))
    for j, name in enumerate(JOINT_NAMES):
        side, _, part = name.partition("_")
        place = _LEFT[part] if part else _MIDDLE[name]
        joints[j] = np.array(place) * ([-1, 1, 1] if side == "right" else [1, 1, 1])
    for s in (0, 1):
        hip, knee, ankle, toe = (joints[k + s].copy() for k in (1, 4, 7, 10))
        moved_hip = hip * [hips, 1, 1]
        moved_knee = moved_hip + thigh * (knee - hip)
        moved_ankle = moved_knee + shin * (ankle - knee)
        joints[1 + s], joints[4 + s], joints[7 + s], joints[10 + s] = (
            moved_hip, moved_knee, moved_ankle, moved_ankle + toe - ankle,
        )  # fmt: skip
    return torch.from_numpy(joints * size)


def stick_body(**proportions):
    """A body that is only its joints and two soles."""
    joints = stick_joints(**proportions)
    soles = joints[[10, 11]] - torch.tensor([0.0, 0.03, 0.0])
    vertices = torch.cat([joints, soles]).float()
    weights = torch.zeros(26, 24)
    weights[torch.arange(24), torch.arange(24)] = 1
    weights[24, 10] = weights[25, 11] = 1
    faces = torch.tensor([[0, 1, 2]])
    return ShapedBody(vertices, joints.float(), faces, weights, torch.zeros(26, 3, 0))


@dataclass(frozen=True)
class Rig:
    """What a source's skeletons are like.

    Attributes:
        names: of our joints there; joints without a name do not exist there.
        frames: world rotation of joints' own axes in the T-pose (identity where not named): zero angles everywhere are
            another pose where these are no identities.
        order: of the rotation channels.
        unit: the file's units per metre.
        up: axis that points up.
        t_pose: whether frame 0 is an added T-pose.
        prefix: before every name.
    """

    names: dict[str, str]
    frames: dict[str, np.ndarray]
    order: str = "ZYX"
    unit: float = 100.0
    up: str = "y"
    t_pose: bool = False
    prefix: str = ""


def _named(table):
    names = {}
    for ours, theirs in table.items():
        if ours in JOINT_NAMES:
            names[ours] = theirs
        else:
            names[f"left_{ours}"], names[f"right_{ours}"] = f"Left{theirs}", f"Right{theirs}"
    return names


_MIXAMO = _named({
    "pelvis": "Hips", "spine1": "Spine", "spine2": "Spine1", "spine3": "Spine2", "neck": "Neck", "head": "Head",
    "hip": "UpLeg", "knee": "Leg", "ankle": "Foot", "foot": "ToeBase", "collar": "Shoulder", "shoulder": "Arm",
    "elbow": "ForeArm", "wrist": "Hand",
})  # fmt: skip
_CMU = _MIXAMO | {"spine1": "LowerBack", "spine2": "Spine", "spine3": "Spine1"}
_LAFAN = _MIXAMO | {"left_foot": "LeftToe", "right_foot": "RightToe"}
_MAX = _named({
    "pelvis": "Hips", "spine1": "Chest", "spine2": "Chest2", "neck": "Neck", "head": "Head", "hip": "Hip",
    "knee": "Knee", "ankle": "Ankle", "foot": "Toe", "collar": "Collar", "shoulder": "Shoulder", "elbow": "Elbow",
    "wrist": "Wrist",
})  # fmt: skip


def _turn(axis, degrees):
    return Rotation.from_euler(axis, degrees, degrees=True).as_matrix()


def _columns(*columns):
    return np.stack(columns, -1).astype(float)


def _along_x(joints):
    """LaFAN1's axes: every bone along its own x; in the trunk y ahead and z to the left, in the limbs rolled about."""
    x, y, z = np.eye(3)
    frames = {name: _columns(y, z, x) for name in ("pelvis", "spine1", "spine2", "spine3", "neck", "head")}
    rest = joints.numpy()
    for side in ("left", "right"):
        chain = ["hip", "knee", "ankle", "foot", "collar", "shoulder", "elbow", "wrist", "hand"]
        for start, end in itertools.pairwise(chain):
            if start == "foot":
                continue
            bone = rest[JOINT_NAMES.index(f"{side}_{end}")] - rest[JOINT_NAMES.index(f"{side}_{start}")]
            bone = bone / np.linalg.norm(bone)
            other = np.cross(bone, z if start in ("hip", "knee", "collar", "shoulder", "elbow", "wrist") else x)
            other = other / np.linalg.norm(other) * (1 if side == "left" else -1)
            frames[f"{side}_{start}"] = _columns(bone, other, np.cross(bone, other))
        frames[f"{side}_foot"] = frames[f"{side}_ankle"]
    return frames


def _splayed(degrees):
    """Legs apart where all angles are zero, as in CMU's skeletons."""
    frames = {}
    for side, sign in (("left", 1), ("right", -1)):
        for part in ("hip", "knee"):
            frames[f"{side}_{part}"] = _turn("z", -sign * degrees)
    return frames


def _hanging():
    """Arms down where all angles are zero, as in classic Biovision skeletons."""
    return {
        f"{side}_{part}": _turn("z", sign * 90)
        for side, sign in (("left", 1), ("right", -1))
        for part in ("shoulder", "elbow", "wrist")
    }


def rigs(joints):
    """The families by name, for a source with these joints."""
    return {
        "cmu": Rig(_CMU, _splayed(20), "ZYX", 1 / 0.056444, t_pose=True),
        "cmu-without-t-pose": Rig(_CMU, _splayed(20), "ZYX", 1 / 0.056444),
        "mixamo": Rig(_MIXAMO, {}, "ZXY", 100.0, prefix="mixamorig:"),
        "mixamo-z-up": Rig(_MIXAMO, {}, "XYZ", 1.0, "z", prefix="mixamorig:"),
        "lafan1": Rig(_LAFAN, _along_x(joints), "ZYX", 100.0),
        "3ds-max": Rig(_MAX, _hanging(), "ZXY", 1 / 0.0254),
    }


_TO_Z_UP = np.array([[1, 0, 0], [0, 0, -1], [0, 1, 0]], dtype=float)


def bvh_of(rig, joints, motion):
    """Joints and channel values of a motion on a rig, made independently of twofold's writer."""
    rotations, positions = (x.numpy() for x in joint_frames(joints, motion))
    if rig.t_pose:
        rotations = np.concatenate([np.broadcast_to(np.eye(3), (1, 24, 3, 3)), rotations])
        positions = np.concatenate([joints.numpy()[None], positions])
    world = _TO_Z_UP if rig.up == "z" else np.eye(3)
    # With z up, the skeleton itself stands along z: its own axes are those of the file's world.
    own = {name: world @ rig.frames.get(name, np.eye(3)) @ world.T for name in JOINT_NAMES}
    turned = {n: world @ rotations[:, j] @ world.T @ own[n] for j, n in enumerate(JOINT_NAMES)}
    rest = joints.numpy() @ world.T * rig.unit
    made, columns = [], []
    index = {}

    def add(j, parent):
        name = JOINT_NAMES[j]
        children = [c for c in range(24) if PARENTS[c] == j]
        if name in rig.names:
            above = JOINT_NAMES[parent] if parent is not None else None
            offset = rest[j] if above is None else own[above].T @ (rest[j] - rest[parent])
            channels = tuple(f"{axis}rotation" for axis in rig.order)
            local = turned[name] if above is None else np.swapaxes(turned[above], -1, -2) @ turned[name]
            if above is None:
                channels = ("Xposition", "Yposition", "Zposition", *channels)
                columns.append(positions[:, 0] @ world.T * rig.unit)
            columns.append(Rotation.from_matrix(local).as_euler(rig.order, degrees=True))
            index[name] = len(made)
            made.append(BvhJoint(rig.prefix + rig.names[name], index.get(above, -1), tuple(offset), channels))
            parent = j
            if not any(JOINT_NAMES[c] in rig.names for c in children):
                tip = rest[children[0]] - rest[j] if children else rest[j] - rest[PARENTS[j]]
                made.append(BvhJoint(f"{made[-1].name} end", len(made) - 1, tuple(own[name].T @ tip), ()))
        for child in children:
            add(child, parent)

    add(0, None)
    return tuple(made), np.concatenate(columns, 1)


def bvh_text(joints, values, fps):
    """The file's text, written without twofold's writer."""
    lines = ["HIERARCHY"]

    def block(i, depth):
        joint, tab = joints[i], "\t" * depth
        kind = "End Site" if joint.name.endswith(" end") else f"{'ROOT' if joint.parent < 0 else 'JOINT'} {joint.name}"
        lines.extend([f"{tab}{kind}", f"{tab}{{", f"{tab}\tOFFSET {' '.join(f'{x:.8f}' for x in joint.offset)}"])
        if joint.channels:
            lines.append(f"{tab}\tCHANNELS {len(joint.channels)} {' '.join(joint.channels)}")
        for child, other in enumerate(joints):
            if other.parent == i:
                block(child, depth + 1)
        lines.append(f"{tab}}}")

    block(0, 0)
    lines += ["MOTION", f"Frames:\t{len(values)}", f"Frame Time: {1 / fps:.8f}"]
    return "\r\n".join([*lines, *(" ".join(f"{v:.7f}" for v in row) for row in values)]) + "\r\n"
