"""Rest frames of limb joints whose skeleton has no T-pose, found in the motion itself.

Each function gives the constant rotation M of a joint with R = G M: G is the joint's world rotation in the file, R the
body's. M maps the body's rest frame (bone, second axis) to the same two axes in the joint's own frame.
"""

import torch
from jaxtyping import Float
from torch import Tensor

_MIN_BEND = 0.17
"""Sine of the angle from which a bent knee or elbow shows its axis (10 degrees)."""


def hinge_frame(
    rotations: Float[Tensor, "T 3 3"], limb: Float[Tensor, "T 2 3"], bone: Float[Tensor, "T 3"],
    rest: Float[Tensor, "3"], kind: str, side: str, above: Float[Tensor, "T 3 3"],
) -> Float[Tensor, "3 3"]:  # fmt: skip
    """The rest frame of a limb joint, from its bone and the axis about which its knee or elbow bends.

    Where the limb hardly bends in the whole motion, the joint is taken to turn as its parent does on average.

    Args:
        rotations: world rotations of the joint in the file.
        limb: world directions of the limb's upper and lower bone.
        bone: world direction of the joint's own bone.
        rest: direction of the body's bone in the T-pose.
        kind: "hip" (knees bend backward) or "shoulder" (elbows bend ahead).
        side: "left" or "right".
        above: world rotations of the body's joint above.
    """
    normal = torch.linalg.cross(limb[:, 0], limb[:, 1], dim=-1)
    bent = normal.norm(dim=-1) > _MIN_BEND
    if not bent.any():
        return parent_frame(rotations, bone, rest, above)
    axis = _local_mean(rotations[bent], normal[bent])
    hinge = (1.0, 0.0, 0.0) if kind == "hip" else (0.0, -1.0 if side == "left" else 1.0, 0.0)
    return _frame(_local_mean(rotations, bone), axis) @ _frame(rest, torch.tensor(hinge).to(rest)).T


def parent_frame(
    rotations: Float[Tensor, "T 3 3"],
    bone: Float[Tensor, "T 3"] | None,
    rest: Float[Tensor, "3"],
    above: Float[Tensor, "T 3 3"],
) -> Float[Tensor, "3 3"]:
    """The rest frame of a joint that on average turns about its bone as its parent does.

    Args:
        rotations: world rotations of the joint in the file.
        bone: world direction of the joint's bone; None where it has none, and then all of the mean rotation counts.
        rest: direction of the body's bone in the T-pose.
        above: world rotations of the body's joint above.
    """
    u, _, v = torch.linalg.svd((rotations.transpose(-1, -2) @ above).mean(0))
    mean = u @ torch.diag(torch.tensor([1.0, 1.0, float(torch.linalg.det(u @ v))]).to(u)) @ v
    if bone is None:
        return mean
    second = torch.tensor([0.0, 0.0, 1.0]).to(rest)
    return _frame(_local_mean(rotations, bone), mean @ second) @ _frame(rest, second).T


def flat_feet_frame(
    rotations: Float[Tensor, "T 3 3"], ends: Float[Tensor, "T 2 3"], rest: Float[Tensor, "3"], scale: float
) -> Float[Tensor, "3 3"]:
    """The rest frame of an ankle: level in those frames in which both ends of the foot are near their lowest.

    Args:
        rotations: world rotations (y up) of the ankle in the file.
        ends: world positions (y up) of ankle and toe in the file's unit.
        rest: from the body's ankle to its foot joint in the T-pose.
        scale: metres per unit of the file.
    """
    heights = ends[..., 1]
    low = torch.quantile(heights, 0.05, dim=0)
    flat = ((heights - low).abs() * scale < 0.025).all(-1)
    if not flat.any():
        flat = (heights - low).sum(-1) <= torch.quantile((heights - low).sum(-1), 0.1)
    up = torch.tensor([0.0, 1.0, 0.0]).to(rest)
    local_up = _local_mean(rotations[flat], up.expand(int(flat.sum()), 3))
    bone = _local_mean(rotations, ends[:, 1] - ends[:, 0])
    return _frame(local_up, bone) @ _frame(up, rest).T


def _local_mean(rotations: Float[Tensor, "T 3 3"], vectors: Float[Tensor, "T 3"]) -> Float[Tensor, "3"]:
    """Mean of world vectors as seen from a joint's own frame."""
    return (rotations.transpose(-1, -2) @ vectors[..., None])[..., 0].mean(0)


def _frame(first: Float[Tensor, "3"], second: Float[Tensor, "3"]) -> Float[Tensor, "3 3"]:
    """Columns: the first direction, the second one made orthogonal to it, their cross product."""
    a = torch.nn.functional.normalize(first, dim=0)
    b = torch.nn.functional.normalize(second - (second @ a) * a, dim=0)
    return torch.stack([a, b, torch.linalg.cross(a, b)], -1)
