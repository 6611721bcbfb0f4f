"""The focal length that a file states: of a full-frame camera with the same view, as phones and cameras note it."""

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from twofold.images import load_image

FULL_FRAME = 36.0
"""Longer side of the film of a full-frame camera, millimetres."""
SHORTEST, LONGEST = 8.0, 800.0
"""Millimetres: what lies beyond is no lens for people, but a note that was never filled in."""

_QUICKTIME = "camera.focal_length.35mm_equivalent"
_EXIF, _FOCAL_35MM = 0x8769, 0xA405


def focal_share(millimeters: object) -> float | None:
    """Focal length over the longer side of the image, from a full-frame equivalent; None where that makes no sense.

    >>> focal_share("27"), focal_share(0), focal_share("none")
    (0.75, None, None)
    """
    try:
        number = float(millimeters)  # pyright: ignore[reportArgumentType]
    except (TypeError, ValueError, ZeroDivisionError):
        return None
    return number / FULL_FRAME if math.isfinite(number) and SHORTEST <= number <= LONGEST else None


def focal_of_video(tags: Mapping[str, Any]) -> float | None:
    """What the tags of a video or of its track state, as phones write them (`com.apple.quicktime...`)."""
    for name, value in tags.items():
        if name.lower().endswith(_QUICKTIME):
            return focal_share(value)
    return None


def focal_of_image(path: Path) -> float | None:
    """What the EXIF data of an image state (FocalLengthIn35mmFilm).

    Raises:
        TwofoldError: it cannot be decoded.
    """
    return focal_share(load_image(path).getexif().get_ifd(_EXIF).get(_FOCAL_35MM))
