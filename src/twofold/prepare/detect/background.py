"""How the background of a camera's images moves: the one measure of a camera that does not stand still.

A shift counts only if it is verified: the backgrounds, laid over each other by it, must look alike. Otherwise nothing
is known, which is not the same as no motion.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, UInt8
from PIL import Image
from scipy import ndimage

SIZE = 240
"""Longest side at which backgrounds are compared, pixels."""
MOVING = 0.01
"""A background that moves farther, in lengths of the image's longer side, is that of a moving camera."""
PLAIN = 0.01
"""A background whose details deviate by less (0..1) has nothing in it that could be seen to move."""
ALIKE = 0.5
"""Correlation from which on two backgrounds, laid over each other, are the same place."""
BETTER = 0.7
"""A shift leaves less than this share of the residual (1 - correlation) that no shift leaves."""
OVERLAP = 0.35
"""Share of the image in which two backgrounds must overlap."""


@dataclass(frozen=True)
class Surroundings:
    """A small grey image without its person.

    Attributes:
        grey: brightness, 0..1.
        details: the same without what changes slowly over the image, such as shadows and exposure; 0 on the person.
        beside: pixels well away from the person.
        scale: pixels of the image in one of its pixels.
    """

    grey: Float[np.ndarray, "a b"]
    details: Float[np.ndarray, "a b"]
    beside: Bool[np.ndarray, "a b"]
    scale: float

    @property
    def plain(self) -> bool:
        """There is nothing in it that could be seen to move."""
        few = np.count_nonzero(self.beside) < 0.1 * self.beside.size
        return few or float(self.details[self.beside].std()) < PLAIN


@dataclass(frozen=True)
class BackgroundMotion:
    """How the background moves through a clip.

    Attributes:
        places: of each image's background relative to the first: down and right, pixels; None where it is not known.
        moved: the largest distance between any two of them, pixels; None where nothing could be compared.
    """

    places: tuple[tuple[float, float] | None, ...]
    moved: float | None


def surroundings(image: Image.Image, mask: Image.Image) -> Surroundings:
    """What can be compared of an image and its mask (255 on the person)."""
    scale = max(1.0, max(image.size) / SIZE)
    size = (max(round(image.width / scale), 1), max(round(image.height / scale), 1))
    grey = np.asarray(image.convert("L").resize(size, Image.Resampling.BOX), np.float32) / np.float32(255)
    person = np.asarray(mask.convert("L").resize(size, Image.Resampling.BOX)) > 16
    beside = ~np.asarray(ndimage.binary_dilation(person, iterations=max(round(0.02 * max(size)), 1)), dtype=bool)
    return Surroundings(grey, _details(grey, beside), beside, scale)


def _details(grey: Float[np.ndarray, "a b"], beside: Bool[np.ndarray, "a b"]) -> Float[np.ndarray, "a b"]:
    """Slightly blurred brightness less the mean around it, of the background alone."""
    weight = beside.astype(np.float32)
    fine, coarse = (
        ndimage.gaussian_filter(grey * weight, sigma) / np.maximum(ndimage.gaussian_filter(weight, sigma), 1e-3)
        for sigma in (0.8, 8.0)
    )
    return np.where(beside, fine - coarse, 0).astype(np.float32)


def shift_between(first: Surroundings, other: Surroundings) -> tuple[int, int] | None:
    """How far the second background lies from the first (down, right), small pixels; None where it is unknown.

    Masked phase correlation (Padfield 2012) proposes a shift. It counts where the backgrounds correlate by `ALIKE` then
    and the residual is less than `BETTER` of what no shift leaves; no motion counts where they correlate without one.
    """
    from skimage.registration import phase_cross_correlation

    if first.plain or other.plain or first.grey.shape != other.grey.shape:
        return None
    still = correlation(first, other, (0, 0))
    found = phase_cross_correlation(
        first.details, other.details, reference_mask=first.beside, moving_mask=other.beside, overlap_ratio=OVERLAP
    )
    around = [(-round(float(found[0][0])) + a, -round(float(found[0][1])) + b) for a in (0, -1, 1) for b in (0, -1, 1)]
    # Over large shifts phase correlation is off by a pixel.
    correlations = [correlation(first, other, step) for step in around]
    moved = max(correlations)
    down, right = around[correlations.index(moved)]
    if (down, right) != (0, 0) and moved >= ALIKE and 1 - moved < BETTER * (1 - still):
        return down, right
    return (0, 0) if still >= ALIKE else None


def correlation(first: Surroundings, other: Surroundings, shift: tuple[int, int]) -> float:
    """Of the details of two backgrounds, the second laid back by `shift` (down, right): -1 to 1; 0 without overlap."""
    height, width = first.grey.shape
    down, right = shift
    here = slice(max(-down, 0), height - max(down, 0)), slice(max(-right, 0), width - max(right, 0))
    there = slice(max(down, 0), height + min(down, 0)), slice(max(right, 0), width + min(right, 0))
    both = first.beside[here] & other.beside[there]
    if np.count_nonzero(both) < 0.1 * both.size or both.size < OVERLAP * height * width:
        return 0.0
    one, two = (view - view.mean() for view in (first.details[here][both], other.details[there][both]))
    return float((one * two).sum() / max(math.sqrt(float((one * one).sum() * (two * two).sum())), 1e-9))


def background_motion(views: Sequence[Surroundings]) -> BackgroundMotion:
    """Follows the background through images of one camera, in order.

    Each image is compared with a reference, at first the first one; where the camera has moved too far from it, with
    the last one that is known, which is the reference from then on.
    """
    places: list[tuple[float, float] | None] = [(0.0, 0.0)] if views else []
    reference = last = 0
    for number in range(1, len(views)):
        place: tuple[float, float] | None = None
        for start in dict.fromkeys((reference, last)):
            shift, origin = shift_between(views[start], views[number]), places[start]
            if shift is not None and origin is not None:
                scale = views[number].scale
                place = origin[0] + scale * shift[0], origin[1] + scale * shift[1]
                reference = start
                break
        last = number if place is not None else last
        places.append(place)
    known = np.array([place for place in places if place is not None])
    if len(known) < 2 or len(known) < 0.5 * len(views):
        return BackgroundMotion(tuple(places), None)
    apart = np.linalg.norm(known[:, None] - known, axis=-1)
    return BackgroundMotion(tuple(places), float(apart.max()))


def surroundings_of(image: UInt8[np.ndarray, "h w 3"], mask: UInt8[np.ndarray, "h w"]) -> Surroundings:
    """`surroundings` of arrays."""
    return surroundings(Image.fromarray(image), Image.fromarray(mask))
