"""How many people are in view: a clip of several is better refused than fitted to now this one, now that one."""

import contextlib
import importlib
from collections.abc import Callable, Generator, Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float, UInt8
from PIL import Image

from twofold.prepare.detect.mediapipe_loader import load_mediapipe, silenced

COMPARABLE = 0.6
"""Whoever is this large beside the largest person counts."""
SHARE = 0.3
"""Several people are in view if they are found in this share of the images."""

_HEIGHT = 448  # Rows that are looked at; the detector itself sees 224.
_APART = 0.35  # Two findings whose hips or shoulders are nearer than this, in sizes, are one person.
_EDGE = 0.1  # Hips and shoulders this near to a window's side, in its widths, belong to somebody cut by it.
_DETECTOR = """
input_stream: "image"
output_stream: "people"
node { calculator: "PoseDetectionCpu" input_stream: "IMAGE:image" output_stream: "DETECTIONS:people" }
"""


@dataclass(frozen=True)
class Person:
    """Somebody found in an image, in its pixels.

    Attributes:
        hips: column and row of their middle.
        shoulders: column and row of their middle.
        size: radius of the circle about the hips that holds the whole body.
        score: how sure the detector is, 0.5 to 1.
    """

    hips: Float[np.ndarray, "2"]
    shoulders: Float[np.ndarray, "2"]
    size: float
    score: float


@dataclass(frozen=True)
class People:
    """Who is in view in images from all through a clip.

    Attributes:
        counts: in each image, the largest person and those at least 0.6 times as large.
    """

    counts: tuple[int, ...]

    @property
    def nobody(self) -> float:
        """Share of the images in which nobody was found."""
        return sum(count == 0 for count in self.counts) / max(len(self.counts), 1)

    @property
    def several(self) -> float:
        """Share of the images in which more than one person was found."""
        return sum(count > 1 for count in self.counts) / max(len(self.counts), 1)

    @property
    def too_many(self) -> bool:
        """Several people in 0.3 of the images: which of them is meant, nobody can tell."""
        return self.several >= SHARE


def count_people(images: Iterable[UInt8[np.ndarray, "_ _ 3"]]) -> People:
    """Who is in view, by MediaPipe's person detector.

    A second person counts who is at least 0.6 times as large as the first, so that passers-by behind do not. Every
    image is looked at whole and through windows half as wide as high, as the detector misses small people.

    Args:
        images: some 10 to 20 images from all through a clip, 8-bit sRGB.

    Raises:
        TwofoldError: MediaPipe is not installed.
    """
    with people_finder() as find:
        return People(tuple(comparable(find(image)) for image in images))


@contextlib.contextmanager
def people_finder() -> Generator[Callable[[UInt8[np.ndarray, "_ _ 3"]], list[Person]]]:
    """A function that finds everybody in an image, by MediaPipe's person detector.

    Raises:
        TwofoldError: MediaPipe is not installed.
    """
    load_mediapipe()
    solutions: Any = importlib.import_module("mediapipe.python.solution_base")
    kinds = {"people": solutions.PacketDataType.PROTO_LIST}
    with silenced():  # It speaks at the start and at the first image.
        detector = solutions.SolutionBase(graph_config=_DETECTOR, outputs=["people"], stream_type_hints=kinds)
        detector.process(np.zeros((_HEIGHT, _HEIGHT, 3), np.uint8))
    try:
        yield lambda image: find_people(image, detector)
    finally:
        detector.close()


def find_people(image: UInt8[np.ndarray, "h w 3"], detector: Any) -> list[Person]:
    """Everybody the detector finds in an image, the surest first, nobody twice."""
    height, width = image.shape[:2]
    scale = min(_HEIGHT / height, 1.0)
    small = Image.fromarray(image).resize((max(round(width * scale), 1), round(height * scale)), Image.Resampling.BOX)
    pixels = np.asarray(small)
    found = _detected(pixels, detector)
    for left, right in windows(*pixels.shape[:2]):
        edge = _EDGE * (right - left)
        low, high = left + edge if left else -np.inf, right - edge if right < pixels.shape[1] else np.inf
        for person in _detected(pixels[:, left:right], detector, left):
            # Parts of a body look like a whole one, often on its head.
            inside = low <= min(person.hips[0], person.shoulders[0]) <= max(person.hips[0], person.shoulders[0]) <= high
            if inside and person.hips[1] > person.shoulders[1]:
                found.append(person)
    factor = height / pixels.shape[0]
    return [Person(p.hips * factor, p.shoulders * factor, p.size * factor, p.score) for p in distinct(found)]


def windows(height: int, width: int) -> list[tuple[int, int]]:
    """First column, and the one behind the last, of windows half as wide as high; neighbours overlap by half or more.

    >>> windows(100, 100)
    [(0, 50), (25, 75), (50, 100)]
    """
    size = height // 2
    if width <= size:
        return []
    count = int(np.ceil((width - size) / (size / 2))) + 1
    return [(int(x), int(x) + size) for x in np.linspace(0, width - size, count).round()]


def distinct(found: list[Person]) -> list[Person]:
    """Findings without those that are surely of the same person as a surer one."""
    kept: list[Person] = []
    for person in sorted(found, key=lambda p: -p.score):
        if not any(_same(person, other) for other in kept):
            kept.append(person)
    return kept


def comparable(people: list[Person]) -> int:
    """The largest person and those at least 0.6 times as large, counted."""
    largest = max((person.size for person in people), default=0.0)
    return sum(person.size >= COMPARABLE * largest for person in people)


def _same(one: Person, other: Person) -> bool:
    near = _APART * max(one.size, other.size)
    apart = np.linalg.norm(one.hips - other.hips), np.linalg.norm(one.shoulders - other.shoulders)
    middles = np.linalg.norm(one.hips + one.shoulders - other.hips - other.shoulders) / 2
    return bool(min(*apart, middles) < near)


def _detected(pixels: UInt8[np.ndarray, "h w 3"], detector: Any, left: int = 0) -> list[Person]:
    height, width = pixels.shape[:2]
    people: list[Person] = []
    for detection in detector.process(np.ascontiguousarray(pixels)).people or ():
        points = np.array([(p.x, p.y) for p in detection.location_data.relative_keypoints]) * [width, height]
        # Of the four points, the second lies on the circle about the hips, the third between the shoulders.
        size = float(np.linalg.norm(points[1] - points[0]))
        people.append(Person(points[0] + [left, 0], points[2] + [left, 0], size, float(detection.score[0])))
    return people
