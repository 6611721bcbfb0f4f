"""From which sides cameras see a body: the one measure of how far a person turns."""

import itertools
import math
from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

SEEN_FROM = math.radians(60)
"""A camera sees a side of the body well up to this angle from straight on; beyond it is foreshortened by half."""
FULL_TURN = 180.0
"""A body that turns through less before the camera, in degrees, has a side that no image shows."""
SEEN = FULL_TURN + 2 * math.degrees(SEEN_FROM)
"""Degrees around the body that are seen well when it turns through `FULL_TURN`."""


def camera_directions(
    roots: Float[Tensor, "n 3 3"], pelvises: Float[Tensor, "n 3"], centers: Float[Tensor, "n 3"]
) -> tuple[list[float], list[float]]:
    """Where the camera stands as the body sees it: degrees around it and above its own horizon.

    Args:
        roots: rotations of the root joint.
        pelvises: where it is, world, metres.
        centers: of the cameras, world, metres.

    Returns:
        Azimuths (0 in front, 90 at the person's left) and elevations.

    >>> camera_directions(torch.eye(3)[None], torch.zeros(1, 3), torch.tensor([[2.0, 0.0, 0.0]]))
    ([90.0], [0.0])
    """
    away = ((centers - pelvises)[:, None] @ roots)[:, 0]
    x, y, z = torch.nn.functional.normalize(away, dim=-1).unbind(-1)
    return torch.rad2deg(torch.atan2(x, z)).tolist(), torch.rad2deg(torch.asin(y.clamp(-1, 1))).tolist()


def arc(azimuths: Sequence[float]) -> float:
    """The smallest arc that holds all these directions, degrees: through so much the body turns before its cameras.

    >>> arc([350.0, 20.0, 0.0])
    30.0
    """
    around = sorted(a % 360 for a in azimuths)
    if not around:
        return 0.0
    gaps = [b - a for a, b in itertools.pairwise([*around, around[0] + 360])]
    return 360 - max(gaps)


def sides_seen(azimuths: Float[np.ndarray, "n"]) -> Bool[np.ndarray, "360"]:
    """For each degree around the body whether a camera (azimuth in radians) sees that side well."""
    around = np.radians(np.arange(360) + 0.5)
    away = np.abs((around[:, None] - azimuths + np.pi) % (2 * np.pi) - np.pi)
    return (away <= SEEN_FROM).any(1)
