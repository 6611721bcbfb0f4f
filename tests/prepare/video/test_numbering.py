"""Every way to read the numbers of files is found, and the images decide between them."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from twofold.prepare.video.frames import ClipInfo
from twofold.prepare.video.numbering import best_reading, numberings

CLIP = ClipInfo(64, 48, 25.0, 20, 0.8, 64, 48, 20)


def readings(numbers):
    """What the files may stand for: in words, the first and the last place."""
    files = [Path(f"{number:04d}.png") for number in numbers]
    return [(n.words, min(n.places), max(n.places)) for n in numberings(files, CLIP, "masks")]


@pytest.mark.parametrize(
    ("numbers", "found"),
    [
        (range(20), [("counted from 0", 0, 19)]),
        (range(1, 21), [("counted from 1", 0, 19)]),
        # Counted from 0 with the first and last missing, or from 1 with the last two missing.
        (range(1, 19), [("counted from 1", 0, 17), ("counted from 0", 1, 18)]),
        (range(3, 18), [("counted from 0", 3, 17), ("counted from 1", 2, 16)]),
        # An export at half the rate, or the first half.
        (range(10), [("counted from 0", 0, 9), ("one for every 2 images", 0, 18)]),
        ([0, 2, 4, 6, 8, 10, 12, 14, 16, 18], [("counted from 0", 0, 18)]),
        (range(1001, 1021), [("in order from the first image", 0, 19)]),
        (range(1001, 1020), [("in order from the first image", 0, 18), ("in order up to the last image", 1, 19)]),
    ],
)
def test_numbers_that_fit_in_several_ways_are_not_taken_silently(numbers, found):
    assert readings(numbers) == found


@given(seed=st.integers(0, 99), true=st.integers(0, 2))
def test_the_reading_that_agrees_with_the_images_is_chosen(seed, true):
    """Masks that are one image off overlap a little less, in most images."""
    generator = np.random.default_rng(seed)
    quality = generator.uniform(0.8, 0.95, 40)
    scores = [quality - (0 if k == true else generator.uniform(0, 0.03, 40)) for k in range(3)]
    assert best_reading(scores) == (true, True)


@given(seed=st.integers(0, 99))
def test_chance_decides_nothing(seed):
    generator = np.random.default_rng(seed)
    quality = generator.uniform(0.8, 0.95, 40)
    best, certain = best_reading([quality, quality.copy()])
    assert (best, certain) == (0, False)
    assert not best_reading([quality, np.full(40, np.nan)])[1]
