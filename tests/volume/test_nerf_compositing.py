import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from twofold.volume.nerf_compositing import (
    alpha_of_density,
    alpha_weights,
    open_density_weights,
    open_samples,
    without_thin_density,
)

RAYS = st.lists(st.lists(st.floats(0, 60), min_size=1, max_size=6), min_size=1, max_size=4)


def packed(rays):
    values = torch.tensor([v for ray in rays for v in ray], dtype=torch.float64)
    index = torch.tensor([r for r, ray in enumerate(rays) for _ in ray])
    return values, index


def deltas_of(rays):
    return torch.tensor([d for ray in rays for d in [0.05] * (len(ray) - 1) + [1e10]], dtype=torch.float64)


@given(RAYS)
def test_alpha_weights_are_the_literal_product(rays):
    density, index = packed(rays)
    alpha = alpha_of_density(density, deltas_of(rays))
    expected, k = [], 0
    for ray in rays:
        through = 1.0
        for i, sigma in enumerate(ray):
            a = 1 - math.exp(-sigma * (1e10 if i == len(ray) - 1 else 0.05))
            expected.append(a * through)
            through *= 1 - a + 1e-10
            k += 1
    torch.testing.assert_close(alpha_weights(alpha, index), torch.tensor(expected, dtype=torch.float64))


@given(st.lists(st.lists(st.floats(0, 1.5), min_size=1, max_size=6), min_size=1, max_size=4))
def test_alphas_above_one_give_the_literal_product_with_its_sign(rays):
    alpha, index = packed(rays)
    expected = [a * math.prod(1 - b + 1e-10 for b in ray[:i]) for ray in rays for i, a in enumerate(ray)]
    torch.testing.assert_close(alpha_weights(alpha, index), torch.tensor(expected, dtype=torch.float64))


def test_gradients_by_alphas_above_one_are_those_of_finite_differences():
    alpha = torch.tensor([0.3, 1.2, 0.9, 1.4, 0.2], dtype=torch.float64, requires_grad=True)
    torch.autograd.gradcheck(lambda a: alpha_weights(a, torch.tensor([0, 0, 0, 1, 1])), alpha)


@given(RAYS)
def test_density_weights_are_the_literal_exponentials(rays):
    density, index = packed(rays)
    expected = []
    for ray in rays:
        total = 0.0
        for i, sigma in enumerate(ray):
            optical = sigma * (1e10 if i == len(ray) - 1 else 0.05)
            expected.append(math.exp(-total) * (1 - math.exp(-optical)))
            total += optical
    weights = open_density_weights(density, deltas_of(rays), index)
    torch.testing.assert_close(weights, torch.tensor(expected, dtype=torch.float64), atol=1e-12, rtol=1e-7)


def test_many_opaque_rays_leave_the_last_one_its_digits():
    density = torch.full((10_000,), 50.0)
    index = torch.arange(5000).repeat_interleave(2)
    delta = torch.tensor([0.001, 1e10]).repeat(5000)
    weights = open_density_weights(density, delta, index)
    torch.testing.assert_close(weights[-2:].double(), torch.tensor([1 - math.exp(-0.05), math.exp(-0.05)]).double())


def test_gradients_are_those_of_finite_differences():
    density = torch.tensor([0.3, 4.0, 0.1, 2.0, 1.0], dtype=torch.float64, requires_grad=True)
    delta = torch.tensor([0.2, 0.3, 0.1, 0.5, 0.4], dtype=torch.float64)
    index = torch.tensor([0, 0, 0, 2, 2])
    assert torch.autograd.gradcheck(lambda d: alpha_weights(alpha_of_density(d, delta), index), density)
    assert torch.autograd.gradcheck(lambda d: open_density_weights(d, delta, index), density)


def test_opaque_samples_have_finite_gradients():
    alpha = torch.tensor([1.0, 1.0, 0.5], requires_grad=True)
    alpha_weights(alpha, torch.zeros(3, dtype=torch.long)).sum().backward()
    assert alpha.grad is not None
    assert alpha.grad.isfinite().all()


def test_open_samples_end_in_the_open_interval():
    samples = open_samples(torch.tensor([[1.0, 2.0, 4.0], [0.0, 1.0, 2.0]]))
    assert samples.ray_index.tolist() == [0, 0, 0, 1, 1, 1]
    assert samples.delta.tolist() == pytest.approx([1, 2, 1e10, 1, 1, 1e10])


def test_only_thin_densities_vanish():
    assert without_thin_density(torch.tensor([0.0, 1.99, 2.0, 5.0])).tolist() == [0, 0, 2, 5]
