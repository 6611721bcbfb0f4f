"""KID and FID against sums and matrix roots written out."""

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.linalg import sqrtm
from torch import Tensor

from twofold.errors import TwofoldError
from twofold.metrics.distribution import fid, kid, polynomial_mmd


def features(seed: int, count: int, width: int = 6, shift: float = 0.0) -> Tensor:
    return torch.rand(count, width, generator=torch.Generator().manual_seed(seed)) + shift


def literal_mmd(x: Tensor, y: Tensor) -> float:
    def k(a: Tensor, b: Tensor) -> float:
        return ((a.double() @ b.double()).item() / len(a) + 1) ** 3

    n, m = len(x), len(y)
    within = sum(k(x[i], x[j]) for i in range(n) for j in range(n) if i != j) / (n * (n - 1))
    within += sum(k(y[i], y[j]) for i in range(m) for j in range(m) if i != j) / (m * (m - 1))
    return within - 2 * sum(k(a, b) for a in x for b in y) / (n * m)


@settings(max_examples=15)
@given(st.integers(0, 99), st.integers(2, 7), st.integers(2, 7))
def test_mmd_is_the_double_sum(seed: int, n: int, m: int) -> None:
    x, y = features(seed, n), features(seed + 100, m, shift=0.3)
    assert polynomial_mmd(x, y) == pytest.approx(literal_mmd(x, y), abs=1e-9)


def test_kid_is_the_mean_over_subsets() -> None:
    x, y = features(0, 12), features(1, 9, shift=0.2)
    source = torch.Generator().manual_seed(4)
    total = 0.0
    for _ in range(7):
        ours, theirs = torch.randperm(12, generator=source)[:5], torch.randperm(9, generator=source)[:5]
        total += literal_mmd(x[ours], y[theirs])
    found = kid(x, y, torch.Generator().manual_seed(4), subsets=7, size=5)
    assert found == pytest.approx(total / 7, abs=1e-9)


def test_kid_of_few_images_draws_nothing() -> None:
    x, y = features(0, 8), features(1, 8, shift=0.1)
    generator = torch.Generator().manual_seed(0)
    before = generator.get_state()
    assert kid(x, y, generator) == pytest.approx(literal_mmd(x, y), abs=1e-9)
    assert (generator.get_state() == before).all()


def test_kid_of_one_source_is_zero_on_average_and_grows_with_the_distance() -> None:
    same = [kid(features(2 * s, 30), features(2 * s + 1, 30), torch.Generator()) for s in range(60)]
    assert abs(np.mean(same)) < 3 * np.std(same) / 60**0.5
    near, far = (kid(features(0, 30), features(1, 30, shift=s), torch.Generator()) for s in (0.1, 0.3))
    assert np.std(same) < near < far


@pytest.mark.parametrize(("n", "m"), [(40, 50), (4, 5), (40, 4)], ids=["many", "few", "mixed"])
def test_fid_is_the_formula_with_a_matrix_root(n: int, m: int) -> None:
    x, y = features(3, n), features(4, m, shift=0.2)
    first, second = np.cov(x.double().numpy().T), np.cov(y.double().numpy().T)
    apart = ((x.double().mean(0) - y.double().mean(0)) ** 2).sum().item()
    # A little on the diagonal, without which the root of a singular product is not defined well.
    root = np.real(np.trace(sqrtm(first @ second + 1e-12 * np.eye(6))))
    assert fid(x, y) == pytest.approx(apart + np.trace(first) + np.trace(second) - 2 * root, abs=2e-5)


@given(st.integers(0, 99))
def test_fid_is_symmetric_and_zero_for_equal_sets(seed: int) -> None:
    x, y = features(seed, 9), features(seed + 100, 7)
    assert fid(x, y) == pytest.approx(fid(y, x), abs=1e-9)
    assert fid(x, x) == pytest.approx(0, abs=1e-9)
    assert fid(x, y) > 0


def test_one_image_is_one_clear_sentence() -> None:
    with pytest.raises(TwofoldError, match="KID needs at least 2"):
        polynomial_mmd(features(0, 1), features(0, 5))
    with pytest.raises(TwofoldError, match="FID needs at least 2"):
        fid(features(0, 5), features(0, 1))
