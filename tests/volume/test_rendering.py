import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from packed_samples import packed

from twofold.geometry.cameras import Rays
from twofold.volume.rendering import composite, composite_surface, composite_weights, laplace_density
from twofold.volume.samples import Samples


def literal_density(s, beta):
    """One over beta, times the Laplace distribution's CDF at -s."""
    cdf = 0.5 * math.exp(-s / beta) if -s <= 0 else 1 - 0.5 * math.exp(s / beta)
    return cdf / beta


def literal_weights(density, samples):
    """T_i (1 - exp(-sigma_i delta_i)) with T_i the product of what came before on that ray."""
    weights = []
    for i in range(len(samples)):
        before = sum(
            (density[j] * samples.delta[j]).item() for j in range(i) if samples.ray_index[j] == samples.ray_index[i]
        )
        weights.append(math.exp(-before) * (1 - math.exp(-(density[i] * samples.delta[i]).item())))
    return torch.tensor(weights, dtype=density.dtype)


COUNTS = st.lists(st.integers(0, 6), min_size=1, max_size=6)


@settings(max_examples=40, deadline=None)
@given(s=st.floats(-3, 3), beta=st.floats(1e-3, 2))
def test_density_is_the_scaled_laplace_distribution(s, beta):
    found = laplace_density(torch.tensor(s, dtype=torch.float64), torch.tensor(beta, dtype=torch.float64))
    torch.testing.assert_close(found.item(), literal_density(s, beta), rtol=1e-12, atol=1e-300)


def test_density_falls_from_one_over_beta_to_zero():
    beta = torch.tensor(0.05)
    density = laplace_density(torch.linspace(-2, 2, 401), beta)
    assert (density.diff() <= 0).all()
    torch.testing.assert_close(density[[0, 200, -1]], torch.tensor([20.0, 10.0, 0.0]), atol=1e-6, rtol=1e-6)


def test_density_has_finite_gradients_at_and_far_from_the_surface():
    s = torch.tensor([-1e3, -1.0, 0.0, 1e-9, 1.0, 1e3], requires_grad=True)
    beta = torch.tensor(1e-4, requires_grad=True)
    laplace_density(s, beta).sum().backward()
    assert s.grad.isfinite().all()
    assert beta.grad.isfinite()


