"""Which person is meant: the part of an image that estimators may look at, so that they find no other person.

A region says where the person may be. What lies outside of it is painted grey before an estimator sees the image.
"""

from collections.abc import Callable, Sequence
from typing import Literal

import numpy as np
from jaxtyping import Bool, Float, UInt8
from PIL import Image, ImageDraw
from scipy import ndimage

from twofold.body.skeleton import PARENTS
from twofold.errors import TwofoldError
from twofold.prepare.detect.people import COMPARABLE, Person
from twofold.prepare.detections import LANDMARKS, Track

Region = Bool[np.ndarray, "h w"]
GREY = 127
_SIZE = 240  # Regions are found at this size, pixels: they are wide.
_AROUND_MASK = 0.12  # Region around a mask and around a line of landmarks, in heights of the person.
_AROUND_LINE = 0.16
_REACH = 1.25  # The detector's circle is somewhat narrow for raised arms.
_JUMP = 0.6  # Between two images nobody moves farther, in circle radii.
_LINES = (
    ("nose", "left_shoulder"), ("nose", "right_shoulder"), ("left_shoulder", "right_shoulder"),
    ("left_shoulder", "left_hip"), ("right_shoulder", "right_hip"), ("left_hip", "right_hip"),
    ("left_shoulder", "right_hip"), ("left_shoulder", "left_elbow"), ("left_elbow", "left_wrist"),
    ("right_shoulder", "right_elbow"), ("right_elbow", "right_wrist"), ("left_hip", "left_knee"),
    ("left_knee", "left_ankle"), ("right_hip", "right_knee"), ("right_knee", "right_ankle"),
    ("left_ankle", "left_foot_index"), ("right_ankle", "right_foot_index"),
)  # fmt: skip
_LANDMARK_LINES = tuple((LANDMARKS.index(a), LANDMARKS.index(b)) for a, b in _LINES)
JOINT_LINES = tuple((joint, parent) for joint, parent in enumerate(PARENTS) if parent >= 0)


def only(image: UInt8[np.ndarray, "h w 3"], region: Region | None) -> UInt8[np.ndarray, "h w 3"]:
    """The image, grey outside of the region; as it is where there is none."""
    return image if region is None else np.where(region[..., None], image, np.uint8(GREY))


def around_mask(mask: UInt8[np.ndarray, "h w"]) -> Region:
    """The surroundings of the person in a mask; nothing where nobody is in it."""
    height, width = mask.shape
    small = np.asarray(Image.fromarray(mask).resize(_small(height, width), Image.Resampling.BOX)) > 16
    rows, columns = np.flatnonzero(small.any(1)), np.flatnonzero(small.any(0))
    if not len(rows):
        return np.zeros(mask.shape, dtype=bool)
    tall = max(rows[-1] - rows[0], columns[-1] - columns[0]) + 1
    near = np.asarray(ndimage.distance_transform_edt(~small)) <= max(_AROUND_MASK * tall, 1)
    return _large(near, height, width)


def around_lines(
    points: Float[np.ndarray, "n 2"], lines: Sequence[tuple[int, int]], height: int, width: int
) -> Region | None:
    """The surroundings of lines between points (column, row), of which some are NaN; None where none is known."""
    known = np.isfinite(points).all(1)
    if not known.any():
        return None
    size = _small(height, width)
    places = points * (np.array(size) / [width, height])
    tall = max(float(np.ptp(places[known], axis=0).max()), 2.0)
    canvas = Image.new("1", size)
    pen = ImageDraw.Draw(canvas)
    for a, b in lines:
        if known[a] and known[b]:
            pen.line([*places[a].tolist(), *places[b].tolist()], fill=1)
    for x, y in places[known].tolist():
        pen.point((round(x), round(y)), fill=1)
    drawn = np.asarray(canvas)
    if not drawn.any():
        return None
    near = np.asarray(ndimage.distance_transform_edt(~drawn)) <= max(_AROUND_LINE * tall, 1)
    return _large(near, height, width)


def around_landmarks(track: Track, height: int, width: int) -> Callable[[int], Region | None]:
    """The region of each image, by its place in the track; None where no landmark is known."""

    def region(number: int) -> Region | None:
        if number >= len(track):
            return None
        return around_lines(track.pixels[number].astype(np.float64), _LANDMARK_LINES, height, width)

    return region


def chosen_person(people: Sequence[Person], choice: Literal["largest"] | int, where: str) -> Person | None:
    """The person that is meant in the first image that shows anybody; None where nobody is in it.

    Args:
        people: found in it.
        choice: "largest", or which from the left, from 1, of those at least 0.6 times as large as the largest.
        where: the clip, for the message.

    Raises:
        TwofoldError: there are not as many.
    """
    if not people:
        return None
    largest = max(people, key=lambda person: person.size)
    if choice == "largest":
        return largest
    row = sorted((p for p in people if p.size >= COMPARABLE * largest.size), key=lambda person: person.hips[0])
    if choice > len(row):
        raise TwofoldError(
            f"--person {choice} was asked for, and the first image of {where} that shows anybody has {len(row)}; "
            f"give 1 (the leftmost) to {len(row)}, or largest."
        )
    return row[choice - 1]


def following(
    choice: Literal["largest"] | int, find: Callable[[UInt8[np.ndarray, "h w 3"]], list[Person]], where: str
) -> Callable[[UInt8[np.ndarray, "h w 3"]], Region | None]:
    """Regions of one person, to be asked for image by image.

    Args:
        choice: see `chosen_person`.
        find: everybody in an image.
        where: the clip, for messages.
    """
    last: list[Person] = []

    def region(image: UInt8[np.ndarray, "h w 3"]) -> Region | None:
        people = find(image)
        if not last:
            person = chosen_person(people, choice, where)
        else:
            before = last[0]
            near = [p for p in people if _apart(p, before) < _JUMP * max(p.size, before.size)]
            person = min(near, key=lambda p: _apart(p, before) + abs(p.size - before.size), default=None)
        if person is None and not last:
            return None
        if person is not None:
            last[:] = [person]
        others = [p for p in people if person is not None and p is not person]
        return around_person(last[0], others, *image.shape[:2])

    return region


def around_person(person: Person, others: Sequence[Person], height: int, width: int) -> Region:
    """The circle that holds a person, without what is nearer to somebody else, measured in their sizes."""
    columns, rows = np.meshgrid(np.arange(width), np.arange(height))

    def away(p: Person) -> Float[np.ndarray, "h w"]:
        """From the line through hips and shoulders, which goes on to the feet."""
        up = p.shoulders - p.hips
        ends = p.shoulders, p.hips - 1.5 * up
        along = ends[1] - ends[0]
        x, y = columns - ends[0][0], rows - ends[0][1]
        share = np.clip((x * along[0] + y * along[1]) / max(float(along @ along), 1e-6), 0, 1)
        return np.hypot(x - share * along[0], y - share * along[1]) / max(p.size, 1e-6)

    region = np.hypot(columns - person.hips[0], rows - person.hips[1]) <= _REACH * person.size
    own = away(person)
    for other in others:
        region &= own <= away(other)
    return region


def _apart(one: Person, other: Person) -> float:
    return float(np.linalg.norm(one.hips - other.hips))


def _small(height: int, width: int) -> tuple[int, int]:
    """Columns and rows of the small canvas."""
    scale = min(1.0, _SIZE / max(height, width))
    return max(round(scale * width), 1), max(round(scale * height), 1)


def _large(region: np.ndarray, height: int, width: int) -> Region:
    return np.asarray(Image.fromarray(region).resize((width, height), Image.Resampling.NEAREST))
