"""The tree of boxes finds what looking at all triangles finds."""

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from twofold.geometry.surfaces import closest_on_triangles
from twofold.kernels.triangle_tree import nearest_triangles


@given(st.integers(0, 100_000), st.integers(1, 40), st.sampled_from([0.0, 0.1, 30.0]))
def test_distance_is_the_least_over_all_triangles(seed, count, size):
    """Triangles of no size, small ones, and such that all overlap."""
    random = np.random.default_rng(seed)
    corners = random.normal(size=(count, 1, 3)) + size * random.normal(size=(count, 3, 3))
    points = 2 * random.normal(size=(20, 3))
    distance, triangle, nearest = nearest_triangles(points, corners)
    a, b, c = torch.from_numpy(corners).unbind(1)
    point = torch.from_numpy(points)[:, None].expand(20, count, 3)
    feet = closest_on_triangles(point, *(corner.expand(20, count, 3) for corner in (a, b, c)))
    all_distances = (feet - point).norm(dim=-1).numpy()
    np.testing.assert_allclose(distance, all_distances.min(1), atol=1e-9)
    np.testing.assert_allclose(all_distances[np.arange(20), triangle], distance, atol=1e-9)
    np.testing.assert_allclose(np.linalg.norm(nearest - points, axis=1), distance, atol=1e-9)


@pytest.mark.parametrize("threads", [1, 2])
def test_threads_change_nothing(threads):
    random = np.random.default_rng(0)
    corners, points = random.normal(size=(300, 3, 3)), random.normal(size=(900, 3))
    torch.set_num_threads(threads)
    try:
        found = nearest_triangles(points, corners)
    finally:
        torch.set_num_threads(1)
    assert all(
        np.array_equal(np.concatenate(halves), whole)
        for whole, halves in zip(
            found,
            zip(nearest_triangles(points[:450], corners), nearest_triangles(points[450:], corners), strict=True),
            strict=True,
        )
    )
