import math
from dataclasses import replace
from itertools import pairwise

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from twofold.geometry.cameras import Rays
from twofold.sampling.error_bounded import (
    ErrorBoundedSampler,
    error_bound,
    invert,
    samples_between,
    surface_clearance,
    uniform_depths,
)
from twofold.volume.rendering import composite, composite_weights, laplace_density

SMALL = ErrorBoundedSampler(refined=12, shaded=7, extra=5, rounds=3, bisections=6)


def some_rays(count=6, seed=0):
    """From three metres away past and through a ball of half a metre at the origin."""
    generator = torch.Generator().manual_seed(seed)
    origins = torch.nn.functional.normalize(torch.randn(count, 3, generator=generator, dtype=torch.float64), dim=1) * 3
    targets = 0.35 * torch.randn(count, 3, generator=generator, dtype=torch.float64)
    directions = torch.nn.functional.normalize(targets - origins, dim=1)
    near = torch.full((count,), 1.5, dtype=torch.float64)
    return Rays(origins, directions, near, near + 3)


def ball(points):
    return points.norm(dim=1) - 0.5


def density(s, beta):
    return (0.5 * math.exp(-s / beta) if s > 0 else 1 - 0.5 * math.exp(s / beta)) / beta


def clearance(a, s, t):
    b, c = abs(s), abs(t)
    if s * t <= 0:
        return 0.0
    if a * a + b * b <= c * c:
        return b
    if a * a + c * c <= b * b:
        return c
    if b + c > a:
        p = (a + b + c) / 2
        return 2 * math.sqrt(max(p * (p - a) * (p - b) * (p - c), 0)) / a
    return 0.0


def literal_bounds(z, s, beta):
    """Error bound of every section."""
    bounds, optical, error = [], 0.0, 0.0
    for i in range(len(z) - 1):
        delta = z[i + 1] - z[i]
        error += math.exp(-clearance(delta, s[i], s[i + 1]) / beta) * delta**2 / (4 * beta**2)
        bounds.append(math.exp(-optical) * (min(math.exp(min(error, 700)), 1e6) - 1))
        optical += delta * density(s[i], beta)
    return bounds


def literal_invert(z, shares, quantiles):
    total, cumulative = sum(shares), [0.0]
    for share in shares:
        cumulative.append(cumulative[-1] + share / total)
    out = []
    for u in quantiles:
        i = max(j for j in range(len(shares)) if cumulative[j] <= u)
        width = cumulative[i + 1] - cumulative[i]
        part = (u - cumulative[i]) / (1.0 if width < 1e-5 else width)
        out.append(z[i] + min(max(part, 0), 1) * (z[i + 1] - z[i]))
    return out


