"""Masks alone: soft, ragged, coarse, cut off, in pieces."""

import numpy as np
import pytest
from scipy import ndimage

from twofold.check.mask_measures import mask_facts


def disc(radius=60.0, size=160, middle=(80.0, 80.0), soft=1.0):
    rows, columns = np.mgrid[:size, :size]
    away = radius - np.hypot(rows - middle[0], columns - middle[1])
    return np.clip(127.5 + 255 * away / soft, 0, 255).astype(np.uint8)


@pytest.mark.parametrize("width", [1.0, 4.0, 10.0])
def test_softness_is_the_width_of_the_edge(width):
    # Four fifths of the edge are between a tenth and nine tenths; an outline has fewer pixels than its length.
    assert mask_facts(disc(soft=width)).softness == pytest.approx(0.8 * width * np.pi / 2**1.5, rel=0.12)


def test_black_and_white_masks_have_no_soft_edge():
    assert mask_facts(np.where(disc() > 127, 255, 0).astype(np.uint8)).softness == 0


def test_roughness_grows_with_the_noise_of_the_outline():
    noise = np.random.default_rng(0).normal(size=(160, 160))
    found = [
        mask_facts(np.where(disc(soft=30.0) + size * ndimage.gaussian_filter(noise, 1) > 127, 255, 0).astype(np.uint8))
        for size in (0, 40, 120)
    ]
    assert found[0].roughness < 0.001 < found[1].roughness < 0.002 < found[2].roughness


def test_roughness_is_the_same_in_a_mask_three_times_as_large():
    noise = np.random.default_rng(0).normal(size=(300, 300))
    rough = disc(110.0, 300, (150, 150), 30.0) + 120 * ndimage.gaussian_filter(noise, 1.5)
    small, large = (
        mask_facts(np.where(ndimage.zoom(rough, n, order=1) > 127, 255, 0).astype(np.uint8)) for n in (1, 3)
    )
    assert large.roughness == pytest.approx(small.roughness, rel=0.15)


@pytest.mark.parametrize("step", [1, 4, 9])
def test_grain_is_the_size_of_the_steps(step):
    rows, columns = np.mgrid[:160, :160]
    slanted = np.where(1.1 * abs(rows - 80) + abs(columns - 80) < 60, 255, 0).astype(np.uint8)
    mask = slanted[::step, ::step].repeat(step, 0).repeat(step, 1)
    assert mask_facts(mask).grain == pytest.approx(step, rel=0.1)


def test_pieces_are_counted_and_weighed():
    mask = np.maximum(disc(30, middle=(50, 50)), disc(15, middle=(120, 120)))
    mask[2, 2] = 255
    facts = mask_facts(mask)
    assert facts.pieces == 2
    assert facts.loose == pytest.approx(0.2, abs=0.01)


def test_parts_that_touch_at_corners_are_one():
    mask = np.zeros((20, 20), np.uint8)
    mask[:10, :10] = mask[10:, 10:] = 255
    assert mask_facts(mask).pieces == 1


def test_borders_that_the_person_runs_into_are_named():
    assert mask_facts(disc()).borders == ()
    assert mask_facts(disc(middle=(80.0, 30.0))).borders == ("left",)
    assert mask_facts(disc(middle=(140.0, 140.0))).borders == ("right", "bottom")
    one = disc()
    one[0, 5] = 255
    assert mask_facts(one).borders == ()


def test_an_inverted_mask_has_most_of_the_image_and_its_border():
    facts = mask_facts(255 - disc(30.0))
    assert facts.share > 0.8
    assert facts.border_share > 0.95


def test_an_empty_mask_has_nothing():
    assert mask_facts(np.zeros((9, 9), np.uint8)).pieces == 0
