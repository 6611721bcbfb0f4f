"""Legs that reach for a place: two-bone inverse kinematics which keeps the knees' direction and the feet's rotation."""

import torch
from jaxtyping import Float
from torch import Tensor

from twofold.geometry.rotations import shortest_turn

HIPS, KNEES, ANKLES, TOES = (1, 2), (4, 5), (7, 8), (10, 11)
"""Joints of both legs, left before right."""

STRAIGHTEST = 0.9995
"""Share of its length to which a leg may be stretched: a completely straight knee has no direction to bend."""


def knee_bends(positions: Float[Tensor, "T 24 3"]) -> Float[Tensor, "T 2"]:
    """How far the left and the right knee are bent, degrees; 0 for a straight leg.

    >>> joints = torch.zeros(1, 24, 3)
    >>> joints[0, 1, 1], joints[0, 7, 2] = 1.0, -1.0  # a thigh that hangs and a shin that points back, on the left
    >>> knee_bends(joints)[0, 0].item()
    90.0

    Args:
        positions: of every joint, metres.
    """
    hip, knee, ankle = (positions[:, list(part)] for part in (HIPS, KNEES, ANKLES))
    cosine = torch.nn.functional.cosine_similarity(knee - hip, ankle - knee, dim=-1)
    return torch.rad2deg(torch.acos(cosine.clamp(-1, 1)))


def reach(
    rotations: Float[Tensor, "T 24 3 3"], positions: Float[Tensor, "T 24 3"], ankles: Float[Tensor, "T 2 3"]
) -> Float[Tensor, "T 24 3 3"]:
    """World rotations with thighs and shins turned so that the ankles come to `ankles`; nothing else turns.

    The knee stays in the plane of the leg. A place beyond the leg's length is reached for with a (nearly) straight
    leg. Where the ankle already is at its place, nothing changes.

    Args:
        rotations: world rotation of every joint.
        positions: world position of every joint, metres.
        ankles: wanted positions of the left and the right ankle, metres.
    """
    turned = rotations.clone()
    for side in (0, 1):
        hip, knee, ankle = (positions[:, joints[side]] for joints in (HIPS, KNEES, ANKLES))
        thigh, shin = (knee - hip).norm(dim=-1), (ankle - knee).norm(dim=-1)
        before = (ankle - hip).norm(dim=-1)
        wanted = ankles[:, side] - hip
        longest = torch.maximum(STRAIGHTEST * (thigh + shin), before)
        distance = torch.minimum(torch.maximum(wanted.norm(dim=-1), (thigh - shin).abs() + 1e-3), longest)
        toward = torch.nn.functional.normalize(wanted, dim=-1)
        # The direction of the knee off the line from hip to ankle, carried along to the new line.
        carried = (shortest_turn(ankle - hip, wanted) @ _knee_direction(rotations, positions, side)[..., None])[..., 0]
        pole = torch.nn.functional.normalize(carried - (carried * toward).sum(-1, keepdim=True) * toward, dim=-1)
        along = (thigh.square() - shin.square() + distance.square()) / (2 * distance)
        off = (thigh.square() - along.square()).clamp_min(0).sqrt()
        new_knee = hip + along[:, None] * toward + off[:, None] * pole
        new_ankle = hip + distance[:, None] * toward
        moved = ((ankles[:, side] - ankle).norm(dim=-1) > 1e-7)[:, None, None]
        for joint, turn in (
            (HIPS[side], shortest_turn(knee - hip, new_knee - hip)),
            (KNEES[side], shortest_turn(ankle - knee, new_ankle - new_knee)),
        ):
            turned[:, joint] = torch.where(moved, turn @ rotations[:, joint], rotations[:, joint])
    return turned


def _knee_direction(
    rotations: Float[Tensor, "T 24 3 3"], positions: Float[Tensor, "T 24 3"], side: int
) -> Float[Tensor, "T 3"]:
    """Where the knee lies off the line from hip to ankle; ahead of the thigh where the leg is straight."""
    hip, knee, ankle = (positions[:, joints[side]] for joints in (HIPS, KNEES, ANKLES))
    line = torch.nn.functional.normalize(ankle - hip, dim=-1)
    off = (knee - hip) - ((knee - hip) * line).sum(-1, keepdim=True) * line
    ahead = rotations[:, HIPS[side], :, 2]
    ahead = ahead - (ahead * line).sum(-1, keepdim=True) * line
    # A straight leg of SMPL's is not quite straight and may point its knee anywhere: the thigh's front decides there.
    bent = (off.norm(dim=-1, keepdim=True) / (knee - hip).norm(dim=-1, keepdim=True) / 0.02).clamp(0, 1)
    return bent * torch.nn.functional.normalize(off, dim=-1) + (1 - bent) * torch.nn.functional.normalize(ahead, dim=-1)
