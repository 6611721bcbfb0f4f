"""Which other convention would make bodies cover their masks: axes, sides, units, translations, images, frames.

Every guess moves the same points of the body's surface, so that hundreds of guesses cost less than a second.
"""

import math
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from twofold.body.skeleton import ShapedBody
from twofold.capture.types import Frame
from twofold.check.convention_candidates import CONVENTIONS, Convention, Placed, sizes
from twofold.check.frame_measures import TWIN_SIZE, posed_points, read_mask, splat, window_of
from twofold.geometry.silhouettes import overlap

AROUND = 0.5
"""The window reaches beyond the mask by so much of its longer side; a body drawn farther off counts as missing it."""
MIN_GAIN, MIN_GAIN_WHERE_GOOD, MIN_GAIN_OF_MOVING = 0.1, 0.06, 0.02
"""A guess must raise the mean IoU by so much to be named. Where bodies fit well already less will do: the fits of real
people leave 0.01 to such guesses; about the translation less still, because some conventions differ by centimetres."""
GOOD_ENOUGH = 0.55
"""A guess below this explains nothing: unrelated shapes of people overlap by up to a half."""
ALMOST_AS_GOOD = 0.02
"""Guesses this close are the same for all a silhouette can tell; the more usual one, earlier in the list, is named."""
IN_MOST = 0.75
"""Share of the frames in which a guess must be better."""
EXCHANGED, EXCHANGED_GAIN = 0.7, 0.15
"""An image shows another frame's pose where that fits so well, and so much better than its own."""
MAX_PAIRS = 16
"""This many of some seven hundred pairs are tried on all frames."""
MOMENTS = 5
"""Up to this many frames early or late are tried."""


@dataclass(frozen=True)
class Sample:
    """A frame to try guesses on.

    Attributes:
        placed: as the capture has it.
        mask: in the window around the person.
        known: pixels of the window that are not ignored.
        to_window: from pixels of the image to pixels of the window.
        frame_index: which frame of the capture.
    """

    placed: Placed
    mask: Bool[np.ndarray, "a b"]
    known: Bool[np.ndarray, "a b"]
    to_window: Float[Tensor, "3 3"]
    frame_index: int

    def fit(self, placed: Placed) -> float:
        """Silhouette IoU, drawn roughly."""
        in_camera = placed.points @ placed.world_to_camera[:3, :3].T + placed.world_to_camera[:3, 3]
        homogeneous = in_camera @ (self.to_window @ placed.intrinsics).T
        depth = in_camera[:, 2]
        pixels = homogeneous[:, :2] / depth.clamp_min(1e-6)[:, None]
        drawn = splat(pixels, depth, *self.mask.shape)
        return overlap(self.mask & self.known, drawn & self.known)


@dataclass(frozen=True)
class Diagnosis:
    """What would fix a capture, as far as silhouettes can tell.

    Attributes:
        given: mean IoU as the capture is, drawn roughly.
        conventions: one or two that fit better together; none where nothing usual does.
        iou: mean IoU with them.
        better_in: share of the frames in which they fit better, of those where they fit otherwise.
    """

    given: float
    conventions: tuple[Convention, ...]
    iou: float
    better_in: float


def sample_of(frame: Frame, points: ShapedBody) -> Sample:
    """A frame with its mask, ready for guesses (`points` as `surface_points` gives them)."""
    mask = read_mask(frame)
    window = window_of(frame.camera, mask, torch.empty(0, 2), TWIN_SIZE, AROUND)
    left, top, right, bottom = window.box
    x, y = window.camera.width / (right - left), window.camera.height / (bottom - top)
    to_window = torch.tensor(
        [[x, 0, x * (0.5 - left) - 0.5], [0, y, y * (0.5 - top) - 0.5], [0, 0, 1]], dtype=torch.float32
    )
    ignored = frame.ignored().numpy().astype(np.uint8) * 255
    camera = frame.camera
    placed = Placed(
        posed_points(points, frame.pose, frame.translation), points, frame.pose, frame.translation,
        camera.world_to_camera, camera.intrinsics, camera.height, camera.width,
    )  # fmt: skip
    return Sample(placed, window.mask(mask), ~window.mask(ignored), to_window, frame.frame_index)


