"""What standing and balance say about depth, which landmarks in one image do not show.

One direction is up throughout a clip, feet that stand do so on one level floor, and the body does not fall over. The
direction of up is an unknown of the fit. Lengths count for a person of 1.7 m, as otherwise a smaller person would make
every term smaller. What counts, and when, is told by `twofold.prepare.fitting.footing`.

A term that keeps standing feet from moving was tried and left out: it straightened knees and brought people nearer,
because both shorten the way of a foot that the landmarks' noise moves.
"""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from twofold.body.balance import center_of_mass, center_of_pressure
from twofold.body.leg_ik import ANKLES
from twofold.body.skeleton import Body
from twofold.prepare.fitting.body_landmarks import BodyPoints
from twofold.prepare.fitting.footing import HEIGHT, MAX_TILT, MAX_UNEVEN, SOLES, floor_of
from twofold.prepare.fitting.parameters import FittedMotion, Posed, place_joints, place_points

_MOST = 8.0
"""No error counts for much more than this many usual ones: stairs, chairs and rails are not known."""


@dataclass(frozen=True)
class PhysicsWeights:
    """How strictly soles are level and bodies balance.

    Attributes:
        weight: of each term against the landmarks; 0 leaves all of it out.
        level: error of a standing sole's height, metres.
        balance: usual distance of the centre of pressure from the middle of the support, metres.
        upright: how far the camera's y axis may be off the vertical (standard deviation), radians.
    """

    weight: float = 1.0
    level: float = 0.04
    balance: float = 0.08
    upright: float = 2.0


@dataclass(frozen=True)
class Support:
    """Where the floor is known to hold the body.

    Attributes:
        stands: 1 where a foot stands still.
        carries: how surely standing legs alone carry the body, 0..1.
    """

    stands: Float[Tensor, "t 2"]
    carries: Float[Tensor, "t"]


def up_of(slope: Float[Tensor, "2"]) -> Float[Tensor, "3"]:
    r"""Unit vector that points up, in a camera's axes (x right, y down, z forward), for slopes along x and z.

    \[ g = \frac{(s_x, -1, s_z)}{\lVert (s_x, -1, s_z) \rVert} \]

    >>> up_of(torch.zeros(2)).tolist()
    [0.0, -1.0, 0.0]
    """
    return torch.nn.functional.normalize(torch.stack([slope[0], -torch.ones_like(slope[0]), slope[1]]), dim=0)


def slope_of(up: Float[Tensor, "3"]) -> Float[Tensor, "2"]:
    """The slopes of a direction that points up; see `up_of`.

    >>> slope_of(up_of(torch.tensor([0.25, -0.5]))).tolist()
    [0.25, -0.5]
    """
    return torch.stack([up[0], up[2]]) / (-up[1]).clamp_min(0.2)


def soles_of(posed: Posed, points: BodyPoints, motion: FittedMotion) -> Float[Tensor, "t 2 2 3"]:
    """Where heel and toes of the left and the right foot touch a floor that they stand on flat, metres.

    Below the places on the skin that stand for their landmarks, without what an estimator marks them off by.
    """
    place = points.place.clone()
    place[SOLES.flatten(), 1] = posed.vertices[:, 1].detach().amin()
    bare = replace(motion, marks=torch.zeros_like(motion.marks))
    return place_points(posed, replace(points, place=place), bare)[:, SOLES]


def limited(errors: Tensor) -> Tensor:
    r"""Smooth absolute value of errors in usual ones, with less and less pull of large ones.

    \[ \rho(r) = \frac{a}{1 + a / 8}, \qquad a = \sqrt{1 + r^2} - 1 \]
    """
    size = (1 + errors.square()).sqrt() - 1
    return size / (1 + size / _MOST)


def level_term(
    sole: Float[Tensor, "t 2 2 3"], stands: Float[Tensor, "t 2"], up: Float[Tensor, "3"], error: float
) -> Tensor:
    r"""Standing soles of different heights; `error` in metres is usual.

    \[ E = \frac{1}{T} \sum_{t,f,p} s_{t f} \; \rho\Big( \frac{g \cdot x_{t f p} - h}{e} \Big) \]

    with the level h of most of them.
    """
    height = sole @ up
    floor, _ = floor_of(height, stands)
    return (stands[..., None] * limited((height - floor) / error)).sum((1, 2)).mean()


