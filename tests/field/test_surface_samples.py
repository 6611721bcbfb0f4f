"""Points on a surface, and medians around its parts."""

import numpy as np
import torch

from twofold.field.surface_samples import (
    even_samples,
    ring_medians,
    slope_within,
    weighted_median,
    without_faint_bands,
)

SQUARE = np.array([[0.0, 0, 0], [2, 0, 0], [2, 1, 0], [0, 1, 0]])
FACES = np.array([[0, 1, 2], [0, 2, 3]])


def test_weighted_median_is_that_of_repeated_rows(generator):
    values = torch.rand(9, 2, generator=generator).numpy()
    counts = np.array([1, 2, 1, 3, 1, 1, 2, 1, 1])
    assert np.allclose(weighted_median(values, counts.astype(float)), np.median(values.repeat(counts, 0), 0))


def test_samples_are_spread_evenly():
    samples = even_samples(SQUARE, FACES, np.ones(2), 4000)
    at = samples.at(SQUARE)
    counts = np.histogram2d(at[:, 0], at[:, 1], bins=(8, 4), range=((0, 2), (0, 1)))[0]
    assert abs(samples.area * len(samples) - 2) < 1e-9
    assert np.abs(counts / counts.mean() - 1).max() < 0.25
    assert np.allclose(samples.share.sum(1), 1)
    assert (samples.share >= 0).all()


def test_gather_is_the_transpose_of_at():
    samples = even_samples(SQUARE, FACES, np.array([1.0, 0.5]), 50)
    values, other = np.random.default_rng(0).normal(size=4), np.random.default_rng(1).normal(size=50)
    assert np.isclose(samples.at(values) @ other, values @ (samples.gather(4) @ other))


def rings():
    """Points of two parts of the body with their heights."""
    random = np.random.default_rng(2)
    return random, random.integers(0, 2, 3000), random.uniform(0, 1, 3000)


def test_a_ring_has_the_median_of_what_was_observed_of_it():
    random, group, along = rings()
    values = np.stack([np.floor(along * 10) + 20 * group, random.normal(size=3000)], -1)
    trust = (random.uniform(size=3000) < 0.4) * 1.0
    values[trust == 0] = 99
    found = ring_medians(values, trust, group, along, 0.02, 1.0)
    middle = np.abs(along * 10 % 1 - 0.5) < 0.3
    assert np.array_equal(found[middle, 0], (np.floor(along * 10) + 20 * group)[middle])
    assert np.abs(found[:, 1]).max() < 1.5


def test_a_part_that_nobody_saw_takes_the_median_of_all():
    _, group, along = rings()
    found = ring_medians(np.where(group, 7.0, along)[:, None], (group == 0) * 1.0, group, along, 0.02, 1.0)
    assert abs(found[group == 1, 0].mean() - 0.5) < 0.03


def test_faint_bands_disappear_and_steps_stay_where_they_are(generator):
    places = np.arange(120) * 0.006
    hem = np.where(places > 0.4, 0.3, 0.0)[:, None] * [1.0, 0.5, 0.2]
    band = np.where(np.abs(places - 0.2) < 0.025, 0.05, 0.0)[:, None]
    noise = 0.005 * torch.randn(120, 3, generator=generator).numpy()
    found = without_faint_bands(hem + band + noise, places, 0.04)
    assert np.abs(found - hem).max() < 0.015
    assert np.abs(without_faint_bands(hem + 5 * band, places, 0.04) - hem - 5 * band).max() < 0.01


def test_one_ring_and_equal_rings_stay():
    assert without_faint_bands(np.array([[0.3, 0.2]]), np.zeros(1), 0.04).tolist() == [[0.3, 0.2]]
    assert np.allclose(without_faint_bands(np.full((9, 2), 0.7), np.arange(9.0), 0.04), 0.7)


def test_slopes_are_found_within_rings_and_an_emblem_does_not_change_them():
    random, group, along = rings()
    facing = random.uniform(-1, 1, 3000)
    values = 5 * along + 3 * group + 0.2 * facing
    emblem = (group == 0) & (along > 0.6) & (along < 0.8) & (facing > 0.5)
    values[emblem] += 2
    assert abs(slope_within(values, facing, np.ones(3000), group, along, 0.02) - 0.2) < 0.08
    assert slope_within(values, np.ones(3000), np.ones(3000), group, along, 0.02) == 0
