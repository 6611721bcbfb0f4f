import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from twofold import losses


def random(*shape, seed=0):
    return torch.rand(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def literal_l1(color, truth):
    """Sum over rays of the L1 norm, as printed."""
    return sum(sum(abs(a - b) for a, b in zip(p, q, strict=True)) for p, q in zip(color, truth, strict=True))


@pytest.mark.parametrize("loss", [losses.reconstruction, losses.common])
def test_color_losses_are_the_printed_sum_or_its_mean(loss):
    color, truth = random(7, 3), random(7, 3, seed=1)
    exact = literal_l1(color.tolist(), truth.tolist())
    assert loss(color, truth, "sum").item() == pytest.approx(exact)
    assert loss(color, truth).item() == pytest.approx(exact / 21)


def test_eikonal_is_the_printed_mean():
    gradient = random(9, 3) * 3
    exact = sum((math.sqrt(sum(g * g for g in row)) - 1) ** 2 for row in gradient.tolist()) / 9
    assert losses.eikonal(gradient).item() == pytest.approx(exact)


def test_eikonal_is_zero_for_unit_gradients_and_has_a_finite_slope_at_zero():
    unit = torch.nn.functional.normalize(random(9, 3) - 0.5, dim=1)
    assert losses.eikonal(unit).item() == pytest.approx(0, abs=1e-12)
    flat = torch.zeros(4, 3, requires_grad=True)
    losses.eikonal(flat).backward()
    assert flat.grad.isfinite().all()


def test_total_is_the_weighted_sum():
    terms = {name: torch.tensor(value) for name, value in (("rec", 1.0), ("eik", 2.0), ("com", 4.0), ("lpips", 8.0))}
    weights = {"eik": 0.1, "com": 0.5, "lpips": 1.0}
    assert losses.total(terms, weights).item() == pytest.approx(1 + 0.1 * 2 + 0.5 * 4 + 8)
    assert losses.total(terms).item() == pytest.approx(15)


@pytest.mark.parametrize(("terms", "weights"), [({}, {}), ({"rec": torch.zeros(())}, {"rce": 1.0})])
def test_total_refuses_weights_without_terms(terms, weights):
    with pytest.raises(ValueError, match="weights are for"):
        losses.total(terms, weights)


def test_mask_adds_the_means_of_both_sides():
    opacity, coverage = random(10), (random(10, seed=1) > 0.7).double()
    inside = [1 - o for o, c in zip(opacity.tolist(), coverage.tolist(), strict=True) if c == 1]
    outside = [o for o, c in zip(opacity.tolist(), coverage.tolist(), strict=True) if c == 0]
    exact = sum(inside) / len(inside) + sum(outside) / len(outside)
    assert losses.mask(opacity, coverage).item() == pytest.approx(exact)
    assert losses.mask(opacity, coverage, "mean").item() == pytest.approx((sum(inside) + sum(outside)) / 10)


@pytest.mark.parametrize("form", ["sides", "mean"])
@pytest.mark.parametrize("covered", [0.0, 1.0])
def test_mask_is_zero_when_right_even_with_one_side_empty(form, covered):
    coverage = torch.full((5,), covered)
    assert losses.mask(coverage, coverage, form).item() == 0


def test_soft_pixels_count_to_both_sides_by_their_shares():
    opacity, coverage = torch.tensor([1.0, 0.0, 0.0]), torch.tensor([0.75, 0.5, 0.0])
    inside = (0.75 * 0.25 + 0.5 * 0.5) / 1.25
    outside = (0.25 * 0.25 + 0.5 * 0.5) / 1.75
    assert losses.mask(opacity, coverage).item() == pytest.approx(inside + outside)
    assert losses.mask(coverage, coverage).item() == 0


def literal_hard_mask(opacity, coverage, singles):
    """Ray by ray with labels; single pixels and patch pixels apart, halved."""
    means = []
    for group in (range(singles), range(singles, len(opacity))):
        inside, outside = [], []
        for ray in group:
            label = math.floor(coverage[ray]) if ray < singles else math.ceil(coverage[ray])
            (inside if label else outside).append(abs(opacity[ray] - label))
        means.append(sum(inside) / max(len(inside), 1) + sum(outside) / max(len(outside), 1))
    return (means[0] + means[1]) / 2


@given(seed=st.integers(0, 999), singles=st.integers(1, 11))
def test_hard_mask_is_the_ray_by_ray_loop_over_both_groups(seed, singles):
    opacity, coverage = random(12, seed=seed), (4 * random(12, seed=seed + 1) - 1.5).clamp(0, 1)
    exact = literal_hard_mask(opacity.tolist(), coverage.tolist(), singles)
    assert losses.hard_mask(opacity, coverage, singles).item() == pytest.approx(exact, rel=1e-12)


def test_hard_mask_without_patches_or_without_one_side_is_the_mean_of_what_is_there():
    opacity, coverage = torch.tensor([0.25, 0.5]), torch.tensor([1.0, 1.0])
    assert losses.hard_mask(opacity, coverage, 2).item() == pytest.approx(0.625)
    assert losses.hard_mask(opacity, coverage, 0).item() == pytest.approx(0.625)


def literal_s3im(color, truth, orders, center=1.5):
    """Window by window over the virtual image, borders of zeros, as the term is described."""
    rays, order = len(color), [i for part in orders for i in part]
    height = math.isqrt(rays)
    width = len(order) // height
    bell = [math.exp(-((i - center) ** 2) / (2 * 1.5**2)) for i in range(4)]
    norm = sum(bell) ** 2
    values = []
    for channel in range(3):
        images = [
            [[float(c[order[y * width + x]][channel]) for x in range(width)] for y in range(height)]
            for c in (color, truth)
        ]

        def pixel(image, y, x, images=images):
            return images[image][y][x] if 0 <= y < height and 0 <= x < width else 0.0

        for top in range(-1, height + 1 - 3, 4):
            for left in range(-1, width + 1 - 3, 4):
                window = [
                    (bell[i] * bell[j] / norm, pixel(0, top + i, left + j), pixel(1, top + i, left + j))
                    for i in range(4)
                    for j in range(4)
                ]
                m1, m2 = (sum(w[0] * w[k] for w in window) for k in (1, 2))
                v1, v2 = (sum(w[0] * w[k] ** 2 for w in window) - m**2 for k, m in ((1, m1), (2, m2)))
                cov = sum(w[0] * w[1] * w[2] for w in window) - m1 * m2
                ssim = (2 * m1 * m2 + 1e-4) * (2 * cov + 9e-4) / ((m1**2 + m2**2 + 1e-4) * (v1 + v2 + 9e-4))
                values.append(ssim)
    return 1 - sum(values) / len(values)


@pytest.mark.parametrize("center", [1.5, 2.0])
@pytest.mark.parametrize("rays", [4, 36, 41])
def test_s3im_is_the_window_by_window_loop(rays, center):
    color, truth = random(rays, 3), random(rays, 3, seed=1)
    source = torch.Generator().manual_seed(3)
    orders = [list(range(rays)), *(torch.randperm(rays, generator=source).tolist() for _ in range(9))]
    found = losses.s3im(color, truth, torch.Generator().manual_seed(3), center)
    assert found.item() == pytest.approx(literal_s3im(color.tolist(), truth.tolist(), orders, center))


def test_s3im_lays_576_rays_out_as_24_by_240(monkeypatch):
    seen = []
    original = losses._windowed_ssim
    monkeypatch.setattr(losses, "_windowed_ssim", lambda a, b, c: (seen.append(a.shape), original(a, b, c))[1])
    losses.s3im(random(576, 3), random(576, 3, seed=1), torch.Generator().manual_seed(0))
    assert seen == [(3, 1, 24, 240)]


@pytest.mark.parametrize("center", [1.5, 2.0])
@pytest.mark.parametrize("rays", [4, 9, 36, 41, 300])
def test_compiled_s3im_and_its_gradient_are_those_of_the_convolutions(rays, center):
    """Single precision against double precision, which is left to PyTorch."""
    values, gradients = [], []
    for dtype in (torch.float32, torch.float64):
        color = random(rays, 3).float().to(dtype).requires_grad_()
        truth = random(rays, 3, seed=1).float().to(dtype)
        assert losses.can_pick(color, truth) == (dtype == torch.float32)
        loss = losses.s3im(color, truth, torch.Generator().manual_seed(3), center)
        (0.7 * loss).backward()
        values.append(loss.detach().double())
        gradients.append(color.grad.double())
    torch.testing.assert_close(*values, rtol=1e-6, atol=1e-7)
    torch.testing.assert_close(*gradients, rtol=1e-4, atol=1e-7)


@given(rays=st.integers(4, 80), seed=st.integers(0, 1000))
def test_s3im_is_zero_for_equal_colors_and_at_most_two(rays, seed):
    color, truth = random(rays, 3, seed=seed), random(rays, 3, seed=seed + 1)
    generator = torch.Generator().manual_seed(seed)
    assert losses.s3im(color, color, generator).item() == pytest.approx(0, abs=1e-9)
    assert 0 < losses.s3im(color, truth, generator).item() < 2


def test_s3im_of_too_few_rays_is_zero_and_can_be_trained_on():
    color = torch.rand(3, 3, requires_grad=True)
    loss = losses.s3im(color, torch.rand(3, 3), torch.Generator())
    loss.backward()
    assert loss.item() == 0


def test_losses_pass_gradcheck():
    color, truth = random(9, 3).requires_grad_(), random(9, 3, seed=1)
    assert torch.autograd.gradcheck(lambda c: losses.reconstruction(c, truth), color)
    assert torch.autograd.gradcheck(losses.eikonal, color)
    assert torch.autograd.gradcheck(lambda c: losses.s3im(c, truth, torch.Generator().manual_seed(0)), color)
    opacity = random(9).requires_grad_()
    assert torch.autograd.gradcheck(lambda o: losses.mask(o, random(9, seed=1)), opacity)


def test_s3im_is_the_same_on_every_device(device, generator):
    color, truth = random(41, 3), random(41, 3, seed=1)
    found = losses.s3im(color.to(device), truth.to(device), generator)
    assert found.item() == pytest.approx(losses.s3im(color, truth, torch.Generator().manual_seed(0)).item())


def test_squared_error_is_the_mean_over_rays_and_channels():
    color, truth = random(7, 3), random(7, 3, seed=1)
    exact = sum((a - b) ** 2 for a, b in zip(color.flatten().tolist(), truth.flatten().tolist(), strict=True)) / 21
    assert losses.squared_error(color, truth).item() == pytest.approx(exact)


def test_binarisation_is_twice_the_mean_entropy_and_finite_at_its_ends():
    opacity = random(9)
    exact = -2 / 9 * sum(a * math.log(a + 1e-6) + (1 - a) * math.log(1 - a + 1e-6) for a in opacity.tolist())
    assert losses.binarisation(opacity).item() == pytest.approx(exact)
    ends = torch.tensor([0.0, 1.0], requires_grad=True)
    loss = losses.binarisation(ends)
    loss.backward()
    assert loss.item() == pytest.approx(0, abs=1e-5)
    assert ends.grad.isfinite().all()


@pytest.mark.parametrize(
    ("loss", "counts", "value"),
    [
        (losses.opacity_sparseness, lambda d: d > 0.05, lambda a: abs(a)),
        (losses.in_shape, lambda d: d <= 0, lambda a: abs(1 - a)),
    ],
)
def test_opacity_terms_are_means_over_the_rays_that_count(loss, counts, value):
    opacity, clearance = random(40), 0.3 * (random(40, seed=1) - 0.5)
    chosen = [value(a) for a, d in zip(opacity.tolist(), clearance.tolist(), strict=True) if counts(d)]
    assert 0 < len(chosen) < 40
    assert loss(opacity, clearance).item() == pytest.approx(sum(chosen) / len(chosen))
    assert loss(opacity, torch.full((40,), 0.03, dtype=torch.float64)).item() == 0


def test_sparseness_grows_while_in_shape_fades():
    sparse, inside = zip(*(losses.sparseness_weights(e) for e in range(0, 301, 50)), strict=True)
    assert list(sparse) == sorted(sparse)
    assert list(inside) == sorted(inside, reverse=True)
    assert losses.sparseness_weights(100) == pytest.approx((3e-3 * 251, 0.5e-2))


def test_consistency_is_the_mean_over_likely_points_that_come_back_elsewhere():
    x, shift, likelihood = random(50, 3), 0.1 * (random(50, 3, seed=1) - 0.5), random(50, seed=2)
    chosen = [
        math.dist(a, b)
        for a, b, w in zip(x.tolist(), (x + shift).tolist(), likelihood.tolist(), strict=True)
        if w > 0.3 and math.dist(a, b) > 0.05
    ]
    assert 0 < len(chosen) < 50
    found = losses.deformation_consistency(x, x + shift, likelihood)
    assert found.item() == pytest.approx(sum(chosen) / len(chosen))
    same = x.clone().requires_grad_()
    losses.deformation_consistency(x, same, likelihood).backward()
    assert same.grad.isfinite().all()


def test_box_terms_are_the_printed_sums():
    sizes, p, hit = random(24, 3), random(6, 24), (random(6, seed=1) > 0.5).double()
    assert losses.box_volumes(sizes).item() == pytest.approx(sum(a * b * c for a, b, c in sizes.tolist()))
    exact = sum((h - sum(row)) ** 2 for h, row in zip(hit.tolist(), p.tolist(), strict=True)) / 6
    assert losses.box_assignment(p, hit).item() == pytest.approx(exact)


def test_only_long_offsets_cost_something():
    offsets = 0.06 * (random(40, 3) - 0.5)
    lengths = [math.hypot(*row) for row in offsets.tolist()]
    assert 0 < sum(n > 0.04 for n in lengths) < 40
    assert losses.point_offsets(offsets).item() == pytest.approx(sum(n * n for n in lengths if n > 0.04) / 40)


def test_neighbours_keep_their_distances():
    posed, rest = random(5, 3), random(5, 3, seed=1)
    neighbours = torch.tensor([[1, 2], [0, 2], [3, 4], [4, 0], [0, 1]])
    total = 0.0
    for n, row in enumerate(neighbours.tolist()):
        for k in row:
            first = math.dist(posed[n].tolist(), posed[k].tolist())
            total += (first - math.dist(rest[n].tolist(), rest[k].tolist())) ** 2
    assert losses.neighbour_distances(posed, rest, neighbours).item() == pytest.approx(total / 10)


def test_points_outside_the_surface_cost_their_distance():
    assert losses.surface_points(torch.tensor([-1.0, 0.0, 0.3, 0.1])).item() == pytest.approx(0.1)


def test_background_counts_where_nobody_stands_and_leaves_the_opacity_alone():
    predicted, truth, opacity = random(6, 3), random(6, 3, seed=1), random(6, seed=2).requires_grad_()
    exact = 0.0
    for p, t, a in zip(predicted.tolist(), truth.tolist(), opacity.tolist(), strict=True):
        exact += sum((1 - a) * (x - y) ** 2 for x, y in zip(p, t, strict=True)) / 18
    loss = losses.background(predicted.requires_grad_(), truth, opacity)
    loss.backward()
    assert loss.item() == pytest.approx(exact)
    assert opacity.grad is None
