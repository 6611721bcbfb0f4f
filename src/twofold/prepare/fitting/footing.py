"""Which feet demonstrably stand still, by the image alone, and whether what follows from it may be believed.

Standing feet and balance tell a fit where up is, and so how far a body leans in depth, which one image does not show.
Where the person floats, swings, sits or walks on something that moves they tell nothing, or something wrong. So they
count only where both heel and toes of a foot stay in their place for a third of a second and more, for a fair part of
the clip; and what came of them is thrown away where it contradicts the landmarks or a common floor.
"""

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from twofold.body.leg_ik import knee_bends
from twofold.prepare.detections import LANDMARKS
from twofold.prepare.fitting.observations import Seen

SOLES = torch.tensor([[LANDMARKS.index(f"{side}_{part}") for part in ("heel", "foot_index")]
                      for side in ("left", "right")])  # fmt: skip
"""Landmarks of heel and toes of the left and the right foot."""
HEIGHT = 1.7
"""Height that stands for the size of the person where lengths are given in metres."""
STAYS, SHORTEST_REST = 0.04, 0.3
"""Metres (of a person of 1.7 m) within which heel and toes of a standing foot stay, and seconds. A foot that
swings goes as far in a thirtieth of a second; a landmark's noise is a centimetre."""
ENOUGH_TIME, ENOUGH_SHARE = 0.5, 0.3
"""Seconds and share of the clip in which a foot stands, for the vertical to be told by it."""
BENT, FOLDED = 60.0, 90.0
"""Degrees by which a knee is bent when the leg begins to be one that may not carry the body, and when it is one."""
LEVEL_SHARE = 0.7
"""Of the standing soles have to be on one level: the others may be on stairs."""
MAX_UNEVEN, MAX_TILT, MAX_WORSE = 0.06, 40.0, 0.4
"""What is believed: standing soles at most this far off one level, metres; a vertical at most this far off the standing
body's own axis, degrees; landmarks met worse by no more than this share."""


def standing(seen: Seen, fps: float) -> Float[Tensor, "t 2"]:
    """1 where a foot stands still in the first camera's image, for as long as `SHORTEST_REST`; else 0.

    Args:
        seen: landmarks by frame.
        fps: frames per second.
    """
    count = len(seen.pixels[0])
    reach = max(2, round(SHORTEST_REST * fps))
    stands = torch.zeros(count, 2, dtype=torch.bool)
    if count <= reach:
        return stands.float()
    places = seen.pixels[0][:, SOLES] * (HEIGHT / float(seen.size[0]))
    sure = (seen.weight[0][:, SOLES] > 0.25).all(-1)
    windows = places.unfold(0, reach + 1, 1)
    # Largest extent of heel and toes, along the columns and the rows, within each window of frames.
    extent = (windows.amax(-1) - windows.amin(-1)).norm(dim=-1).amax(-1)
    still = (extent < STAYS) & sure.unfold(0, reach + 1, 1).all(-1)
    for start in range(len(still)):
        stands[start : start + reach + 1] |= still[start]
    return stands.float()


def tells_the_vertical(stands: Float[Tensor, "t 2"], fps: float) -> bool:
    """Whether feet stand for long enough."""
    frames = int((stands.amax(1) > 0).sum())
    return frames >= max(ENOUGH_TIME * fps, ENOUGH_SHARE * len(stands), 3)


def carrying(joints: Float[Tensor, "t 24 3"], stands: Float[Tensor, "t 2"]) -> Float[Tensor, "t"]:
    """How surely standing legs alone carry the body, 0..1: not where people kneel, sit or lie.

    Args:
        joints: positions, metres.
        stands: see `standing`.
    """
    straight = ((FOLDED - knee_bends(joints)) / (FOLDED - BENT)).clamp(0, 1)
    return (stands * straight).amax(1)


def floor_of(heights: Float[Tensor, "t 2 2"], stands: Float[Tensor, "t 2"]) -> tuple[Tensor, Tensor]:
    """The level on which most standing soles are, and how far off it `LEVEL_SHARE` of them are at most, metres.

    Args:
        heights: of heel and toes of both feet.
        stands: see `standing`.
    """
    there: Bool[Tensor, "t 2 2"] = (stands > 0)[..., None].expand_as(heights)
    if not bool(there.any()):
        return heights.new_zeros(()), heights.new_zeros(())
    chosen = heights[there]
    with torch.no_grad():
        off = chosen - chosen.median()
        weight = 1 / (1 + (off / MAX_UNEVEN).square()) ** 2
    floor = (weight * chosen).sum() / weight.sum()
    return floor, torch.quantile((chosen.detach() - floor.detach()).abs(), LEVEL_SHARE)