def balance_term(
    joints: Float[Tensor, "t 24 3"],
    sole: Float[Tensor, "t 2 2 3"],
    support: Support,
    up: Float[Tensor, "3"],
    fps: float,
    error: float,
    seconds: Float[Tensor, "t"] | None = None,
) -> Tensor:
    r"""Bodies that would fall over: the centre of pressure off the feet's middle; `error` in metres is usual.

    \[ E = \frac{1}{T} \sum_t c_t \; \rho\big( d(p_t, S_t) / e \big) \]

    where S is the line from the middle of one sole to that of the other when both stand, else the middle of the one,
    d the level distance, and c how surely the legs carry the body.
    """
    stands = support.stands
    floor, _ = floor_of(sole @ up, stands)
    point = center_of_pressure(center_of_mass(joints), floor, up, fps, seconds)
    middle = sole.mean(2)
    first, second = middle.unbind(1)
    along, free = second - first, point - first
    share = (free * along).sum(-1) / along.square().sum(-1).clamp_min(1e-6)
    # Of two feet the one that does not stand is no support.
    low, high = 1 - stands[:, 0], stands[:, 1]
    share = torch.minimum(torch.maximum(share, low), torch.maximum(high, low))
    away = free - share[:, None] * along
    level = (away - (away @ up)[:, None] * up).square().sum(-1).add(1e-8).sqrt()
    return (support.carries * limited(level / error)).mean()


def physics_term(
    body: Body,
    posed: Posed,
    points: BodyPoints,
    motion: FittedMotion,
    support: Support,
    fps: float,
    weights: PhysicsWeights,
    seconds: Float[Tensor, "t"] | None = None,
) -> Tensor:
    r"""How unlike a body that stands on a level floor this is.

    \[ E = w \, (E_{\mathrm{level}} + E_{\mathrm{balance}}) + \lVert s / \sigma \rVert^2 \]

    with the slopes s of the vertical against the camera's axes and sigma = `PhysicsWeights.upright`.
    """
    size, up = _unit(posed), up_of(motion.slope)
    sole = soles_of(posed, points, motion) * size
    loss = level_term(sole, support.stands, up, weights.level)
    joints = place_joints(posed, body, motion) * size
    loss = loss + balance_term(joints, sole, support, up, fps, weights.balance, seconds)
    return weights.weight * loss + (motion.slope / weights.upright).square().sum()


def believable(body: Body, posed: Posed, points: BodyPoints, motion: FittedMotion, support: Support) -> bool:
    """Whether standing soles came to lie on one level, and up is near where the standing body points."""
    up = up_of(motion.slope)
    _, uneven = floor_of(soles_of(posed, points, motion) * _unit(posed) @ up, support.stands)
    off = torch.rad2deg(
        torch.acos((standing_axis(place_joints(posed, body, motion), support.stands) @ up).clamp(-1, 1))
    )
    return float(uneven) <= MAX_UNEVEN and float(off) <= MAX_TILT


def standing_axis(joints: Float[Tensor, "t 24 3"], stands: Float[Tensor, "t 2"]) -> Float[Tensor, "3"]:
    """Mean direction from the standing feet to the centre of mass, a unit vector."""
    feet = (stands[..., None] * joints[:, list(ANKLES)]).sum(1) / stands.sum(1, keepdim=True).clamp_min(1)
    there = stands.amax(1) > 0
    ahead = torch.nn.functional.normalize(center_of_mass(joints)[there] - feet[there], dim=-1)
    return torch.nn.functional.normalize(ahead.mean(0), dim=0)


def _unit(posed: Posed) -> Tensor:
    """Factor from this person's lengths to those of one of `HEIGHT`."""
    return HEIGHT / (posed.vertices[:, 1].amax() - posed.vertices[:, 1].amin())
