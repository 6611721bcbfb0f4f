"""Equation 1 against a loop, its inverse, and the short cuts that samples take through it."""

import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from little_body import little_body, moved_pose, posed_little_body

from twofold.body.skeleton import canonical_pose, pose_body, shape_body, skin
from twofold.deform.skinning import (
    inverse_skinning,
    invert_affine,
    map_to_canonical,
    neighbour_weights,
    smooth_neighbour_weights,
    to_canonical,
    to_posed,
    vertex_transforms,
    with_pose_gradient,
)
from twofold.geometry.rotations import axis_angle_to_matrix

seeds = st.integers(0, 9999)


def near_the_body(body, count=60, spread=0.05, seed=1):
    generator = torch.Generator().manual_seed(seed)
    which = torch.randint(len(body.vertices), (count,), generator=generator)
    return body.vertices[which] + spread * torch.randn(count, 3, generator=generator, dtype=body.vertices.dtype)


def neighbours(points, vertices, k):
    squared, nearest = torch.cdist(points, vertices).square().topk(k, largest=False)
    return nearest, neighbour_weights(squared)


@pytest.fixture
def body():
    return posed_little_body(dtype=torch.float64)


def test_inverse_skinning_is_the_formula_point_by_point(body):
    x, weights = near_the_body(body), body.weights[:60]
    expected = []
    for point, shares in zip(x, weights, strict=True):
        blended = sum(share * bone for share, bone in zip(shares, body.bones, strict=True))
        expected.append((torch.linalg.inv(blended) @ torch.cat([point, torch.ones(1, dtype=torch.float64)]))[:3])
    torch.testing.assert_close(inverse_skinning(x, weights, body.bones), torch.stack(expected))


@given(seed=seeds, size=st.floats(0, 0.8))
def test_there_and_back_again(seed, size):
    body = posed_little_body(seed, size, torch.float64)
    canonical = near_the_body(body, seed=seed) - body.vertices.mean(0)
    weights = body.weights[torch.randint(len(body.weights), (60,), generator=torch.Generator().manual_seed(seed))]
    there = skin(canonical, weights, body.bones)
    torch.testing.assert_close(inverse_skinning(there, weights, body.bones), canonical)


@given(seed=seeds)
def test_affine_maps_are_inverted_as_linear_algebra_does(seed):
    generator = torch.Generator().manual_seed(seed)
    turn = axis_angle_to_matrix(torch.randn(5, 3, generator=generator, dtype=torch.float64))
    stretch = torch.diag_embed(0.5 + torch.rand(5, 3, generator=generator, dtype=torch.float64))
    rows = torch.cat([turn @ stretch, torch.randn(5, 3, 1, generator=generator, dtype=torch.float64)], -1)
    whole = torch.cat([rows, torch.tensor([0.0, 0, 0, 1], dtype=torch.float64).expand(5, 1, 4)], 1)
    torch.testing.assert_close(invert_affine(rows), torch.linalg.inv(whole)[:, :3])


def test_inverse_of_affine_maps_passes_gradcheck():
    rows = torch.eye(3, 4, dtype=torch.float64) + 0.3 * torch.randn(2, 3, 4, dtype=torch.float64)
    assert torch.autograd.gradcheck(invert_affine, rows.requires_grad_())


@pytest.mark.parametrize("k", [1, 4])
def test_neighbours_answer_as_the_formula_with_their_mean_weights(body, k):
    x = near_the_body(body)
    nearest, shares = neighbours(x, body.vertices, k)
    weights = (shares[..., None] * body.weights[nearest]).sum(1)
    found, _ = to_canonical(x, nearest, shares, vertex_transforms(body))
    torch.testing.assert_close(found, inverse_skinning(x, weights, body.bones))


@pytest.mark.parametrize("k", [1, 4])
def test_forward_skinning_by_the_same_neighbours_leads_back(body, k):
    x, forward = near_the_body(body), vertex_transforms(body)
    nearest, shares = neighbours(x, body.vertices, k)
    canonical, _ = to_canonical(x, nearest, shares, forward)
    torch.testing.assert_close(to_posed(canonical, nearest, shares, forward), x)


