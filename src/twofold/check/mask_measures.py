"""What a mask shows by itself: how hard and how rough its edge is, whether it is cut off, in pieces or inverted."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import UInt8
from scipy import ndimage

ENOUGH = 240
"""Rows of a person in which a ragged outline shows."""
SOFT = (0.1, 0.9)
"""Between these a pixel is neither person nor surroundings."""


@dataclass(frozen=True)
class MaskFacts:
    """What one mask shows.

    Attributes:
        share: of the image that the person covers.
        softness: width of the soft edge, pixels; 0 for a mask of black and white alone.
        roughness: how far the edge deviates from a smooth one, as a share of the person's height.
        grain: steps of the outline, pixels: 1 for a mask made at its own size, 8 for one enlarged eightfold.
        borders: sides of the image that the mask runs into: "left", "top", "right", "bottom".
        pieces: connected parts that matter.
        loose: share of the mask that does not hang together with the largest part.
        border_share: share of the image's border that the mask covers.
    """

    share: float
    softness: float
    roughness: float
    grain: float
    borders: tuple[str, ...]
    pieces: int
    loose: float
    border_share: float


def mask_facts(mask: UInt8[np.ndarray, "h w"]) -> MaskFacts:
    """Measures one mask, 0 outside .. 255 on the person."""
    height, width = mask.shape
    person = mask > 127
    rows, columns = np.flatnonzero(person.any(1)), np.flatnonzero(person.any(0))
    if not len(rows):
        return MaskFacts(0.0, 0.0, 0.0, 0.0, (), 0, 0.0, 0.0)
    part = (slice(max(rows[0] - 8, 0), rows[-1] + 9), slice(max(columns[0] - 8, 0), columns[-1] + 9))
    inner, tall = person[part], int(rows[-1] - rows[0]) + 1
    outline = max(np.count_nonzero(inner & ~np.asarray(ndimage.binary_erosion(inner, border_value=1), dtype=bool)), 1)
    grey = np.count_nonzero((mask > 255 * SOFT[0]) & (mask < 255 * SOFT[1]))
    sizes = _piece_sizes(inner)
    ends = {"left": person[:, 0], "top": person[0], "right": person[:, -1], "bottom": person[-1]}
    # A single pixel on the border is no cropped limb.
    least = max(2, round(0.01 * tall))
    return MaskFacts(
        share=float(person.mean()),
        softness=grey / outline,
        roughness=_roughness(inner, tall, outline),
        grain=_grain(inner),
        borders=tuple(name for name, end in ends.items() if np.count_nonzero(end) >= least),
        pieces=int((sizes >= 0.01 * sizes.sum()).sum()),
        loose=float(1 - sizes.max() / sizes.sum()),
        border_share=sum(map(np.count_nonzero, ends.values())) / (2 * (height + width)),
    )


def _piece_sizes(person: np.ndarray) -> np.ndarray:
    labels = np.zeros(person.shape, np.int32)
    ndimage.label(person, np.ones((3, 3), int), output=labels)
    return np.bincount(labels.ravel())[1:]


def _roughness(person: np.ndarray, tall: int, outline: int) -> float:
    """Area between the outline and a smoothed one, over the outline's length, over the person's height."""
    if tall > 2 * ENOUGH:
        # Finer than this no raggedness is looked for, and smoothing large masks would take longest of all.
        step = tall // ENOUGH
        person = person[::step, ::step]
        return _roughness(person, tall // step, max(outline // step, 1))
    smooth = np.asarray(ndimage.gaussian_filter(person.astype(np.float32), 0.008 * tall, mode="nearest")) > 0.5
    return np.count_nonzero(smooth ^ person) / outline / tall


def _grain(person: np.ndarray) -> float:
    """Columns and rows of the person over those at which the outline has a step."""
    grains: list[float] = []
    for axis in (0, 1):
        extent = np.count_nonzero(person.any(1 - axis))
        steps = np.count_nonzero(
            (person[1:] != person[:-1]).any(1) if axis == 0 else (person[:, 1:] != person[:, :-1]).any(0)
        )
        grains.append(extent / max(steps, 1))
    return min(grains)
