"""Brings a body from its own rest pose to SMPL's T-pose, and poses with it."""

import itertools

import torch
from jaxtyping import Float
from torch import Tensor

from twofold.body.skeleton import JOINT_NAMES, PARENTS, skin
from twofold.geometry.rotations import axis_angle_to_matrix, matrix_to_axis_angle, rigid_transform, shortest_turn

_LEFT_LIMBS = (
    ("shoulder", "elbow", (0.994, -0.051, -0.095)),
    ("elbow", "wrist", (0.999, 0.033, -0.013)),
    ("wrist", "hand", (0.983, -0.088, -0.165)),
    ("hip", "knee", (0.095, -0.995, -0.018)),
    ("knee", "ankle", (-0.037, -0.994, -0.107)),
)
"""How the limbs of SMPL's mean body point in its T-pose, on the left side; the right side is the mirror image."""


def straighten(
    vertices: Float[Tensor, "V 3"], joints: Float[Tensor, "24 3"], weights: Float[Tensor, "V 24"]
) -> tuple[Float[Tensor, "V 3"], Float[Tensor, "24 3"], Float[Tensor, "24 3 3"]]:
    """Turns the limbs of a body until they point as in SMPL's T-pose.

    The whole body is first turned by quarter turns until it stands along +y and its left is at +x. Then each upper
    arm, forearm, hand, thigh and shin takes the shortest way to its direction, from the trunk outwards. Trunk, collars,
    neck, head and feet keep their orientation: only where a limb points is fixed by a pose vector's meaning, and these
    already look the same way in every upright rest pose.

    Args:
        vertices: in the body's own rest pose, upright along some axis, metres.
        joints: of that rest pose, in SMPL's order.
        weights: skinning weights, rows sum to 1.

    Returns:
        Vertices and joints in the T-pose (the pelvis stays where it was), and the rotation that brought each joint's
        frame there, for `convert_pose`.
    """
    upright = _upright_rotation(joints)
    turns: list[Tensor] = []
    places: list[Tensor] = []
    limbs = _limbs(joints)
    for j, parent in enumerate(PARENTS):
        before = upright if parent < 0 else turns[parent]
        places.append(joints[j] if parent < 0 else places[parent] + before @ (joints[j] - joints[parent]))
        if j in limbs:
            child, direction = limbs[j]
            turns.append(shortest_turn(before @ (joints[child] - joints[j]), direction) @ before)
        else:
            turns.append(upright if JOINT_NAMES[j].endswith("ankle") else before)
    turned, t_joints = torch.stack(turns), torch.stack(places)
    shifts = t_joints - (turned @ joints[:, :, None])[..., 0]
    return skin(vertices, weights, rigid_transform(turned, shifts)), t_joints, turned


def convert_pose(pose: Float[Tensor, "*b 24 3"], turns: Float[Tensor, "24 3 3"]) -> Float[Tensor, "*b 24 3"]:
    """Poses relative to a body's own rest pose as poses relative to the T-pose that `straighten` gave.

    The posed joints stay where they are (the translation is left as it is); the posed skin moves a little where joints
    blend, because skinning is not a group.

    Args:
        pose: axis-angle relative to the own rest pose, root first, radians.
        turns: the rotations from `straighten`.
    """
    before = torch.cat([torch.eye(3).to(turns)[None], turns[list(PARENTS[1:])]])
    return matrix_to_axis_angle(before @ axis_angle_to_matrix(pose) @ turns.transpose(-1, -2))


def _limbs(like: Tensor) -> dict[int, tuple[int, Tensor]]:
    """For each limb's joint: the joint at its other end, and its direction in the T-pose (unit)."""
    limbs: dict[int, tuple[int, Tensor]] = {}
    for (start, end, direction), side in itertools.product(_LEFT_LIMBS, ("left", "right")):
        x, y, z = direction
        target = torch.tensor([x if side == "left" else -x, y, z]).to(like)
        limbs[JOINT_NAMES.index(f"{side}_{start}")] = JOINT_NAMES.index(f"{side}_{end}"), target / target.norm()
    return limbs


def _upright_rotation(joints: Float[Tensor, "24 3"]) -> Float[Tensor, "3 3"]:
    """The rotation by quarter turns that brings the body's left nearest to +x and its up nearest to +y."""
    left = joints[JOINT_NAMES.index("left_hip")] - joints[JOINT_NAMES.index("right_hip")]
    up = joints[JOINT_NAMES.index("neck")] - joints[JOINT_NAMES.index("pelvis")]
    x, y = _nearest_axis(left), _nearest_axis(up)
    return torch.stack([x, y, torch.linalg.cross(x, y)])


def _nearest_axis(vector: Float[Tensor, "3"]) -> Float[Tensor, "3"]:
    largest = vector.abs().argmax()
    axis = torch.zeros_like(vector)
    axis[largest] = vector[largest].sign()
    return axis
