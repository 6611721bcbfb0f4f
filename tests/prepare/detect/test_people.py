import functools
import itertools

import numpy as np
import pytest
from made_clips import real_clip
from PIL import Image

from twofold.prepare.detect.people import People, Person, comparable, count_people, distinct, windows
from twofold.prepare.video.frames import Frames

SINGLE = [
    "pose2sim/cam01.mp4",
    "pose2sim/cam02.mp4",
    "pose2sim/cam03.mp4",
    "pose2sim/cam04.mp4",
    "sam2_juggle/juggle.mp4",
]


@functools.cache
def images(name, count=5, rows=480):
    frames = [p.image for p in Frames(real_clip(name), fps=6 if "cam" in name else 1)]
    chosen = [frames[round(i)] for i in np.linspace(0, len(frames) - 1, count)]
    return [resized(image, rows) for image in chosen]


def resized(image, rows):
    small = Image.fromarray(image).resize((round(image.shape[1] * rows / image.shape[0]), rows), Image.Resampling.BOX)
    return np.asarray(small)


def beside(left, right, scale=1.0):
    """Two images side by side, standing on the same floor; the second one made smaller."""
    small = resized(right, round(len(left) * scale))
    padded = np.pad(small, ((len(left) - len(small), 0), (0, 0), (0, 0)), constant_values=128)
    return np.concatenate([left, padded], 1)


def person(column, row=100.0, size=50.0, score=0.9):
    return Person(np.array([column, row]), np.array([column, row - 0.5 * size]), size, score)


@pytest.mark.parametrize("name", SINGLE)
def test_one_person_and_those_far_behind_are_one(name):
    pytest.importorskip("mediapipe")
    people = count_people(images(name))
    assert people.counts == (1,) * 5
    assert not people.too_many


@pytest.mark.parametrize(("left", "right"), [(0, 1), (1, 3)])
def test_two_people_side_by_side_are_too_many(left, right):
    pytest.importorskip("mediapipe")
    pairs = zip(images(SINGLE[left]), images(SINGLE[right]), strict=True)
    people = count_people(beside(a, b) for a, b in pairs)
    assert people.several >= 0.8
    assert people.too_many


def test_a_person_beside_the_mirror_image_is_too_many():
    pytest.importorskip("mediapipe")
    assert count_people(np.concatenate([p, p[:, ::-1]], 1) for p in images(SINGLE[4])).several == 1


def test_somebody_half_as_large_does_no_harm():
    pytest.importorskip("mediapipe")
    pairs = zip(images(SINGLE[0]), images(SINGLE[2]), strict=True)
    assert not count_people(beside(a, b, 0.5) for a, b in pairs).too_many


def test_nobody_is_in_empty_images(capfd):
    pytest.importorskip("mediapipe")
    rng = np.random.default_rng(0)
    people = count_people([np.zeros((90, 160, 3), np.uint8), rng.integers(0, 255, (300, 100, 3), np.uint8)])
    assert people.counts == (0, 0)
    assert people.nobody == 1
    assert capfd.readouterr().err == ""


def test_the_rule():
    assert People((1, 1, 1, 1, 1, 1, 1, 2, 2, 0)).too_many is False
    assert People((1, 1, 1, 1, 1, 1, 1, 2, 2, 3)).too_many is True
    assert People((1, 1, 2, 0)).several == People((1, 1, 2, 0)).nobody == 0.25
    assert People(()).too_many is False


def test_only_people_of_comparable_size_count():
    assert comparable([]) == 0
    assert comparable([person(0.0, size=50.0), person(200.0, size=31.0), person(400.0, size=29.0)]) == 2


def test_one_person_found_twice_is_one():
    sure, again, other = person(100.0, score=0.9), person(112.0, size=45.0, score=0.8), person(130.0, score=0.7)
    assert distinct([again, other, sure]) == [sure, other]
    upside_down = Person(sure.shoulders, sure.hips, 50.0, 0.6)
    assert distinct([sure, upside_down]) == [sure]


@pytest.mark.parametrize(("height", "width"), [(448, 252), (448, 224), (448, 448), (448, 1600), (300, 301), (10, 3)])
def test_windows_cover_the_image_and_overlap(height, width):
    found = windows(height, width)
    if width <= height // 2:
        assert found == []
        return
    assert found[0][0] == 0
    assert found[-1][1] == width
    assert {b - a for a, b in found} == {height // 2}
    for (_, end), (start, _) in itertools.pairwise(found):
        assert end - start >= height // 4 - 1