def test_density_passes_gradcheck():
    s = torch.tensor([-0.3, -0.05, 0.02, 0.4], dtype=torch.float64, requires_grad=True)
    beta = torch.tensor(0.1, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(laplace_density, (s, beta))


@settings(max_examples=40, deadline=None)
@given(counts=COUNTS, seed=st.integers(0, 1000))
def test_weights_are_those_of_the_ray_by_ray_loop(counts, seed):
    samples, density = packed(counts, seed)
    torch.testing.assert_close(composite_weights(density, samples), literal_weights(density, samples))


@settings(max_examples=40, deadline=None)
@given(counts=COUNTS, seed=st.integers(0, 1000))
def test_weights_of_a_ray_sum_to_its_opacity_and_never_past_one(counts, seed):
    samples, density = packed(counts, seed)
    weights = composite_weights(density, samples)
    opacity = composite(weights, torch.ones(len(samples), 1, dtype=torch.float64), samples, len(counts))[:, 0]
    assert (weights >= 0).all()
    assert (opacity <= 1 + 1e-12).all()
    for ray in range(len(counts)):
        on = samples.ray_index == ray
        exact = 1 - math.exp(-(density[on] * samples.delta[on]).sum().item())
        torch.testing.assert_close(opacity[ray].item(), exact)


def test_composite_adds_up_each_ray_and_leaves_the_empty_ones_zero():
    samples, density = packed([2, 0, 3], seed=1)
    weights = composite_weights(density, samples)
    colors = torch.rand(5, 3, dtype=torch.float64)
    image = composite(weights, colors, samples, 4)
    expected = torch.stack(
        [
            weights[0] * colors[0] + weights[1] * colors[1],
            torch.zeros(3, dtype=torch.float64),
            weights[2] * colors[2] + weights[3] * colors[3] + weights[4] * colors[4],
            torch.zeros(3, dtype=torch.float64),
        ]
    )
    torch.testing.assert_close(image, expected)


def test_samples_of_other_rays_do_not_matter():
    samples, density = packed([3, 4], seed=2)
    alone = composite_weights(density[3:], samples[torch.arange(3, 7)])
    torch.testing.assert_close(composite_weights(density, samples)[3:], alone)


def test_many_opaque_rays_keep_single_precision():
    samples, density = packed([50] * 2000, dtype=torch.float32)
    weights = composite_weights(1000 * density, samples)
    exact = composite_weights(
        1000 * density.double(), Samples(samples.ray_index, samples.depth, samples.delta.double())
    )
    torch.testing.assert_close(weights, exact.float(), rtol=1e-5, atol=1e-6)


def test_compositing_passes_gradcheck():
    samples, density = packed([2, 0, 3])

    def image(density, delta, colors):
        moved = Samples(samples.ray_index, samples.depth, delta)
        return composite(composite_weights(density, moved), colors, moved, 3)

    colors = torch.rand(5, 3, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(image, (density.requires_grad_(), samples.delta.requires_grad_(), colors))


def test_points_lie_on_their_rays():
    rays = Rays(torch.tensor([[0.0, 0, 0], [1, 0, 0]]), torch.tensor([[0.0, 0, 1], [0, 1, 0]]), *torch.zeros(2, 2))
    samples = Samples(torch.tensor([0, 1, 1]), torch.tensor([2.0, 3.0, 4.0]), torch.ones(3))
    assert samples.points(rays).tolist() == [[0, 0, 2], [1, 3, 0], [1, 4, 0]]
    assert len(samples[torch.tensor([0, 2])]) == 2


def test_no_samples_render_nothing():
    samples, density = packed([0, 0])
    assert composite(composite_weights(density, samples), torch.zeros(0, 3, dtype=torch.float64), samples, 2).sum() == 0


@given(counts=COUNTS, seed=st.integers(0, 1000))
def test_compiled_weights_and_their_gradient_are_those_of_the_twin(counts, seed):
    samples, density = packed(counts, seed)
    density = 0.1 * density
    pull = torch.rand(len(density), generator=torch.Generator().manual_seed(seed)) - 0.3

    def both(dtype):
        sigma = density.to(dtype).requires_grad_()
        cast = Samples(samples.ray_index, samples.depth.to(dtype), samples.delta.to(dtype))
        weights = composite_weights(sigma, cast)
        return weights.detach(), torch.autograd.grad((weights * pull.to(dtype)).sum(), sigma)[0]

    for single, double in zip(both(torch.float32), both(torch.float64), strict=True):
        torch.testing.assert_close(single.double(), double, atol=1e-6, rtol=1e-4)


def surface_case(counts, seed, dtype=torch.float32):
    """Distances around a surface, colours, normals, samples, a scale, and a cotangent."""
    samples = packed(counts, seed, dtype)[0]
    draw = torch.Generator().manual_seed(seed)
    count = len(samples)
    sdf = 0.03 * torch.randn(count, generator=draw, dtype=dtype)
    color, normals = (torch.rand(count, 3, generator=draw, dtype=dtype) for _ in range(2))
    by_out = torch.randn(len(counts), 8, generator=draw, dtype=dtype)
    return sdf, torch.tensor(0.02, dtype=dtype), color, normals, samples, by_out


def step_by_step(sdf, beta, color, normals, samples, rays):
    weights = composite_weights(laplace_density(sdf, beta), samples)
    values = torch.cat([color, torch.ones_like(color[:, :1]), samples.depth[:, None], normals], -1)
    return composite(weights, values, samples, rays)


@settings(max_examples=30, deadline=None)
@given(counts=COUNTS, seed=st.integers(0, 2**20))
def test_surfaces_are_composited_at_once_as_step_by_step(counts, seed):
    """Values and gradients, in single precision against the steps in double precision."""
    results = []
    for dtype, render in ((torch.float32, composite_surface), (torch.float64, step_by_step)):
        sdf, beta, color, normals, samples, by_out = surface_case(counts, seed)
        sdf, beta, color, normals, by_out = (t.to(dtype) for t in (sdf, beta, color, normals, by_out))
        samples = Samples(samples.ray_index, samples.depth.to(dtype), samples.delta.to(dtype))
        learned = [t.requires_grad_() for t in (sdf, beta, color)]
        out = render(*learned, normals, samples, len(counts))
        out.backward(by_out)
        results.append([out.detach(), *(t.grad if t.grad is not None else torch.zeros_like(t) for t in learned)])
    for ours, twin in zip(*results, strict=True):
        size = max(1.0, *twin.abs().flatten().tolist(), 0.0)
        torch.testing.assert_close(ours.double(), twin, rtol=2e-4, atol=2e-5 * size)


def test_surfaces_composited_at_once_pass_gradcheck_where_they_are_steps():
    sdf, beta, color, normals, samples, _ = surface_case([3, 0, 4], 1, torch.float64)
    learned = [t.requires_grad_() for t in (sdf, beta, color)]
    assert torch.autograd.gradcheck(lambda *t: composite_surface(*t, normals, samples, 3), learned)


def test_normals_are_constants_of_a_composited_surface():
    sdf, beta, color, normals, samples, by_out = surface_case([2, 3], 2)
    normals.requires_grad_()
    composite_surface(sdf.requires_grad_(), beta, color, normals, samples, 2).backward(by_out)
    assert normals.grad is None


def test_samples_of_rays_that_are_not_there_are_refused():
    sdf, beta, color, normals, samples, _ = surface_case([2, 3], 2)
    with pytest.raises(ValueError, match="samples are of 1 rays, the last one is of ray 1"):
        composite_surface(sdf, beta, color, normals, samples, 1)
