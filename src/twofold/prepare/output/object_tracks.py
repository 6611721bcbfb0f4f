"""Which foreign patches of a mask are objects: those that move apart from the body, followed from frame to frame.

Colour alone cannot tell: where the fitted body is a little off, the person's own trousers lie where a shirt is
expected. A patch counts as an object only with three kinds of evidence: its colours are none of the person's own
anywhere around, it is seen in several frames, and meanwhile it moves relative to the body beneath it.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, UInt8
from scipy import ndimage

from twofold.prepare.output.held_objects import (
    SeenBody,
    object_mask,
    objects_beside,
    unlikeness,
)

MOST = 0.25
"""A frame of whose mask more is foreign is fitted badly as a whole; it tells nothing about objects."""
FOREIGN = 0.5
"""Share of a patch that has none of the person's own colours."""
OWN_COLOR, OWN_SHARE = 0.14, 0.01
"""A colour is the person's own if it is so near (mean of the channels, 0..1) to the usual colours of such a share of
the body around. Measured: a ball before a body has shares of 0 to 0.003, trousers where a shirt is expected above
0.015."""
AROUND = 0.35
"""A fitted limb may be off by so much, metres: its usual colours count so far around a patch."""
APART = 0.2
"""An object moves relative to the body by so much, metres, while it is followed; patches that come of a bad fit move
with the body but for some centimetres."""
SIGHTINGS = 3
"""Frames in which an object is seen at least."""
_SPEED, _REACH, _PAUSE = 6.0, 0.15, 0.3
"""Metres a second, metres and seconds within which a patch is the same as one in an earlier frame."""
_LIKE, _GROWTH = 0.2, 3.0
"""Difference of colours and ratio of areas up to which it is."""
_ANCHORS = 10
"""Every tenth vertex stands for the body beneath patches."""


@dataclass(frozen=True)
class Patch:
    """A foreign patch in one image.

    Attributes:
        corner: first row and column of its window.
        hidden: which pixels of the window it takes up.
        beside: those of these that stick out of the body.
        center: column and row, pixels.
        color: median, 0..1.
        area: square metres.
        foreign: share of its pixels that have none of the person's own colours.
    """

    corner: tuple[int, int]
    hidden: Bool[np.ndarray, "a b"]
    beside: Bool[np.ndarray, "a b"]
    center: Float[np.ndarray, "2"]
    color: Float[np.ndarray, "3"]
    area: float
    foreign: float

    @property
    def window(self) -> tuple[slice, slice]:
        """Its rows and columns in the image."""
        (row, column), (height, width) = self.corner, self.hidden.shape
        return slice(row, row + height), slice(column, column + width)


@dataclass(frozen=True)
class Sighting:
    """What is foreign in one image.

    Attributes:
        patches: that may be objects.
        anchors: where every tenth vertex of the body is, pixels (column, row).
        pixels_per_metre: at the body's distance.
    """

    patches: tuple[Patch, ...]
    anchors: Float[np.ndarray, "n 2"]
    pixels_per_metre: float


def foreign_patches(
    mask: UInt8[np.ndarray, "h w"],
    image: UInt8[np.ndarray, "h w 3"],
    seen: SeenBody,
    usual: Float[np.ndarray, "V 3"],
    trusted: Bool[np.ndarray, "V"],
) -> Sighting:
    """Patches of a mask, or near it, that stick out of the body or have other colours than the body beneath.

    Args:
        mask: as estimated, 0..255.
        image: the image.
        seen: the fitted body in it.
        usual: colours of the body's vertices, 0..1 (`usual_colors`).
        trusted: which of these are known.
    """
    anchors = seen.pixels[::_ANCHORS].astype(np.float32)
    if not (mask > 127).any():
        return Sighting((), anchors, seen.pixels_per_metre)
    part = _part(mask, seen)
    corner = np.array([part[0].start, part[1].start])
    seen = replace(
        seen, top=(seen.top[0] - int(corner[0]), seen.top[1] - int(corner[1])), pixels=seen.pixels - corner[::-1]
    )
    image, person = image[part], mask[part] > 127
    unlike = unlikeness(image, person, seen, usual, trusted)
    beside = objects_beside(person, seen, unlike)
    hidden = object_mask(image, person, seen, unlike, beside)
    share = float((hidden & person).sum() / max(person.sum(), 1))
    patches: list[Patch] = []
    if 0 < share <= MOST:
        labels = np.zeros(person.shape, np.int32)
        ndimage.label(hidden, output=labels)
        for number, window in enumerate(ndimage.find_objects(labels)):
            patch = _patch(labels[window] == number + 1, window, image, beside, seen, usual, trusted)
            place = patch.corner[0] + int(corner[0]), patch.corner[1] + int(corner[1])
            patches.append(replace(patch, corner=place, center=patch.center + corner[::-1].astype(np.float32)))
    return Sighting(tuple(patches), anchors, seen.pixels_per_metre)


def _part(mask: UInt8[np.ndarray, "h w"], seen: SeenBody) -> tuple[slice, slice]:
    """The part of an image that body and mask take up: nothing else is looked at."""
    rows, columns = (np.flatnonzero((mask > 127).any(axis)) for axis in (1, 0))
    down, across = seen.window
    margin = int(0.15 * seen.pixels_per_metre) + 2
    top = max(min(down.start, int(rows[0])) - margin, 0)
    left = max(min(across.start, int(columns[0])) - margin, 0)
    bottom = min(max(down.stop, int(rows[-1]) + 1) + margin, mask.shape[0])
    right = min(max(across.stop, int(columns[-1]) + 1) + margin, mask.shape[1])
    return slice(top, bottom), slice(left, right)


