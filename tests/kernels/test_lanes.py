"""Each operation on vectors against the same in NumPy."""

import numpy as np
import pytest

from twofold.kernels import lanes
from twofold.kernels.parallel import compiled

RNG = np.random.default_rng(0)


@compiled
def all_long(a, b, scalar, out):
    x, y = lanes.load(a, 1, 2), lanes.load(b, 0, 0)
    lanes.store(out, 0, 1, lanes.times_plus(x, y, lanes.fill(scalar)))
    lanes.store(out, 1, 1, lanes.scaled_plus(scalar, x, y))
    lanes.store(out, 2, 1, lanes.scaled(scalar, x))
    lanes.store(out, 3, 1, lanes.between(scalar, x, y))
    lanes.store(out, 4, 1, lanes.minus(x, y))
    lanes.store(out, 5, 1, lanes.plus(x, y))
    lanes.store(out, 6, 1, lanes.where_positive(x, y))
    lanes.store(out, 7, 1, lanes.spread(a, 2, 3))
    lanes.store(out, 8, 1, lanes.exponential(x))
    lanes.store(out, 9, 1, lanes.one_more_where_less(x, y, x))
    lanes.store(out, 10, 1, lanes.distinct(lanes.times_plus(x, x, lanes.fill(scalar))))


@compiled
def all_short(a, b, out):
    x, y = lanes.load4(a, 1, 2), lanes.load4(b, 0, 0)
    lanes.store4(out, 0, 1, lanes.plus(x, y))
    return lanes.sum_of_products(x, y)


@pytest.fixture
def arrays():
    a, b = (RNG.normal(0, 2, (3, 20)).astype(np.float32) for _ in range(2))
    return a, b, np.zeros((11, 18), np.float32)


def test_long_vectors(arrays):
    a, b, out = arrays
    scalar = np.float32(0.25)
    all_long(a, b, scalar, out)
    x, y = a[1, 2:18], b[0, :16]
    expected = [
        x * y + scalar, scalar * x + y, scalar * x, x + scalar * (y - x), x - y, x + y, np.where(x > 0, y, 0),
        np.full(16, a[2, 3]), np.exp(x), x + (x < y), x * x + scalar,
    ]  # fmt: skip
    np.testing.assert_allclose(out[:, 1:17], expected, rtol=3e-6, atol=1e-6)
    assert not out[:, 0].any()
    assert not out[:, 17].any(), "nothing beside the vector is touched"


def test_short_vectors(arrays):
    a, b, out = arrays
    total = all_short(a, b, out)
    np.testing.assert_allclose(out[0, 1:5], a[1, 2:6] + b[0, :4], rtol=1e-6)
    assert total == pytest.approx(a[1, 2:6] @ b[0, :4], rel=1e-5)
    assert not out[0, 5:].any()


def test_exponential_is_that_of_numpy_as_far_as_it_goes(arrays):
    a, b, out = arrays
    for x in (np.linspace(-87, 88, 16), np.linspace(-1, 1, 16), np.linspace(-1e-3, 1e-3, 16)):
        a[1, 2:18] = x
        all_long(a, b, np.float32(1), out)
        np.testing.assert_allclose(out[8, 1:17], np.exp(x.astype(np.float32).astype(float)), rtol=4e-7)
    a[1, 2:18] = np.linspace(-1e9, 1e9, 16)
    all_long(a, b, np.float32(1), out)
    assert np.isfinite(out[8, 1:17]).all()
    assert out[8, 1] < 1e-37
    assert out[8, 16] > 1e37


def test_distinct_numbers_are_all_different_and_in_order(arrays):
    a, b, out = arrays
    a[1, 2:18] = np.repeat(np.float32([0.0, 1.0, 2.0, 3.0]), 4)
    all_long(a, b, np.float32(0.5), out)
    assert (np.diff(out[10, 1:17]) > 0).all()
