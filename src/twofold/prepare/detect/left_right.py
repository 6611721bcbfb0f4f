"""Left and right put right where an estimator took them for each other.

Seen from behind, or with the face hidden, estimators may find every joint but call the left side right, for one frame
or for many. Which frames are mirrored is decided for the whole clip at once: by the most probable path through the two
possibilities (Viterbi), where each frame is compared with several before it, as estimators that smooth go from one
possibility to the other through a frame that is neither. All evidence is in natural logarithms of odds, and in seconds
rather than frames: frames far apart in time say nothing about each other.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from twofold.prepare.cameras.calibration import CalibratedCamera
from twofold.prepare.cameras.triangulation import triangulate
from twofold.prepare.detections import LANDMARKS, Track, mirrored_landmarks

_SPEEDS = {
    "ear": 1.0, "shoulder": 1.0, "hip": 0.8, "elbow": 2.5, "wrist": 5.0, "knee": 2.5, "ankle": 4.0, "heel": 4.0,
    "foot_index": 4.0,
}  # fmt: skip
"""How fast the line from a joint to its twin usually changes, trunk lengths a second."""

_LEFT = np.array([LANDMARKS.index(f"left_{name}") for name in _SPEEDS])
_RIGHT = np.array([LANDMARKS.index(f"right_{name}") for name in _SPEEDS])
_SPEED = np.array(list(_SPEEDS.values()))
_MIRROR = np.array(mirrored_landmarks())

_JITTER = 0.08
"""What an estimator adds to these lines, trunk lengths."""

_INDEPENDENT = 4.0
"""The nine lines move together: they count as this many of independent error."""

_PAIRED = np.isin(np.arange(len(LANDMARKS)), np.concatenate([_LEFT, _RIGHT]))

_ERROR = 0.03
"""Usual error of a landmark in one view against the others, trunk lengths."""

_BEFORE = 4
"""Frames before it that each frame is compared with."""

_EARLIER = 0.75
"""Weight of all of them but the last, which tell much the same."""

_TURN = 0.45
"""Seconds after which a quick person may face the other way, so that lines tell nothing any more."""

_CHANGES = 0.5
"""How often an estimator usually goes from right to mirrored or back, a second."""

_MIRRORED = 0.1
"""Share of a clip that is usually mirrored."""

_FACING = 1.5
"""What toes that point the way the body faces say for a frame at most: never enough against what was found alone."""

_SECONDS = 0.5
"""Time after which a frame says something new about how probable it is by itself."""


@dataclass(frozen=True)
class Repair:
    """A track with its sides put right.

    Attributes:
        track: left is the person's left in every frame. In `world`, too, only the names are exchanged: its depths in
            mirrored frames were guessed for somebody seen from the other side, and are less good than in others.
        swapped: frames that were mirrored.
    """

    track: Track
    swapped: Bool[np.ndarray, "t"]


def repair_swaps(track: Track, seconds: Float[np.ndarray, "t"]) -> Repair:
    """Puts left and right in order by how people move and which way their toes point.

    Args:
        track: of one camera.
        seconds: when each frame was taken, rising.
    """
    found = np.flatnonzero(track.found)
    if not len(found):
        return Repair(track, np.zeros(len(track), dtype=bool))
    lines, weights = _lines(track, found)
    swapped = np.zeros(len(track), dtype=bool)
    swapped[found] = _most_probable(_continuity(lines, weights, seconds[found]), _alone(track, found, seconds))
    return mirror(track, swapped)


def repair_with_views(
    tracks: Sequence[Track], cameras: Sequence[CalibratedCamera], seconds: Float[np.ndarray, "t"]
) -> list[Repair]:
    """Puts left and right in order so that the views agree in space, too.

    Each view in turn is held against the points that the others triangulate, until none changes any more.

    Args:
        tracks: the same frames in every view.
        cameras: one of each track.
        seconds: when each frame was, rising.

    Raises:
        TwofoldError: see `triangulate`.
    """
    repairs = [repair_swaps(track, seconds) for track in tracks]
    if len(tracks) < 2:
        return repairs
    chosen = [repair.swapped for repair in repairs]
    found = [np.flatnonzero(track.found) for track in tracks]
    alone = [_alone(track, at, seconds) for track, at in zip(tracks, found, strict=True)]
    moving = [
        _continuity(*_lines(track, at), seconds[at]) if len(at) else np.zeros((_BEFORE, 0))
        for track, at in zip(tracks, found, strict=True)
    ]
    for _ in range(4):
        before = [view.copy() for view in chosen]
        for view, at in enumerate(found):
            if not len(at):
                continue
            now = [mirror(track, swapped).track for track, swapped in zip(tracks, chosen, strict=True)]
            odds = _odds_from_views(now, tracks[view], cameras, view)[at]
            chosen[view] = np.zeros(len(seconds), dtype=bool)
            chosen[view][at] = _most_probable(moving[view], alone[view] + odds)
        if all(np.array_equal(old, new) for old, new in zip(before, chosen, strict=True)):
            break
    return [mirror(track, swapped) for track, swapped in zip(tracks, chosen, strict=True)]


def mirror(track: Track, swapped: Bool[np.ndarray, "t"]) -> Repair:
    """The track with left and right exchanged in some frames."""

    def put_right(values: np.ndarray) -> np.ndarray:
        shape = (len(values), *[1] * (values.ndim - 1))
        return np.where(swapped.reshape(shape), values[:, _MIRROR], values)

    right = Track(put_right(track.pixels), put_right(track.visibility), put_right(track.world))
    return Repair(right, swapped)


def _trunk(points: np.ndarray) -> np.ndarray:
    """From the middle of the hips to the middle of the shoulders."""
    left, right, hip, hip_right = (
        LANDMARKS.index(n) for n in ("left_shoulder", "right_shoulder", "left_hip", "right_hip")
    )
    return (points[:, left] + points[:, right] - points[:, hip] - points[:, hip_right]) / 2


def _usual_length(vectors: np.ndarray) -> float:
    lengths = np.linalg.norm(vectors, axis=-1)
    known = lengths[np.isfinite(lengths)]
    return max(float(np.median(known)), 1e-6) if len(known) else 1.0


def _lines(track: Track, found: np.ndarray) -> tuple[Float[np.ndarray, "n p 3"], Float[np.ndarray, "n p"]]:
    """From right to left twin, trunk lengths, in the image and in depth where it is known; and how sure that is."""
    pixels, world = track.pixels[found].astype(np.float64), track.world[found].astype(np.float64)
    flat = (pixels[:, _LEFT] - pixels[:, _RIGHT]) / _usual_length(_trunk(pixels))
    deep = (world[:, _LEFT, 2:] - world[:, _RIGHT, 2:]) / _usual_length(_trunk(world))
    weights = np.minimum(track.visibility[found][:, _LEFT], track.visibility[found][:, _RIGHT])
    weights = np.where(np.isfinite(flat).all(-1), weights, 0)
    return np.nan_to_num(np.concatenate([flat, np.nan_to_num(deep)], -1)), weights


def _continuity(
    lines: Float[np.ndarray, "n p 3"], weights: Float[np.ndarray, "n p"], seconds: Float[np.ndarray, "n"]
) -> Float[np.ndarray, "b n"]:
    """Odds that frame n is like the one b + 1 frames before, rather than its mirror image.

    Mirrored, every line points the other way; errors are taken to be spread as Cauchy's.
    """
    odds = np.zeros((_BEFORE, len(lines)))
    for back in range(1, min(_BEFORE, len(lines) - 1) + 1):
        passed = (seconds[back:] - seconds[:-back])[:, None]
        usual = _JITTER**2 + (_SPEED * passed) ** 2
        like = np.log1p(((lines[back:] - lines[:-back]) ** 2).sum(-1) / usual)
        unlike = np.log1p(((lines[back:] + lines[:-back]) ** 2).sum(-1) / usual)
        sure = np.minimum(weights[back:], weights[:-back])
        share = (1.0 if back == 1 else _EARLIER) * _INDEPENDENT / len(_SPEED) * np.exp(-((passed[:, 0] / _TURN) ** 2))
        odds[back - 1, back:] = share * (sure * (unlike - like)).sum(1)
    if len(lines) > 1:
        change = 0.5 * (1 - np.exp(-2 * _CHANGES * np.maximum(np.diff(seconds), 1e-6)))
        odds[0, 1:] += np.log((1 - change) / change)
    return odds


def _alone(track: Track, found: np.ndarray, seconds: np.ndarray) -> Float[np.ndarray, "n"]:
    """Odds that each frame is as it was found, whatever the others are.

    Cameras hang above people's feet, so toes that point to the camera lie lower in the image than the heels.
    """
    pixels = track.pixels[found].astype(np.float64)
    at = {name: pixels[:, LANDMARKS.index(name)] for name in LANDMARKS}
    trunk = _trunk(pixels)
    size = _usual_length(trunk)
    across = at["left_shoulder"] - at["right_shoulder"] + at["left_hip"] - at["right_hip"]
    # Seen from the front, the left side is to the right of a trunk that stands upright.
    front = (trunk[:, 0] * across[:, 1] - trunk[:, 1] * across[:, 0]) / size**2
    feet = at["left_foot_index"] - at["left_heel"] + at["right_foot_index"] - at["right_heel"]
    agree = np.nan_to_num(np.tanh(front / 0.3) * np.tanh(feet[:, 1] / 2 / size / 0.1))
    times = seconds[found]
    stands_for = np.gradient(times) if len(times) > 1 else np.full(len(times), _SECONDS)
    return np.minimum(1.0, stands_for / _SECONDS) * (np.log(1 / _MIRRORED - 1) + _FACING * agree)


def _odds_from_views(
    now: Sequence[Track], as_found: Track, cameras: Sequence[CalibratedCamera], view: int
) -> Float[np.ndarray, "t"]:
    """Odds that a view's frames are as they were found, from how well all views then meet in space."""
    costs: list[np.ndarray] = []
    for candidate in (mirror(as_found, np.ones(len(as_found), dtype=bool)).track, as_found):
        tracks = [candidate if v == view else track for v, track in enumerate(now)]
        tracks = [Track(t.pixels, np.where(_PAIRED, t.visibility, 0), t.world) for t in tracks]
        usual = [_ERROR * _usual_length(_trunk(t.pixels[t.found])) for t in tracks]
        errors = np.nan_to_num(triangulate(cameras, tracks).errors) / np.array(usual)[:, None, None]
        costs.append(np.log1p(errors**2).sum((0, 2)) * _INDEPENDENT / _PAIRED.sum())
    return costs[0] - costs[1]


