"""The rig of an exported character: skinning weights, the rest pose, names of the joints."""

from typing import Literal

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from twofold.body.skeleton import JOINT_NAMES, PosedBody
from twofold.deform.skinning import inverse_skinning, smooth_neighbour_weights
from twofold.geometry.rotations import rigid_inverse
from twofold.geometry.surfaces import nearest_vertices
from twofold.outputs.export.repair import neighbour_means

RigNames = Literal["smpl", "mixamo", "vrm"]

INFLUENCES = 4
"""Joints that may move a vertex: what every engine reads."""
_NEIGHBOURS = 8
_SMOOTHING = 12

HUMANOID = {
    "pelvis": "hips", "spine1": "spine", "spine2": "chest", "spine3": "upperChest", "neck": "neck", "head": "head",
    "left_hip": "leftUpperLeg", "left_knee": "leftLowerLeg", "left_ankle": "leftFoot", "left_foot": "leftToes",
    "right_hip": "rightUpperLeg", "right_knee": "rightLowerLeg", "right_ankle": "rightFoot", "right_foot": "rightToes",
    "left_collar": "leftShoulder", "left_shoulder": "leftUpperArm", "left_elbow": "leftLowerArm",
    "left_wrist": "leftHand", "right_collar": "rightShoulder", "right_shoulder": "rightUpperArm",
    "right_elbow": "rightLowerArm", "right_wrist": "rightHand",
}  # fmt: skip
"""VRM 1.0's humanoid bone for each joint that has one; SMPL's hand joints, in the palms, have none."""

_PALMS = {"left_hand": "leftPalm", "right_hand": "rightPalm"}

_MIXAMO = {
    "pelvis": "Hips", "spine1": "Spine", "spine2": "Spine1", "spine3": "Spine2", "neck": "Neck", "head": "Head",
    "left_hip": "LeftUpLeg", "left_knee": "LeftLeg", "left_ankle": "LeftFoot", "left_foot": "LeftToeBase",
    "left_collar": "LeftShoulder", "left_shoulder": "LeftArm", "left_elbow": "LeftForeArm", "left_wrist": "LeftHand",
    "left_hand": "LeftHandMiddle1",
}  # fmt: skip


def joint_names(rig: RigNames) -> tuple[str, ...]:
    """Names of the 24 joints, in SMPL's order, as rigs of this kind call them.

    >>> joint_names("smpl")[4], joint_names("mixamo")[4], joint_names("vrm")[4]
    ('left_knee', 'mixamorig:LeftLeg', 'leftLowerLeg')
    """
    if rig == "smpl":
        return JOINT_NAMES
    if rig == "vrm":
        return tuple(HUMANOID.get(name, _PALMS.get(name, name)) for name in JOINT_NAMES)
    return tuple(f"mixamorig:{_mixamo(name)}" for name in JOINT_NAMES)


def _mixamo(name: str) -> str:
    if name in _MIXAMO:
        return _MIXAMO[name]
    return _MIXAMO[name.replace("right", "left")].replace("Left", "Right")


def transfer_weights(
    vertices: Float[Tensor, "V 3"], faces: Int[np.ndarray, "F 3"], body: PosedBody
) -> Float[Tensor, "V 24"]:
    """Skinning weights of a surface around the canonical body: at most four a vertex, rows sum to 1.

    Each vertex takes those of its nearest body vertices, mixed; then they are averaged along the surface, so that they
    change as smoothly as its own triangles allow, and the small ones are dropped.

    Args:
        vertices: canonical space, metres.
        faces: triangles.
        body: whose canonical vertices carry weights.
    """
    distances, nearest = nearest_vertices(vertices, body.canonical_vertices, _NEIGHBOURS)
    mixed = smooth_neighbour_weights(distances.square())
    weights = (mixed[..., None] * body.weights[nearest]).sum(1).cpu().numpy()
    means = neighbour_means(len(weights), faces)
    for _ in range(_SMOOTHING):
        weights = 0.5 * (weights + means @ weights)
    return keep_largest_weights(torch.from_numpy(np.ascontiguousarray(weights, dtype=np.float32)))


def keep_largest_weights(weights: Float[Tensor, "V J"], count: int = INFLUENCES) -> Float[Tensor, "V J"]:
    """The `count` largest weights of each row, scaled to sum to 1; the others are zero.

    >>> keep_largest_weights(torch.tensor([[0.5, 0.3, 0.2]]), 2)
    tensor([[0.6250, 0.3750, 0.0000]])
    """
    largest, joint = weights.topk(count, -1)
    kept = torch.zeros_like(weights).scatter(-1, joint, largest)
    return kept / kept.sum(-1, keepdim=True)


def to_rest(vertices: Float[Tensor, "V 3"], weights: Float[Tensor, "V 24"], rest: PosedBody) -> Float[Tensor, "V 3"]:
    """Canonical vertices in the T-pose: where linear blend skinning takes them from to canonical space.

    Args:
        vertices: canonical, metres.
        weights: their skinning weights.
        rest: the body in the T-pose.
    """
    return inverse_skinning(vertices, weights, rigid_inverse(rest.bones))