def test_posed_vertices_come_home_but_at_the_hips():
    body = posed_little_body()
    own = torch.arange(len(body.vertices))[:, None]
    found, _ = to_canonical(body.vertices, own, torch.ones(len(own), 1), vertex_transforms(body))
    # Canonical space bends the hips, and a blend of products is not the product of blends.
    bent = (body.weights[:, 0] > 0) & (body.weights[:, 1:3].sum(-1) > 0)
    assert bent.float().mean() < 0.1
    torch.testing.assert_close(found[~bent], body.canonical_vertices[~bent], atol=2e-6, rtol=0)
    assert (found - body.canonical_vertices).norm(dim=-1).max() < 0.01


def test_in_the_canonical_pose_nothing_moves():
    shaped = shape_body(little_body(), torch.zeros(1))
    body = pose_body(shaped, canonical_pose(), torch.zeros(3))
    x = near_the_body(body)
    found, turned = to_canonical(x, *neighbours(x, body.vertices, 4), vertex_transforms(body))
    torch.testing.assert_close(found, x, atol=1e-6, rtol=0)
    torch.testing.assert_close(turned, torch.eye(3).expand(60, 3, 3), atol=1e-6, rtol=0)


@pytest.mark.parametrize("k", [1, 4])
def test_matrix_turns_canonical_gradients_into_those_of_observation_space(body, k):
    x = near_the_body(body).requires_grad_()
    nearest, shares = neighbours(x.detach(), body.vertices, k)
    canonical, to_observation = to_canonical(x, nearest, shares, vertex_transforms(body))
    value = (torch.sin(3 * canonical) * torch.tensor([1.0, 2, 3], dtype=torch.float64)).sum()
    by_canonical, by_x = torch.autograd.grad(value, (canonical, x))
    torch.testing.assert_close((to_observation * by_canonical[:, None]).sum(-1), by_x)


@pytest.mark.parametrize("k", [1, 3])
def test_gradient_by_the_pose_is_that_of_the_plain_form(k):
    results = []
    for form in ("short", "plain"):
        pose = (0.3 * torch.randn(24, 3, generator=torch.Generator().manual_seed(2))).double().requires_grad_()
        body = posed_little_body(dtype=torch.float64)
        shaped = shape_body(little_body(), torch.zeros(1))
        shaped = type(shaped)(**{n: t.double() if t.is_floating_point() else t for n, t in vars(shaped).items()})
        posed = pose_body(shaped, pose, torch.zeros(3, dtype=torch.float64))
        x = near_the_body(body) - body.vertices.mean(0)
        nearest, shares = neighbours(x, posed.vertices.detach(), k)
        if form == "short":
            found, to_observation = to_canonical(x, nearest, shares, vertex_transforms(posed))
        else:
            blended = (shares[..., None] * posed.weights[nearest]).sum(1) @ posed.bones.flatten(1)
            inverse = torch.linalg.inv(blended.unflatten(-1, (4, 4)))
            found = (inverse[:, :3, :3] @ x[..., None])[..., 0] + inverse[:, :3, 3]
            to_observation = inverse[:, :3, :3].mT
        loss = torch.sin(found).sum() + torch.cos(to_observation).sum()
        results.append((found.detach(), torch.autograd.grad(loss, pose)[0]))
    torch.testing.assert_close(results[0], results[1])


@given(seed=seeds)
def test_turning_and_shifting_the_world_leaves_canonical_points_alone(seed):
    generator = torch.Generator().manual_seed(seed)
    body = little_body()
    shaped = shape_body(body, torch.zeros(1))
    pose, translation = 0.3 * torch.randn(24, 3, generator=generator), torch.randn(3, generator=generator)
    turn, shift = torch.randn(3, generator=generator), torch.randn(3, generator=generator)
    here = pose_body(shaped, pose, translation)
    there = pose_body(shaped, *moved_pose(pose, translation, body.joints[0], turn, shift))
    x = near_the_body(here, seed=seed)
    nearest, shares = neighbours(x, here.vertices, 3)
    first, _ = to_canonical(x, nearest, shares, vertex_transforms(here))
    moved = x @ axis_angle_to_matrix(turn).T + shift
    second, _ = to_canonical(moved, nearest, shares, vertex_transforms(there))
    torch.testing.assert_close(first, second, atol=2e-5, rtol=0)