def diagnose(samples: Sequence[Sample], size_ratio: float = 1.0) -> Diagnosis:
    """Tries the usual conventions, alone and, where none alone will do, in pairs.

    Args:
        samples: frames spread over the capture.
        size_ratio: of the mask to the body, in length, as measured; that size is tried, too.
    """
    guesses = [*CONVENTIONS, *sizes(size_ratio)]
    given = np.array([s.fit(s.placed) for s in samples])
    fits: dict[tuple[Convention, ...], np.ndarray] = {(c,): _fits(samples, (c,)) for c in guesses}
    best = _best(fits)
    if max(given.mean(), fits[best].mean()) < GOOD_ENOUGH:
        fits |= {pair: _fits(samples, pair) for pair in _likely_pairs(samples, guesses)}
        best = _best(fits)
    found = fits[best]
    # Some conventions differ in some frames alone, such as those where the root is turned.
    different = np.abs(found - given) > 0.005
    better_in = float((found > given)[different].mean()) if different.any() else 0.0
    gain = MIN_GAIN_WHERE_GOOD if given.mean() > GOOD_ENOUGH else MIN_GAIN
    if given.mean() > GOOD_ENOUGH and all(c.family == "translation" for c in best):
        gain = MIN_GAIN_OF_MOVING
    if found.mean() < max(given.mean() + gain, GOOD_ENOUGH) or better_in < IN_MOST:
        best = ()
    return Diagnosis(float(given.mean()), best, float(found.mean()), better_in)


def best_shift(
    samples: Sequence[Sample], poses: Float[Tensor, "T 24 3"], translations: Float[Tensor, "T 3"]
) -> tuple[int, float, float]:
    """By how many frames the motion is late (or early, below 0), judged by which poses fit the masks best.

    Returns:
        the number of frames, by how much the mean IoU rises with it, and in what share of the frames it does; 0
        frames where no other number is better beyond doubt.
    """
    shifts = [k for k in range(-MOMENTS, MOMENTS + 1) if k]
    usable = [s for s in samples if MOMENTS <= s.frame_index < len(poses) - MOMENTS]
    if len(usable) < 6:
        return 0, 0.0, 0.0
    given = np.array([s.fit(s.placed) for s in usable])
    gains: dict[int, np.ndarray] = {}
    for k in shifts:
        moved = [
            replace(s.placed, translation=translations[s.frame_index + k]).posed(poses[s.frame_index + k])
            for s in usable
        ]
        gains[k] = np.array([s.fit(p) for s, p in zip(usable, moved, strict=True)]) - given
    k = max(shifts, key=lambda k: gains[k].mean())
    gain, better = float(gains[k].mean()), float((gains[k] > 0).mean())
    doubt = float(gains[k].std(ddof=1)) / math.sqrt(len(usable))
    return (k, gain, better) if gain > max(0.015, 3 * doubt) and better >= IN_MOST else (0, 0.0, 0.0)


def poses_elsewhere(
    samples: Sequence[Sample],
    times: Sequence[int],
    poses: Float[Tensor, "T 24 3"],
    translations: Float[Tensor, "T 3"],
) -> list[int | None]:
    """For each badly fitting frame the frame whose pose it shows instead; None where no pose of `times` fits well."""
    found: list[int | None] = []
    for sample in samples:
        moved = [replace(sample.placed, translation=translations[t]).posed(poses[t]) for t in times]
        fits = [sample.fit(placed) for placed in moved]
        best = int(np.argmax(fits)) if fits else 0
        good = bool(fits) and fits[best] > max(EXCHANGED, sample.fit(sample.placed) + EXCHANGED_GAIN)
        found.append(times[best] if good and abs(times[best] - sample.frame_index) > 1 else None)
    return found


def _likely_pairs(samples: Sequence[Sample], guesses: Sequence[Convention]) -> list[tuple[Convention, Convention]]:
    """Pairs of conventions that fit best, judged by a few frames and a part of the points."""
    # A pose must be worked out anew for each guess, and who exchanges sides seldom errs elsewhere, too.
    able = [c for c in guesses if c.family != "pose"]
    rough: dict[tuple[Convention, Convention], float] = defaultdict(float)
    for sample in samples[:: max(len(samples) // 3, 1)][:3]:
        few = replace(sample.placed, points=sample.placed.points[::4])
        for i, one in enumerate(able):
            changed = one.change(few)
            for other in able[i + 1 :]:
                if one.family != other.family:
                    rough[one, other] += sample.fit(other.change(changed))
    likely = sorted(rough, key=lambda pair: -rough[pair])[:MAX_PAIRS]
    return [pair for pair in rough if pair in likely]


def _fits(samples: Sequence[Sample], conventions: tuple[Convention, ...]) -> np.ndarray:
    fits: list[float] = []
    for sample in samples:
        placed = sample.placed
        for convention in conventions:
            placed = convention.change(placed)
        fits.append(sample.fit(placed))
    return np.array(fits)


def _best(fits: Mapping[tuple[Convention, ...], np.ndarray]) -> tuple[Convention, ...]:
    """The first of those that are as good as the best."""
    most = max(values.mean() for values in fits.values())
    return next(c for c, values in fits.items() if values.mean() >= most - ALMOST_AS_GOOD)