def literal_sampler(sampler, rays, sdf, beta, draws):
    """The algorithm ray by ray; `draws` are the random numbers of training, or None."""
    state = []
    for r in range(len(rays)):
        near, far, n = rays.near[r].item(), rays.far[r].item(), sampler.refined
        z = [near + (far - near) * i / (n - 1) for i in range(n)]
        if draws is not None:
            mid = [(a + b) / 2 for a, b in pairwise(z)]
            low, high = [z[0], *mid], [*mid, z[-1]]
            z = [a + (b - a) * u for a, b, u in zip(low, high, draws[0][r].tolist(), strict=True)]
        squares = sum((b - a) ** 2 for a, b in pairwise(z))
        state.append({"z": [], "s": [], "new": z, "scale": math.sqrt(squares / (4 * math.log(1 + sampler.tolerance)))})
    finals = [None] * len(rays)
    for turn in range(sampler.rounds):
        for r, ray in enumerate(state):
            if finals[r] is not None:
                continue
            points = rays.origins[r] + torch.tensor(ray["new"], dtype=torch.float64)[:, None] * rays.directions[r]
            pairs = sorted([*zip(ray["z"], ray["s"], strict=True), *zip(ray["new"], sdf(points).tolist(), strict=True)])
            ray["z"], ray["s"] = [p[0] for p in pairs], [p[1] for p in pairs]

            def good(trial, ray=ray):
                return max(literal_bounds(ray["z"], ray["s"], trial)) <= sampler.tolerance

            low = beta
            high = beta if good(beta) else ray["scale"]
            for _ in range(sampler.bisections):
                middle = (low + high) / 2
                low, high = (low, middle) if good(middle) else (middle, high)
            ray["scale"] = high
        last = turn == sampler.rounds - 1
        everyone = all(ray["scale"] <= beta for ray in state)
        for r, ray in enumerate(state):
            if finals[r] is not None:
                continue
            z, s, scale = ray["z"], ray["s"], ray["scale"]
            if last or (scale <= beta if sampler.per_ray_stop else everyone):
                shares, optical = [], 0.0
                for i in range(len(z) - 1):
                    step = (z[i + 1] - z[i]) * density(s[i], scale)
                    shares.append(math.exp(-optical) * (1 - math.exp(-step)) + 1e-5)
                    optical += step
                if draws is None:
                    quantiles = [i / (sampler.shaded - 1) for i in range(sampler.shaded)]
                    chosen = [int(i * (len(z) - 1) / (sampler.extra - 1)) for i in range(sampler.extra)]
                else:
                    quantiles, chosen = draws[1][r].tolist(), draws[2].tolist()
                ends = [0.0, 6.0] if sampler.ends == "released" else [rays.near[r].item(), rays.far[r].item()]
                finals[r] = sorted([*ends, *(z[i] for i in chosen), *literal_invert(z, shares, quantiles)])
            else:
                shares = [b + 1e-6 for b in literal_bounds(z, s, scale)]
                even = [i / (sampler.refined - 1) for i in range(sampler.refined)]
                ray["new"] = literal_invert(z, shares, even)
    return torch.tensor(finals, dtype=torch.float64)


CASES = {
    "released ends": (SMALL, 0.02),
    "own ends": (replace(SMALL, ends="ray"), 0.02),
    "soft, stops early": (SMALL, 0.5),
    "each ray stops by itself": (replace(SMALL, per_ray_stop=True, rounds=6), 0.06),
}


@pytest.mark.parametrize(("sampler", "beta"), CASES.values(), ids=CASES.keys())
def test_sampler_is_the_ray_by_ray_loop(sampler, beta):
    rays = some_rays()
    samples = sampler.sample(rays, ball, torch.tensor(beta, dtype=torch.float64), None, training=False)
    expected = samples_between(literal_sampler(sampler, rays, ball, beta, None))
    assert torch.equal(samples.ray_index, expected.ray_index)
    torch.testing.assert_close(samples.depth, expected.depth, rtol=1e-9, atol=1e-9)
    torch.testing.assert_close(samples.delta, expected.delta, rtol=1e-9, atol=1e-9)


def test_training_draws_jitter_quantiles_and_one_subset_for_all_rays():
    rays, beta = some_rays(), 0.02
    generator = torch.Generator().manual_seed(4)
    draws = [
        torch.rand(6, SMALL.refined, dtype=torch.float64, generator=generator),
        torch.rand(6, SMALL.shaded, dtype=torch.float64, generator=generator),
        torch.randperm(SMALL.refined * SMALL.rounds, generator=generator)[: SMALL.extra],
    ]
    expected = samples_between(literal_sampler(SMALL, rays, ball, beta, draws))
    beta = torch.tensor(beta, dtype=torch.float64)
    samples = SMALL.sample(rays, ball, beta, torch.Generator().manual_seed(4), training=True)
    torch.testing.assert_close(samples.depth, expected.depth, rtol=1e-9, atol=1e-9)