def _patch(
    hidden: Bool[np.ndarray, "a b"],
    window: tuple[slice, slice],
    image: UInt8[np.ndarray, "h w 3"],
    beside: Bool[np.ndarray, "h w"],
    seen: SeenBody,
    usual: Float[np.ndarray, "V 3"],
    trusted: Bool[np.ndarray, "V"],
) -> Patch:
    rows, columns = np.nonzero(hidden)
    corner = window[0].start, window[1].start
    places = np.stack([columns + corner[1], rows + corner[0]], -1)
    center = places.mean(0)
    shown = image[window][hidden].astype(np.float32) / 255
    reach = AROUND * seen.pixels_per_metre + np.linalg.norm(places - center, axis=1).max()
    near = trusted & (np.linalg.norm(seen.pixels - center, axis=1) <= reach)
    return Patch(
        corner, hidden, beside[window] & hidden, center.astype(np.float32), np.median(shown, axis=0),
        len(places) / seen.pixels_per_metre**2, _foreign(shown, usual[near]),
    )  # fmt: skip


def _foreign(shown: Float[np.ndarray, "n 3"], own: Float[np.ndarray, "k 3"]) -> float:
    """The share of colours that hardly any part of the body around has."""
    if not len(own):
        return 1.0
    some, parts = shown[:: max(1, len(shown) // 300)], own[:: max(1, len(own) // 1500)]
    support = (np.abs(some[:, None] - parts).mean(-1) <= OWN_COLOR).mean(1)
    return float((support < OWN_SHARE).mean())


def moving_objects(
    sightings: Sequence[Sighting | None], seconds: Sequence[float] | Float[np.ndarray, "t"]
) -> list[tuple[Patch, ...]]:
    """For each image the patches that are objects.

    Args:
        sightings: of each image in order; None where nothing is known.
        seconds: when these were taken.
    """
    tracks: list[list[tuple[int, Patch]]] = []
    for number, sighting in enumerate(sightings):
        open_tracks = [t for t in tracks if seconds[number] - seconds[t[-1][0]] <= max(_PAUSE, _gap(seconds, number))]
        for patch in () if sighting is None else sighting.patches:
            costs = [_distance(track[-1], (number, patch), sightings, seconds) for track in open_tracks]
            best = int(np.argmin(costs)) if costs else -1
            if best >= 0 and np.isfinite(costs[best]):
                open_tracks.pop(best).append((number, patch))
            else:
                tracks.append([(number, patch)])
    found: list[list[Patch]] = [[] for _ in sightings]
    for track in tracks:
        if _is_object(track, sightings):
            for number, patch in track:
                found[number].append(patch)
    return [tuple(patches) for patches in found]


def _gap(seconds: Sequence[float] | Float[np.ndarray, "t"], number: int) -> float:
    """The time since the image before, and a little."""
    return 1.01 * (seconds[number] - seconds[number - 1]) if number else 0.0


def _distance(
    before: tuple[int, Patch],
    now: tuple[int, Patch],
    sightings: Sequence[Sighting | None],
    seconds: Sequence[float] | Float[np.ndarray, "t"],
) -> float:
    """How far a patch moved, metres; infinite if it cannot be the same."""
    (earlier, one), (later, other) = before, now
    sighting = sightings[later]
    assert sighting is not None
    moved = float(np.linalg.norm(other.center - one.center)) / sighting.pixels_per_metre
    ratio = max(one.area, other.area) / max(min(one.area, other.area), 1e-9)
    alike = float(np.abs(one.color - other.color).mean()) <= _LIKE and ratio <= _GROWTH
    return moved if alike and moved <= _REACH + _SPEED * (seconds[later] - seconds[earlier]) else np.inf


def _is_object(track: Sequence[tuple[int, Patch]], sightings: Sequence[Sighting | None]) -> bool:
    if len(track) < SIGHTINGS or np.median([patch.foreign for _, patch in track]) < FOREIGN:
        return False
    return moved_apart(track, sightings) >= APART


def moved_apart(track: Sequence[tuple[int, Patch]], sightings: Sequence[Sighting | None]) -> float:
    """How far a patch moves relative to the body beneath it, at most, metres.

    From each image of a track to each later one the anchors nearest to the patch say how the body moves there.
    """
    farthest = 0.0
    some = [track[i] for i in np.unique(np.linspace(0, len(track) - 1, min(len(track), 12)).round().astype(int))]
    for place, (earlier, one) in enumerate(some):
        here = sightings[earlier]
        assert here is not None
        away = np.linalg.norm(here.anchors - one.center, axis=1)
        beneath = np.argsort(away)[:12]
        for later, other in some[place + 1 :]:
            there = sightings[later]
            assert there is not None
            with_body = (there.anchors[beneath] - here.anchors[beneath]).mean(0)
            apart = np.linalg.norm(other.center - one.center - with_body) / there.pixels_per_metre
            farthest = max(farthest, float(apart))
    return farthest


def without(
    mask: UInt8[np.ndarray, "h w"], objects: Sequence[Patch]
) -> tuple[UInt8[np.ndarray, "h w"], Bool[np.ndarray, "h w"], float]:
    """A mask without what sticks out of the body, the pixels that objects hide, and their share of the mask."""
    hidden, cleaned = np.zeros(mask.shape, dtype=bool), mask.copy()
    for patch in objects:
        hidden[patch.window] |= patch.hidden
        cleaned[patch.window][patch.beside] = 0
    person = mask > 127
    return cleaned, hidden, float((hidden & person).sum() / max(person.sum(), 1))
