"""How far a test pose is from what was trained on: the paper's stated limitation, made measurable."""

import math
from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from twofold.geometry.rotations import axis_angle_to_matrix

PROTOCOL = (
    "mean angle, degrees, between the rotations of the 23 joints (root left out) of a test pose and of the nearest "
    "training pose"
)


def pose_distances(poses: Float[Tensor, "n 24 3"], training: Float[Tensor, "m 24 3"]) -> Float[Tensor, "n"]:
    r"""Distance of each pose to the nearest training pose, degrees; root rotations do not count.

    $$d(\theta) = \min_{\theta'} \frac{1}{23} \sum_{j = 1}^{23} \arccos \frac{\mathrm{tr}(R_j^\top R'_j) - 1}{2}$$

    Args:
        poses: axis-angle rotations, root first, radians.
        training: the same, one row a training frame.

    >>> bent = torch.zeros(1, 24, 3)
    >>> bent[0, 18, 1] = 1.15  # one elbow, 66 degrees
    >>> round(pose_distances(bent, torch.zeros(2, 24, 3)).item(), 2)
    2.86
    """
    ours, theirs = (axis_angle_to_matrix(part[:, 1:].double()) for part in (poses, training))
    traces = torch.einsum("njab,mjab->nmj", ours, theirs)
    angles = ((traces - 1) / 2).clamp(-1, 1).arccos()
    return angles.mean(-1).amin(1).mul(180 / math.pi).float()


def binned(distances: Sequence[float], values: Sequence[float], bins: int = 4) -> list[tuple[float, float, float, int]]:
    """Values in bins of equally many different distances: mean distance, mean value, its standard error, count.

    Images of one frame by several cameras have one distance, so they share a bin.

    >>> binned([1.0, 2.0, 3.0, 4.0], [10.0, 12.0, 20.0, 22.0], bins=2)
    [(1.5, 11.0, 1.0, 2), (3.5, 21.0, 1.0, 2)]
    """
    places = sorted({round(distance, 4) for distance in distances})
    bins = min(bins, len(places))
    found: list[tuple[float, float, float, int]] = []
    for number in range(bins):
        own = set(places[len(places) * number // bins : len(places) * (number + 1) // bins])
        part = [(d, value) for d, value in zip(distances, values, strict=True) if round(d, 4) in own]
        count = len(part)
        mean = sum(value for _, value in part) / count
        variance = sum((value - mean) ** 2 for _, value in part) / (count - 1) if count > 1 else 0.0
        found.append((sum(distance for distance, _ in part) / count, mean, math.sqrt(variance / count), count))
    return found