def test_default_numbers_are_the_released_ones():
    asked = []

    def counted(points):
        asked.append(len(points))
        return ball(points)

    rays = some_rays(3)
    samples = ErrorBoundedSampler().sample(rays, counted, torch.tensor(1e-6, dtype=torch.float64), None, False)
    assert asked == [3 * 128] * 5
    assert torch.bincount(samples.ray_index).tolist() == [97] * 3
    assert samples.depth.min() == 0
    assert (samples.depth + samples.delta).max() == 6


def test_rays_that_stop_by_themselves_ask_less():
    asked = {}
    rays, beta = some_rays(40), torch.tensor(0.01, dtype=torch.float64)
    for stop in (False, True):
        count = []
        ErrorBoundedSampler(per_ray_stop=stop).sample(
            rays, lambda points, count=count: (count.append(len(points)), ball(points))[1], beta, None, False
        )
        asked[stop] = sum(count)
    assert asked[True] < asked[False]


def exact_transmittance(ray, t, beta):
    """Through the analytic ball, by fine quadrature."""
    steps = torch.linspace(ray.near.item(), t, 20_001, dtype=torch.float64)
    points = ray.origins + steps[:, None] * ray.directions
    values = laplace_density(ball(points), torch.tensor(beta, dtype=torch.float64))
    return math.exp(-torch.trapezoid(values, steps).item())


@pytest.mark.parametrize("beta", [0.03, 0.1])
def test_opacity_is_within_the_tolerance_once_converged(beta):
    rays = some_rays(4, seed=3)
    depths = uniform_depths(rays, 128)
    points = rays.origins[:, None] + depths[..., None] * rays.directions[:, None]
    distances = ball(points.flatten(0, 1)).unflatten(0, depths.shape)
    sampler = ErrorBoundedSampler()
    known = (depths.diff(dim=1).square().sum(1) / (4 * math.log(1.1))).sqrt()
    scales = sampler.smallest_scale(depths, distances, torch.tensor(beta, dtype=torch.float64), known)
    delta = depths.diff(dim=1)
    assert (error_bound(delta, distances, surface_clearance(delta, distances), scales).amax(1) <= 0.1).all()
    for r in range(4):
        scale = scales[r].item()
        optical = laplace_density(distances[r, :-1], scales[r]) * delta[r]
        estimate = torch.exp(-optical.cumsum(0))
        for k in range(10, 127, 13):
            exact = exact_transmittance(rays[r], depths[r, k + 1].item(), scale)
            assert abs(exact - estimate[k].item()) <= 0.1


def test_shaded_samples_render_the_ball_as_fine_ones_do():
    rays, beta = some_rays(30), torch.tensor(0.01, dtype=torch.float64)
    opacity = []
    for samples in (
        ErrorBoundedSampler(ends="ray").sample(rays, ball, beta, None, False),
        samples_between(uniform_depths(rays, 4000)),
    ):
        weights = composite_weights(laplace_density(ball(samples.points(rays)), beta), samples)
        opacity.append(composite(weights, torch.ones_like(weights)[:, None], samples, 30)[:, 0])
    assert (opacity[0] - opacity[1]).abs().max() < 0.1
    assert (opacity[0] - opacity[1]).abs().mean() < 0.02


@pytest.mark.parametrize("scale", [1e-3, 0.02, 1.0])
def test_error_bound_is_the_printed_one_cut_off_before_it_overflows(scale):
    depths = torch.tensor([[0.0, 0.1, 0.3, 0.4, 0.55, 0.9]], dtype=torch.float64)
    distances = torch.tensor([[0.5, 0.3, 0.08, -0.04, 0.05, 0.2]], dtype=torch.float64)
    delta = depths.diff(dim=1)
    clearances = surface_clearance(delta, distances)
    found = error_bound(delta, distances, clearances, torch.tensor([scale], dtype=torch.float64))
    expected = literal_bounds(depths[0].tolist(), distances[0].tolist(), scale)
    torch.testing.assert_close(found[0], torch.tensor(expected, dtype=torch.float64))


def test_no_rays_give_no_samples():
    rays = some_rays()[torch.arange(0)]
    assert len(SMALL.sample(rays, ball, torch.tensor(0.1, dtype=torch.float64), None, False)) == 0


