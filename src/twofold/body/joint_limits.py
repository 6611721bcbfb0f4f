"""How far a person's joints turn: a check, and a clamp, for generated poses."""

import torch
from jaxtyping import Float
from torch import Tensor

from twofold.body.skeleton import JOINT_NAMES

_LEFT_LIMITS: dict[str, tuple[tuple[float, float], tuple[float, float], tuple[float, float]]] = {
    "hip": ((-125, 30), (-50, 50), (-35, 60)),
    "knee": ((-5, 150), (-20, 20), (-15, 15)),
    "ankle": ((-35, 55), (-30, 30), (-30, 30)),
    "foot": ((-50, 30), (-5, 5), (-5, 5)),
    "spine1": ((-30, 45), (-30, 30), (-25, 25)),
    "spine2": ((-30, 45), (-30, 30), (-25, 25)),
    "spine3": ((-30, 45), (-30, 30), (-25, 25)),
    "neck": ((-40, 40), (-50, 50), (-35, 35)),
    "head": ((-40, 40), (-50, 50), (-35, 35)),
    "collar": ((-20, 20), (-30, 30), (-30, 40)),
    "shoulder": ((-100, 100), (-150, 100), (-110, 130)),
    "elbow": ((-95, 95), (-155, 10), (-20, 20)),
    "wrist": ((-90, 90), (-45, 45), (-85, 85)),
    "hand": ((-30, 30), (-30, 30), (-90, 30)),
}
"""Least and largest components of each joint's rotation vector, degrees, on the left side and in the middle, from the
ranges that physiotherapists measure (flexion of a knee 150, of a hip 125, of an elbow 150), generously rounded. The
right side is the mirror image: the components along y and z change their signs."""


def joint_limits() -> tuple[Float[Tensor, "24 3"], Float[Tensor, "24 3"]]:
    """Least and largest component of every joint's rotation vector, radians; the root has no limits."""
    low, high = torch.full((24, 3), -torch.inf), torch.full((24, 3), torch.inf)
    for joint, name in enumerate(JOINT_NAMES):
        side, _, part = name.partition("_")
        limits = _LEFT_LIMITS.get(part if part else name)
        if limits is None:
            continue
        for axis, (least, largest) in enumerate(limits):
            mirrored = side == "right" and axis > 0
            low[joint, axis], high[joint, axis] = (-largest, -least) if mirrored else (least, largest)
    return low.deg2rad(), high.deg2rad()


def within_limits(poses: Float[Tensor, "*b 24 3"]) -> Float[Tensor, "*b 24 3"]:
    """The poses with every joint turned no further than a person's; the root stays.

    >>> knee = torch.zeros(24, 3)
    >>> knee[4, 0] = torch.pi  # folded flat
    >>> round(float(within_limits(knee)[4, 0].rad2deg()))
    150
    """
    low, high = joint_limits()
    return torch.maximum(torch.minimum(poses, high.to(poses)), low.to(poses))


def beyond_limits(poses: Float[Tensor, "*b 24 3"]) -> Float[Tensor, "*b 24"]:
    """By how much each joint turns further than a person's, radians (0 within the limits)."""
    return (poses - within_limits(poses)).abs().amax(-1)