@given(seed=seeds, k=st.integers(1, 5))
def test_shares_are_the_definition_and_sum_to_one(seed, k):
    squared = 6 * torch.rand(4, k, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    shares = neighbour_weights(squared)
    for row, found in zip(squared.tolist(), shares, strict=True):
        raw = [math.exp(-min(d, 4)) for d in row]
        torch.testing.assert_close(found, torch.tensor([r / sum(raw) for r in raw], dtype=torch.float64))
    torch.testing.assert_close(shares.sum(-1), torch.ones(4, dtype=torch.float64))


def test_smooth_shares_are_the_definition_and_forget_the_last():
    shares = smooth_neighbour_weights(torch.tensor([[0.0, 1.0, 2.0, 4.0]], dtype=torch.float64))
    raw = torch.tensor([[1.0, 0.5625, 0.25, 0.0]], dtype=torch.float64)
    torch.testing.assert_close(shares, raw / raw.sum(), atol=1e-5, rtol=0)
    for alike in (torch.zeros(1, 3), torch.ones(1, 3), torch.ones(1, 1)):
        torch.testing.assert_close(smooth_neighbour_weights(alike), torch.full_like(alike, 1 / alike.shape[1]))


@pytest.mark.parametrize("seed", range(5))
def test_points_beside_each_other_are_carried_alike_by_smooth_shares(seed):
    """Where the nearest vertex changes, points carried by one vertex alone are torn apart."""
    body = posed_little_body(seed, 0.3, torch.float64)
    forward = vertex_transforms(body)
    a, b = near_the_body(body, 2, 0.03, seed)
    x = a + torch.linspace(0, 1, 20_001, dtype=torch.float64)[:, None] * (b - a)
    steps = {}
    for k, weigh in ((1, neighbour_weights), (6, neighbour_weights), (6, smooth_neighbour_weights)):
        squared, nearest = torch.cdist(x, body.vertices).square().topk(k, largest=False)
        home, _ = to_canonical(x, nearest, weigh(squared), forward)
        steps[k, weigh] = (home[1:] - home[:-1]).norm(dim=-1).max()
    torn = min(steps[1, neighbour_weights], steps[6, neighbour_weights])
    assert steps[6, smooth_neighbour_weights] < 0.2 * torn


@pytest.mark.parametrize("k", [1, 6])
def test_mapping_once_has_the_values_and_the_pose_gradient_of_mapping_again(k):
    """Samples are mapped without gradients to choose among them; those that are kept get their gradient afterwards."""
    generator = torch.Generator().manual_seed(k)
    vertices, samples = 9, 40
    forward = torch.eye(3, 4, dtype=torch.float64) + 0.2 * torch.randn(
        vertices, 3, 4, generator=generator, dtype=torch.float64
    )
    nearest = torch.randint(vertices, (samples, k), generator=generator)
    weights = torch.rand(samples, k, generator=generator, dtype=torch.float64)
    weights = weights / weights.sum(1, keepdim=True)
    x = torch.randn(samples, 3, generator=generator, dtype=torch.float64)
    by_x = torch.randn(samples, 3, generator=generator, dtype=torch.float64)
    by_turn = torch.randn(samples, 3, 3, generator=generator, dtype=torch.float64)
    again, once = forward.clone().requires_grad_(), forward.clone().requires_grad_()
    expected = to_canonical(x, nearest, weights, again)
    with torch.no_grad():
        x_canonical, inverse = map_to_canonical(x, nearest, weights, once)
    kept = torch.arange(0, samples, 3)
    found = with_pose_gradient(x_canonical[kept], inverse[kept], nearest[kept], weights[kept], once)
    for one, other in zip(found, expected, strict=True):
        torch.testing.assert_close(one, other[kept])
    ((expected[0] * by_x)[kept].sum() + (expected[1] * by_turn)[kept].sum()).backward()
    ((found[0] * by_x[kept]).sum() + (found[1] * by_turn[kept]).sum()).backward()
    torch.testing.assert_close(once.grad, again.grad)
    assert once.grad is not None
    assert once.grad.abs().max() > 0.1
    with torch.no_grad():
        plain = with_pose_gradient(x_canonical, inverse, nearest, weights, once)
    assert not plain[0].requires_grad


def pose_gradient_case(k, seed=4, samples=400, vertices=37):
    """Samples with neighbours that share vertices, as in training, and cotangents of both results; single precision."""
    generator = torch.Generator().manual_seed(seed)
    forward = torch.eye(3, 4) + 0.2 * torch.randn(vertices, 3, 4, generator=generator)
    nearest = torch.randint(vertices - 1, (samples, k), generator=generator)  # the last one is nobody's
    weights = torch.rand(samples, k, generator=generator)
    weights = weights / weights.sum(1, keepdim=True)
    x, by_x = torch.randn(2, samples, 3, generator=generator)
    x_canonical, inverse = map_to_canonical(x, nearest, weights, forward)
    by_turn = torch.randn(samples, 3, 3, generator=generator)
    return (x_canonical, inverse, nearest, weights, forward), (by_x, by_turn)


@pytest.mark.parametrize("k", [1, 6])
@pytest.mark.parametrize("used", [(True, True), (True, False), (False, True)])
def test_compiled_pose_gradient_is_its_twin_in_double_precision(k, used):
    given, cotangents = pose_gradient_case(k)
    found = []
    for dtype in (torch.float32, torch.float64):
        *fixed, forward = (t.to(dtype) if t.is_floating_point() else t for t in given)
        forward = forward.requires_grad_()
        results = with_pose_gradient(*fixed, forward)
        assert all(result.is_contiguous() and result.dtype == dtype for result in results)
        chosen = [r for r, one in zip(results, used, strict=True) if one]
        by_chosen = [c.to(dtype) for c, one in zip(cotangents, used, strict=True) if one]
        (gradient,) = torch.autograd.grad(chosen, forward, by_chosen)
        assert (gradient[-1] == 0).all()
        found.append((*(r.detach().double() for r in results), gradient.double()))
    single, double = found
    torch.testing.assert_close(single[:2], double[:2], atol=0, rtol=0)
    torch.testing.assert_close(single[2], double[2], atol=2e-6 * float(double[2].abs().max()), rtol=1e-4)


def test_compiled_pose_gradient_repeats_to_the_bit_and_takes_strided_tensors():
    given, (by_x, by_turn) = pose_gradient_case(6)
    forward = given[-1].requires_grad_()
    strided = [t.mT.contiguous().mT for t in given[:4]]
    assert not any(t.is_contiguous() for t in strided)
    first = torch.autograd.grad(with_pose_gradient(*given), forward, (by_x, by_turn))[0]
    again = torch.autograd.grad(with_pose_gradient(*strided, forward), forward, (by_x, by_turn.mT.contiguous().mT))[0]
    assert torch.equal(first, again)


@pytest.mark.parametrize("k", [1, 6])
def test_compiled_form_is_its_twin_in_double_precision(body, k):
    points = near_the_body(body, 500).float()
    squared, nearest = torch.cdist(points, body.vertices.float()).square().topk(k, largest=False)
    weights, twin = smooth_neighbour_weights(squared), smooth_neighbour_weights(squared.double())
    torch.testing.assert_close(weights.double(), twin, atol=1e-6, rtol=1e-4)
    forward = vertex_transforms(body).float()
    found = map_to_canonical(points, nearest, weights, forward)
    expected = map_to_canonical(points.double(), nearest, weights.double(), forward.double())
    for single, double in zip(found, expected, strict=True):
        torch.testing.assert_close(single.double(), double, atol=1e-5, rtol=1e-4)