def test_nothing_is_recorded_for_gradients():
    beta = torch.tensor(0.1, dtype=torch.float64, requires_grad=True)
    samples = SMALL.sample(some_rays(), lambda points: ball(points) * beta, beta, None, False)
    assert not samples.depth.requires_grad


def test_extreme_scales_stay_finite():
    for beta in (1e-4, 1e3):
        rays = some_rays()
        rays = Rays(rays.origins.float(), rays.directions.float(), rays.near.float(), rays.far.float())
        samples = ErrorBoundedSampler().sample(rays, ball, torch.tensor(beta), None, False)
        assert samples.depth.isfinite().all()
        assert (samples.delta >= 0).all()


@settings(max_examples=30, deadline=None)
@given(a=st.floats(0.01, 2), s=st.floats(-2, 2), t=st.floats(-2, 2))
def test_clearance_is_the_printed_case_distinction(a, s, t):
    found = surface_clearance(torch.tensor([[a]], dtype=torch.float64), torch.tensor([[s, t]], dtype=torch.float64))
    assert found.item() == pytest.approx(clearance(a, s, t), abs=1e-6)


@settings(max_examples=30, deadline=None)
@given(seed=st.integers(0, 10_000), sections=st.integers(1, 9))
def test_inverted_quantiles_follow_the_distribution(seed, sections):
    generator = torch.Generator().manual_seed(seed)
    depths = torch.rand(1, sections + 1, generator=generator, dtype=torch.float64).cumsum(1)
    shares = torch.rand(1, sections, generator=generator, dtype=torch.float64) + 1e-3
    quantiles = torch.linspace(0, 1, 50, dtype=torch.float64)[None]
    found = invert(depths, shares, quantiles)
    expected = literal_invert(depths[0].tolist(), shares[0].tolist(), quantiles[0].tolist())
    torch.testing.assert_close(found[0], torch.tensor(expected, dtype=torch.float64))
    assert (found.diff(dim=1) >= -1e-12).all()
    torch.testing.assert_close(found[0, [0, -1]], depths[0, [0, -1]])


@settings(max_examples=20, deadline=None)
@given(seed=st.integers(0, 10_000), count=st.integers(2, 40))
def test_random_depths_stay_in_their_strata(seed, count):
    rays = some_rays(3)
    even = uniform_depths(rays, count)
    depths = uniform_depths(rays, count, torch.Generator().manual_seed(seed))
    middle = (even[:, 1:] + even[:, :-1]) / 2
    assert (depths[:, :-1] <= middle + 1e-12).all()
    assert (depths[:, 1:] >= middle - 1e-12).all()
    assert (depths >= rays.near[:, None]).all()
    assert (depths <= rays.far[:, None]).all()


def test_random_sampling_needs_a_generator():
    with pytest.raises(ValueError, match="generator"):
        SMALL.sample(some_rays(), ball, torch.tensor(0.1, dtype=torch.float64), None, training=True)


@pytest.mark.parametrize(
    ("options", "named"),
    [({"refined": 1}, "refined=1"), ({"extra": 13}, "extra=13"), ({"tolerance": 0.0}, "tolerance=0.0")],
)
def test_impossible_settings_are_refused(options, named):
    with pytest.raises(ValueError, match=named):
        replace(SMALL, **options)


def test_samples_are_the_same_on_every_device(device, generator):
    rays = some_rays()
    there = Rays(*(t.to(device) for t in (rays.origins, rays.directions, rays.near, rays.far)))
    beta = torch.tensor(0.02, dtype=torch.float64)
    found = SMALL.sample(there, ball, beta.to(device), generator, training=True)
    expected = SMALL.sample(rays, ball, beta, torch.Generator().manual_seed(0), training=True)
    assert found.depth.device.type == device.type
    torch.testing.assert_close(found.depth.cpu(), expected.depth)
