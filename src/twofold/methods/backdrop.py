"""Whether a capture's images still show what was behind the person."""

import numpy as np
from scipy import ndimage

from twofold.capture.types import Capture, spread
from twofold.errors import TwofoldError

_LOOKED_AT = 8
"""Training images looked at, evenly spread."""
_APART = 3
"""Pixels from the mask from which a pixel counts as background."""
_MIN_CHANGE = 2
"""Values out of 255 by which colours differ that are not one colour with the noise of a compressed file."""


def require_backdrop(capture: Capture) -> None:
    """Says no where all images have one colour outside the mask: there is nothing behind the person to learn.

    Raises:
        TwofoldError: the background of this capture was removed.
    """
    for frame in spread(capture.train, _LOOKED_AT):
        away = np.asarray(ndimage.distance_transform_edt(frame.mask().numpy() == 0))
        outside = frame.image().numpy()[away > _APART]
        if len(outside) and np.ptp(np.percentile(outside, (1, 99), axis=0), axis=0).max() * 255 > _MIN_CHANGE:
            return
    raise TwofoldError(
        f"{capture.folder} shows one colour behind the person, as if the background had been removed, and vid2avatar "
        "learns the person by telling it from a background; use images with their background, or the recipe "
        "vid2avatar_mask (or vid2avatar_mask_fast), which takes the masks."
    )
