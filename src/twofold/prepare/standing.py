"""How a body stands: the one measure of whether it leans, floats or slides as people do not.

A camera does not see depth: a body that leans towards it by 20 degrees with bent knees covers nearly the same pixels as
one that stands, and its feet may float or slide without any pixel's notice.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from twofold.body.balance import center_of_mass
from twofold.body.leg_ik import ANKLES, HIPS, TOES, knee_bends
from twofold.body.motion import leg_length
from twofold.body.skeleton import joint_transforms
from twofold.geometry.accelerations import limited_gaps

UPRIGHT = 0.5
"""Smallest mean cosine between the body's own up and the world's y axis at which that axis counts as vertical."""
ON_LEGS = 0.7
"""Leg lengths by which hips are above a foot at least: lower ones may rest on a chair, on knees or on the floor."""
FEWEST_FRAMES = 5
"""On their legs; of fewer nothing is said about lean."""
MAX_LEAN, MAX_OFF_BALANCE = 12.0, 0.2
"""Degrees and metres, medians: people who stand and walk keep the centre of mass within 15 cm of their feet."""
MAX_FLOATING = 0.25
"""Metres above the usual floor that nine tenths of the frames stay below; jumps and stairs reach more."""
MAX_SLIDING = 0.4
"""Metres per second, median of the slower foot; the standing foot of a good fit of a real clip moves at up to 0.25."""


@dataclass(frozen=True)
class StandingFacts:
    """How a body stands on the plane y = const of its world.

    Attributes:
        upright: mean cosine between the body's own up and the y axis; below `UPRIGHT` the rest means nothing.
        on_legs: frames in which the legs carry the body (`ON_LEGS`).
        off_balance: level distance of the centre of mass from the foot, or the middle of both, that is nearest below
            it; median over these frames, metres.
        lean: angle of the line from there to the centre of mass against the vertical; median, degrees.
        knees: how far the straighter knee is bent; median over these frames, degrees.
        leaning_most: frame with the largest lean; -1 where no frame is on its legs.
        floor: height of the lower foot's joints where it usually stands, metres.
        floating: how high the lower foot is above that; nine tenths of the frames less, metres.
        sliding: speed of the slower foot; median, metres per second. One foot of somebody who walks always stands.
    """

    upright: float
    on_legs: int
    off_balance: float
    lean: float
    knees: float
    leaning_most: int
    floor: float
    floating: float
    sliding: float

    def sentence(self) -> str:
        """The numbers in words."""
        if self.upright < UPRIGHT:
            return "The body does not stand along the world's y axis, so nothing is said about lean and feet."
        feet = (
            f"feet float by up to {100 * self.floating:.0f} cm, and the slower one moves at {self.sliding:.2f} m/s "
            "(median)."
        )
        if self.on_legs < FEWEST_FRAMES:
            return f"Hardly any frame shows the body on its legs; {feet}"
        return (
            f"In {self.on_legs} frames on its legs the body leans by {self.lean:.0f} degrees, its centre of mass "
            f"{100 * self.off_balance:.0f} cm off its feet, with the straighter knee bent by {self.knees:.0f} degrees "
            f"(medians); {feet}"
        )


@dataclass(frozen=True)
class StandingFault:
    """Something that people do not do.

    Attributes:
        topic: "lean", "floating" or "sliding".
        doubtful: it may be right, as for jumps; it costs training little.
        what: a sentence, with the number.
        advice: a sentence.
    """

    topic: str
    doubtful: bool
    what: str
    advice: str


def standing_facts(
    poses: Float[Tensor, "T 24 3"],
    translations: Float[Tensor, "T 3"],
    joints: Float[Tensor, "24 3"],
    seconds: Float[np.ndarray, "T"],
    frames: Sequence[int] | None = None,
) -> StandingFacts:
    """Measures a motion in a world with y up.

    Args:
        poses: of consecutive frames, axis-angle, radians.
        translations: metres.
        joints: of this person in the T-pose, metres.
        seconds: when each frame was taken.
        frames: that count; all by default. Poses of frames that are left out may be anything.

    >>> still = standing_facts(torch.zeros(5, 24, 3), torch.zeros(5, 3), torch.rand(24, 3), np.arange(5) / 10)
    >>> still.floating, still.sliding
    (0.0, 0.0)
    """
    transforms = joint_transforms(joints, poses, translations)
    every = (transforms[..., :3, :3] @ joints[:, :, None])[..., 0] + transforms[..., :3, 3]
    times = torch.arange(len(every)) if frames is None else torch.tensor(sorted(frames))
    placed = every[times]
    # T x 2 feet x (ankle, front).
    feet = torch.stack([placed[:, list(ANKLES)], placed[:, list(TOES)]], 2)
    places = feet.mean(2)
    supports = torch.cat([places, places.mean(1, keepdim=True)], 1)
    apart = center_of_mass(placed)[:, None] - supports
    level, nearest = apart[..., [0, 2]].norm(dim=-1).min(1)
    lean = torch.rad2deg(torch.atan2(level, apart[torch.arange(len(apart)), nearest, 1]))
    carried = _on_legs(placed, joints)
    lowest = feet[..., 1].mean(2).amin(1)
    following = torch.diff(times) == 1
    slower = (places[1:] - places[:-1]).norm(dim=-1).amin(1)[following]
    gaps = limited_gaps(np.diff(seconds[times.numpy()])[following.numpy()])
    slower = slower / torch.as_tensor(gaps, dtype=slower.dtype)
    upward = torch.nn.functional.normalize(placed[:, 12] - placed[:, 0], dim=-1)[:, 1]
    floor = float(torch.quantile(lowest, 0.1))
    return StandingFacts(
        upright=float(upward.mean()),
        on_legs=int(carried.sum()),
        off_balance=_median(level[carried]),
        lean=_median(lean[carried]),
        knees=_median(knee_bends(placed).amin(1)[carried]),
        leaning_most=int(times[lean.masked_fill(~carried, -1).argmax()]) if bool(carried.any()) else -1,
        floor=floor,
        floating=float(torch.quantile(lowest, 0.9)) - floor,
        sliding=_median(slower),
    )


def standing_faults(facts: StandingFacts) -> list[StandingFault]:
    """What a body does that people do not; nothing where the y axis is not up."""
    if facts.upright < UPRIGHT:
        return []
    found: list[StandingFault] = []
    leans = facts.lean > MAX_LEAN and facts.off_balance > MAX_OFF_BALANCE
    if leans and facts.on_legs >= FEWEST_FRAMES:
        found.append(
            StandingFault(
                "lean",
                False,
                f"The body leans by {facts.lean:.0f} degrees, its centre of mass {100 * facts.off_balance:.0f} cm off "
                "its feet (medians): it would fall",
                "Look at the views from the side; give the camera's --intrinsics to prepare, or film from the height "
                "of the hips.",
            )
        )
    if facts.floating > MAX_FLOATING:
        found.append(
            StandingFault(
                "floating",
                True,
                f"Both feet are up to {100 * facts.floating:.0f} cm above where they usually stand",
                "That is right for jumps and stairs; else the distance from the camera changes where it should not.",
            )
        )
    if facts.sliding > MAX_SLIDING:
        found.append(
            StandingFault(
                "sliding",
                True,
                f"Feet slide: the slower one moves at {facts.sliding:.2f} m/s (median)",
                "That is right on a turntable, on wheels and in quick dance; else check `fps`, and that the camera "
                "stood still.",
            )
        )
    return found


def _on_legs(placed: Float[Tensor, "t 24 3"], joints: Float[Tensor, "24 3"]) -> Bool[Tensor, "t"]:
    """Frames whose hips are high above a foot."""
    above = placed[:, list(HIPS), 1].mean(1) - placed[:, list(ANKLES), 1].amin(1)
    return above > ON_LEGS * leg_length(joints)


def _median(values: Float[Tensor, "n"]) -> float:
    return float(values.median()) if len(values) else 0.0
