"""Feature grids as fine as what the training images show."""

from dataclasses import replace

import torch

from twofold.capture.types import Capture
from twofold.field.factorized_grid import GridFieldConfig

FINEST = 0.005
"""Finest spacing that is added, metres: wrong poses and masks blur more than finer ones could show."""
FINEST_RADIUS = 0.04
"""How far from the body an added spacing has features, metres; cloth that hangs further away has no such detail."""


def pixel_size(capture: Capture) -> float:
    r"""What a pixel of the training images covers at the person, metres.

    \[ p = \operatorname{median}_t \frac{z_t}{f_t} \]

    with the depth $z$ of the root joint in front of the camera, metres, and its focal length $f$, pixels.

    Args:
        capture: whose training images count.
    """
    root = capture.body.joints[0]
    sizes = []
    for frame in capture.train:
        rotation, shift = frame.camera.world_to_camera[:3, :3], frame.camera.world_to_camera[:3, 3]
        depth = (rotation @ (root + frame.translation) + shift)[2]
        sizes.append(depth / frame.camera.intrinsics[0, 0])
    return float(torch.stack(sizes).median())


def levels_for(voxels: tuple[float, ...], pixel: float) -> tuple[float, ...]:
    """Spacings with halves of the finest one added, metres, as long as these are no smaller than a pixel and 5 mm.

    >>> levels_for((0.02, 0.01), 0.0038), levels_for((0.02, 0.01), 0.0125)
    ((0.02, 0.01, 0.005), (0.02, 0.01))

    Args:
        voxels: spacings, metres.
        pixel: what a pixel covers, metres.
    """
    levels = list(voxels)
    while min(levels) / 2 >= max(pixel, FINEST):
        levels.append(min(levels) / 2)
    return tuple(levels)


def following(field: GridFieldConfig, capture: Capture) -> tuple[GridFieldConfig, str | None]:
    """The grids for a capture where `field.follow_images` asks for it, and what to tell the user about them.

    Args:
        field: as the recipe has it.
        capture: to be trained on.
    """
    if not field.follow_images:
        return field, None
    pixel = pixel_size(capture)
    levels = levels_for(field.high_voxels, pixel)
    settled = replace(field, high_voxels=levels, follow_images=False)
    if levels == field.high_voxels:
        return settled, None
    radius = min(field.finest_radius or FINEST_RADIUS, field.radius)
    note = (
        f"A pixel covers {1000 * pixel:.1f} mm of the person, so the feature grids end at {1000 * min(levels):g} mm "
        f"instead of {1000 * min(field.high_voxels):g} mm; --set method.field.follow_images=false makes steps shorter "
        "and images softer."
    )
    return replace(settled, finest_radius=radius), note
