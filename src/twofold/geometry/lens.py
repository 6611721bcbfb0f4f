"""Lens distortion: OpenCV's model with five coefficients, and images without it.

Pixels are counted as everywhere here: column i and row j of an image is the point (i, j).
"""

from collections.abc import Callable

import numpy as np
import torch
from jaxtyping import Float, UInt8


def distorted_pixels(
    intrinsics: Float[np.ndarray, "3 3"], distortion: Float[np.ndarray, "5"], pixels: Float[np.ndarray, "*b 2"]
) -> Float[np.ndarray, "*b 2"]:
    """Where a lens shows what a perfect one would show at `pixels` (column, row).

    Args:
        intrinsics: [fx s cx; 0 fy cy; 0 0 1], pixels.
        distortion: OpenCV's k1, k2, p1, p2, k3.
        pixels: of the perfect image.
    """
    k1, k2, p1, p2, k3 = distortion
    y = (pixels[..., 1] - intrinsics[1, 2]) / intrinsics[1, 1]
    x = (pixels[..., 0] - intrinsics[0, 2] - intrinsics[0, 1] * y) / intrinsics[0, 0]
    r = x * x + y * y
    radial = 1 + r * (k1 + r * (k2 + r * k3))
    u = x * radial + 2 * p1 * x * y + p2 * (r + 2 * x * x)
    v = y * radial + p1 * (r + 2 * y * y) + 2 * p2 * x * y
    return np.stack([u, v], -1) @ intrinsics[:2, :2].T + intrinsics[:2, 2]


def undistorted_pixels(
    intrinsics: Float[np.ndarray, "3 3"], distortion: Float[np.ndarray, "5"], pixels: Float[np.ndarray, "*b 2"]
) -> Float[np.ndarray, "*b 2"]:
    """Where a perfect lens would show what this one shows at `pixels`: the inverse, to 0.001 pixels."""
    ideal = pixels.astype(np.float64)
    if not distortion.any():
        return ideal
    for _ in range(100):
        step = pixels - distorted_pixels(intrinsics, distortion, ideal)
        ideal = ideal + step
        if not np.nanmax(np.abs(step), initial=0.0) > 1e-3:
            break
    return ideal


def largest_distortion(
    intrinsics: Float[np.ndarray, "3 3"], distortion: Float[np.ndarray, "5"], height: int, width: int
) -> float:
    """How far the lens moves a point of an image of this size at most, pixels."""
    grid = pixel_places(np.linspace(0, height - 1, 33), np.linspace(0, width - 1, 33))
    return float(np.linalg.norm(distorted_pixels(intrinsics, distortion, grid) - grid, axis=-1).max())


def image_undistorter(
    intrinsics: Float[np.ndarray, "3 3"], distortion: Float[np.ndarray, "5"], height: int, width: int
) -> Callable[[UInt8[np.ndarray, "h w c"]], UInt8[np.ndarray, "h w c"]]:
    """Turns images of this lens into what a perfect one would have shown, of the same size and intrinsics.

    What no pixel showed repeats the nearest one.
    """
    return resampler(distorted_pixels(intrinsics, distortion, pixel_places(np.arange(height), np.arange(width))))


def resampler(
    source: Float[np.ndarray, "h w 2"],
) -> Callable[[UInt8[np.ndarray, "h w c"]], UInt8[np.ndarray, "h w c"]]:
    """Turns an image into one whose pixels show what it has at `source` (column, row), bilinear."""
    height, width = source.shape[:2]
    across, down = 2 * source[..., 0] / max(width - 1, 1) - 1, 2 * source[..., 1] / max(height - 1, 1) - 1
    where = torch.as_tensor(np.stack([across, down], -1)[None].astype(np.float32))

    def resample(image: UInt8[np.ndarray, "h w c"]) -> UInt8[np.ndarray, "h w c"]:
        planes = torch.as_tensor(image.astype(np.float32)).permute(2, 0, 1)[None]
        moved = torch.nn.functional.grid_sample(planes, where, padding_mode="border", align_corners=True)
        return moved[0].permute(1, 2, 0).round().clamp(0, 255).to(torch.uint8).numpy()

    return resample


def pixel_places(rows: np.ndarray, columns: np.ndarray) -> Float[np.ndarray, "h w 2"]:
    """(column, row) for each pair of them."""
    down, across = np.meshgrid(rows.astype(np.float64), columns.astype(np.float64), indexing="ij")
    return np.stack([across, down], -1)
