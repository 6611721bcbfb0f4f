"""Where a body's weight is, and where the floor has to hold it."""

import torch
from jaxtyping import Float
from torch import Tensor

from twofold.body.skeleton import JOINT_NAMES
from twofold.geometry.accelerations import accelerations

GRAVITY = 9.81
"""Metres per second squared."""

MASS = {
    "pelvis": 0.142, "spine1": 0.139, "spine3": 0.216, "head": 0.081, "shoulder": 0.0158, "elbow": 0.0213,
    "wrist": 0.0129, "hip": 0.0567, "knee": 0.0697, "ankle": 0.0274, "foot": 0.0072,
}  # fmt: skip
"""Share of the body's mass at each joint (both sides alike): segment masses and centres of Winter, "Biomechanics and
Motor Control of Human Movement", table 4.1, each segment shared out between its two ends."""

_ACCELERATION_SPAN = 0.15
"""Seconds on either side over which the acceleration of the centre of mass is taken: poses of single frames tremble."""


def center_of_mass(joints: Float[Tensor, "t 24 3"]) -> Float[Tensor, "t 3"]:
    r"""The body's centre of mass from its joints, metres.

    \[ c = \frac{\sum_j m_j x_j}{\sum_j m_j} \]

    >>> center_of_mass(torch.ones(1, 24, 3)).tolist()
    [[1.0, 1.0, 1.0]]
    """
    mass = joints.new_tensor([MASS.get(name.split("_")[-1], 0.0) for name in JOINT_NAMES])
    return ((mass / mass.sum())[:, None] * joints).sum(1)


def center_of_pressure(
    center: Float[Tensor, "t 3"],
    floor: Float[Tensor, ""],
    up: Float[Tensor, "3"],
    fps: float,
    seconds: Float[Tensor, "t"] | None = None,
) -> Float[Tensor, "t 3"]:
    r"""Centre of pressure: where the floor has to hold a body that neither falls nor spins, metres.

    \[ p = c - \frac{g \cdot c - h}{\gamma + g \cdot \ddot c} \, (\gamma g + \ddot c) \]

    (the centre of pressure under a body that does not spin: Vukobratovic and Stepanenko 1972), with gravity
    gamma, up g, floor h and the acceleration of the centre of mass c as a difference over 0.15 s to either side.

    Args:
        center: centre of mass in each frame, metres.
        floor: its height along `up`, metres.
        up: unit vector.
        fps: frames per second.
        seconds: when each was seen, where the times are not even.
    """
    if len(center) < 3:
        return center - (center @ up - floor)[:, None] * up
    reach = max(1, min(round(_ACCELERATION_SPAN * fps), (len(center) - 1) // 2))
    middle = center[reach:-reach]
    force = accelerations(center, fps, seconds, reach) + GRAVITY * up
    lift = (force @ up).clamp_min(0.3 * GRAVITY)
    inner = middle - ((middle @ up - floor) / lift)[:, None] * force
    return torch.cat([inner[:1].expand(reach, -1), inner, inner[-1:].expand(reach, -1)])
