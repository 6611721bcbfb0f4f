"""Which image of a clip a numbered file belongs to: every way to read the numbers, and which of them is true."""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float

from twofold.errors import TwofoldError
from twofold.prepare.video.frames import ClipInfo

_SLOWEST = 5
"""Exports of every second to every fifth image are thought of."""
_CERTAIN = 3.0
"""A reading is true that is better than the next by this many standard errors."""
_ENOUGH = 5
"""Images on which two readings can be compared."""


@dataclass(frozen=True)
class Numbering:
    """One way to read the numbers of files.

    Attributes:
        words: what it takes them for, for messages: "counted from 0".
        places: files by `VideoFrame.source`.
    """

    words: str
    places: Mapping[int, Path]


def numberings(files: Sequence[Path], info: ClipInfo, what: str) -> list[Numbering]:
    """Every way in which files can belong to the images of a clip; the likeliest first.

    By name, if the clip is a folder whose images are called the same; else by the last number in the name, counted from
    0 or 1, or numbered anew after an export of every second (third, ...) image; else, where there are no such numbers
    or they are too large, in natural order, one for each image.

    Args:
        files: in natural order, all of one folder.
        info: the clip.
        what: they are, for the sentences: "masks".

    Raises:
        TwofoldError: they belong to no image, or there is another number of them.
    """
    places = {name: place for place, name in enumerate(info.names)}
    if len(places) == len(info.names) and all(path.stem in places for path in files):
        return [Numbering("named as the images", {places[path.stem]: path for path in files})]
    last_numbers = [re.findall(r"[0-9]+", path.stem)[-1:] for path in files]
    numbers = [int(found[0]) for found in last_numbers if found]
    numbered = len(set(numbers)) == len(files)
    slack = max(1, info.sources // 50)  # Some programs lose an image at the end, or decode one more.
    found = _by_number(files, numbers, info.sources, slack) if numbered else []
    if found:
        return found
    if abs(len(files) - info.sources) <= slack:
        return _in_order(files, info.sources)
    range_of = f", numbered from {min(numbers)} to {max(numbers)}" if numbered else ""
    raise TwofoldError(
        f"{files[0].parent} holds {len(files)} {what}{range_of}, and the clip has {info.sources} images; number them "
        "as its images are, from 0, or give one for each."
    )


def _by_number(files: Sequence[Path], numbers: Sequence[int], sources: int, slack: int) -> list[Numbering]:
    low, high, count = min(numbers), max(numbers), len(numbers)
    found: list[Numbering] = []
    from_one = low == 1 or (low > 1 and high >= sources)
    for first in (1, 0) if from_one else (0, 1):
        # With room for numbers beyond the end only where nothing else fits.
        if low >= first and high - first < sources + (0 if found else slack):
            words = f"counted from {first}"
            found.append(Numbering(words, {n - first: path for n, path in zip(numbers, files, strict=True)}))
    if found and high - low + 1 == count and low <= 1:
        for every in range(2, _SLOWEST + 1):
            if (count - 1) * every < sources <= (count + 1) * every:
                words = f"one for every {every} images"
                found.append(Numbering(words, {(n - low) * every: p for n, p in zip(numbers, files, strict=True)}))
    return found


def _in_order(files: Sequence[Path], sources: int) -> list[Numbering]:
    """One after the other; where some are missing, they may be missing at the start or at the end."""
    found = [Numbering("in order from the first image", dict(enumerate(files)))]
    if (missing := sources - len(files)) > 0:
        found.append(Numbering("in order up to the last image", {n + missing: p for n, p in enumerate(files)}))
    return found


def files_by_picture(files: Sequence[Path], info: ClipInfo, what: str) -> Mapping[int, Path]:
    """Files by image in the likeliest reading; see `numberings`."""
    return numberings(files, info, what)[0].places


def best_reading(scores: Sequence[Float[np.ndarray, "t"]]) -> tuple[int, bool]:
    """Which of several readings fits best, and whether that is certain.

    Args:
        scores: of each reading, how well its files agree with each image, NaN where it has none. Readings are compared
            on the images that both have a score for, where there are enough of them.

    Returns:
        Its place (0 where nothing is certain), and whether it is better than each other one by three standard errors.

    >>> best_reading([np.array([0.5, 0.6, 0.5, 0.6, 0.5]), np.array([0.9, 0.8, 0.9, 0.9, 0.8])])
    (1, True)
    """
    means = [float(np.nanmean(s)) if np.isfinite(s).any() else -np.inf for s in scores]
    best = int(np.argmax(means))
    certain = all(_better(scores[best], other) for place, other in enumerate(scores) if place != best)
    return (best, True) if certain else (0, False)


def _better(one: Float[np.ndarray, "t"], other: Float[np.ndarray, "t"]) -> bool:
    both = np.isfinite(one) & np.isfinite(other)
    if np.count_nonzero(both) >= max(_ENOUGH, 0.5 * np.isfinite(other).sum()):
        change = one[both] - other[both]
        error = change.std() / np.sqrt(len(change))
        return bool(change.mean() > max(_CERTAIN * error, 1e-6))
    a, b = one[np.isfinite(one)], other[np.isfinite(other)]
    if len(a) < _ENOUGH or len(b) < _ENOUGH:
        return False
    error = float(np.hypot(a.std() / np.sqrt(len(a)), b.std() / np.sqrt(len(b))))
    return bool(a.mean() - b.mean() > max(_CERTAIN * error, 1e-6))