def _most_probable(continuity: Float[np.ndarray, "b n"], alone: Float[np.ndarray, "n"]) -> Bool[np.ndarray, "n"]:
    """Which frames are mirrored, by odds against it: the path of least cost.

    A state holds the last frames' answers as bits, the latest lowest.
    """
    states = np.arange(1 << _BEFORE)
    bits = states[:, None] >> np.arange(_BEFORE) & 1
    cost = np.where(states == 0, 0.0, np.inf)
    came_from = np.zeros((len(alone), len(states)), dtype=np.int64)
    # Of the two states that lead to one, the second has its oldest bit set.
    earlier = np.stack([states >> 1, states >> 1 | 1 << (_BEFORE - 1)])
    for frame, against in enumerate(alone):
        known = continuity[:, frame] * (np.arange(_BEFORE) < frame)
        stays = np.stack([(bits != answer) @ known + answer * against for answer in (0, 1)])
        total = cost[earlier] + stays[states & 1, earlier]
        came_from[frame] = earlier[total.argmin(0), states]
        cost = total.min(0)
    state, answers = int(cost.argmin()), np.zeros(len(alone), dtype=bool)
    for frame in range(len(alone) - 1, -1, -1):
        answers[frame] = state & 1
        state = int(came_from[frame, state])
    return answers
