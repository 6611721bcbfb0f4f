"""What a posed body covers in an image, and how well that agrees with a mask: the one measure of silhouettes."""

import numpy as np
from jaxtyping import Bool, Float, Int
from torch import Tensor

from twofold.geometry.cameras import Camera
from twofold.geometry.raster import rasterize


def silhouette(camera: Camera, vertices: Float[Tensor, "V 3"], faces: Int[Tensor, "F 3"]) -> Bool[np.ndarray, "h w"]:
    """The pixels whose centres a body covers; `vertices` in the world, metres."""
    covered = np.zeros(camera.height * camera.width, dtype=bool)
    covered[rasterize(camera, vertices, faces, cull=True).pixel.numpy()] = True
    return covered.reshape(camera.height, camera.width)


def overlap(
    one: Bool[np.ndarray, "h w"], other: Bool[np.ndarray, "h w"], counted: Bool[np.ndarray, "h w"] | None = None
) -> float:
    """Intersection over union, |A and B| / |A or B|, of the pixels that are counted; 0 where both are empty.

    >>> overlap(np.array([[True, True, False]]), np.array([[False, True, True]]))
    0.3333333333333333
    """
    if counted is not None:
        one, other = one & counted, other & counted
    union = np.count_nonzero(one | other)
    return np.count_nonzero(one & other) / union if union else 0.0
