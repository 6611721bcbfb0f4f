"""Blending by the weights that are not zero, against the dense product in double precision."""

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from twofold.body.blending import blend_transforms, has_kernel, in_pytorch, skin_vertices
from twofold.body.skeleton import skin


def few_weights(points, joints, seed):
    """Rows that sum to 1, most of each of them zero, in one of them all but the last, and a row of zeros."""
    generator = torch.Generator().manual_seed(seed)
    kept = torch.rand(points, joints, generator=generator) < 0.15
    weights = torch.rand(points, joints, generator=generator) * kept
    weights = weights / weights.sum(1, keepdim=True).clamp_min(1e-9)
    if points > 1:
        weights[0], weights[1] = torch.eye(joints)[-1], 0
    return weights


def draw(points=50, joints=24, seed=0):
    generator = torch.Generator().manual_seed(seed)
    transforms = torch.eye(4) + 0.5 * torch.randn(joints, 4, 4, generator=generator)
    transforms[:, 3] = torch.tensor([0.0, 0, 0, 1])
    return torch.randn(points, 3, generator=generator), few_weights(points, joints, seed), transforms


def gradients_of(function, inputs, seed):
    """A result and its gradients by those inputs that want one, from random cotangents; in double precision."""
    result = function(*inputs)
    by_result = torch.randn(result.shape, generator=torch.Generator().manual_seed(seed)).to(result)
    wanted = [x for x in inputs if x.requires_grad]
    return [x.double() for x in (result.detach(), *torch.autograd.grad(result, wanted, by_result))]


def require_alike(function, inputs, wanted, seed):
    single = [x.detach().clone().requires_grad_(one) for x, one in zip(inputs, wanted, strict=True)]
    double = [x.detach().double().requires_grad_(one) for x, one in zip(inputs, wanted, strict=True)]
    assert function(*single).dtype == torch.float32
    pairs = zip(gradients_of(function, single, seed), gradients_of(function, double, seed), strict=True)
    for one, true in pairs:
        scale = float(true.abs().max()) if true.numel() else 0.0
        torch.testing.assert_close(one, true, atol=1e-6 * scale, rtol=1e-6)


@pytest.mark.parametrize("shape", [(50, 24), (7, 1), (1, 3), (0, 24)])
@pytest.mark.parametrize("wanted", [(True, False, True), (True, False, False), (False, False, True), (True,) * 3])
def test_skinning_is_its_twin_in_double_precision(shape, wanted):
    """With a gradient by weights, too, which the compiled form has none of."""
    require_alike(skin_vertices, draw(*shape), wanted, seed=1)


@pytest.mark.parametrize("shape", [(50, 24), (7, 1), (1, 3), (0, 24)])
@pytest.mark.parametrize("wanted", [(False, True), (True, True)])
def test_blending_is_its_twin_in_double_precision(shape, wanted):
    require_alike(blend_transforms, draw(*shape)[1:], wanted, seed=2)


@settings(max_examples=20)
@given(st.integers(1, 40), st.integers(1, 30), st.integers(0, 9999))
def test_both_are_the_dense_product_for_any_body(points, joints, seed):
    inputs = draw(points, joints, seed)
    require_alike(skin_vertices, inputs, (True, False, True), seed)
    require_alike(blend_transforms, inputs[1:], (False, True), seed)


def test_the_last_row_of_a_transform_has_no_gradient():
    points, weights, transforms = draw()
    transforms.requires_grad_()
    for result in (skin_vertices(points, weights, transforms), blend_transforms(weights, transforms)):
        (gradient,) = torch.autograd.grad(result.sum(), transforms)
        assert (gradient[:, 3] == 0).all()
        assert gradient[:, :3].abs().max() > 0.1


def test_strided_tensors_are_taken_as_contiguous_ones():
    inputs = draw()
    strided = [x.T.contiguous().T if x.ndim == 2 else x.mT.contiguous().mT for x in inputs]
    assert not any(x.is_contiguous() for x in strided)
    for form, first in ((skin_vertices, 0), (blend_transforms, 1)):
        wanted = [gradients_of(form, (*given[first:-1], given[-1].requires_grad_()), 3) for given in (inputs, strided)]
        for one, other in zip(*wanted, strict=True):
            assert torch.equal(one, other)


def test_loops_are_for_single_precision():
    points, _, transforms = draw()
    assert has_kernel(points, transforms)
    assert not has_kernel(points.double(), transforms)
    with in_pytorch():
        assert not has_kernel(points, transforms)
    assert has_kernel(points, transforms)


def test_a_gradient_changes_no_bit_of_the_result():
    points, weights, transforms = draw()
    plain = skin_vertices(points, weights, transforms)
    assert torch.equal(skin_vertices(points, weights, transforms.clone().requires_grad_()), plain)


def test_in_pytorch_results_are_those_of_the_dense_product_to_the_bit():
    """Feature grids of older runs lie around a canonical body that was posed so."""
    points, weights, transforms = draw()
    dense = (weights @ transforms[:, :3].flatten(1)).unflatten(-1, (3, 4))
    with in_pytorch():
        assert torch.equal(blend_transforms(weights, transforms), dense)
        moved = (dense[:, :, :3] @ points[:, :, None])[..., 0] + dense[:, :, 3]
        assert torch.equal(skin_vertices(points, weights, transforms), moved)


def test_weights_that_were_changed_are_looked_at_again():
    points, weights, transforms = draw()
    transforms.requires_grad_()
    before = skin_vertices(points, weights, transforms)
    assert torch.equal(skin_vertices(points, weights, transforms), before)
    weights.copy_(few_weights(50, 24, seed=5))
    after = skin_vertices(points, weights, transforms)
    torch.testing.assert_close(after, skin(points, weights, transforms), atol=5e-6, rtol=1e-5)
    assert (after - before).abs().max() > 0.1


def test_weights_of_inference_mode_are_looked_at_each_time():
    points, _, transforms = draw()
    transforms.requires_grad_()
    with torch.inference_mode():
        weights = few_weights(50, 24, seed=1)
    for seed in (1, 2):
        other = few_weights(50, 24, seed)
        with torch.inference_mode():
            weights.copy_(other)
        expected = skin(points, other, transforms)
        torch.testing.assert_close(skin_vertices(points, weights, transforms), expected, atol=5e-6, rtol=1e-5)


def test_both_work_within_functional_transforms():
    points, weights, transforms = draw()
    many = torch.stack([transforms, 2 * transforms]).requires_grad_()
    for n, result in enumerate(torch.vmap(skin_vertices, in_dims=(None, None, 0))(points, weights, many)):
        torch.testing.assert_close(result, skin_vertices(points, weights, many[n]), atol=5e-6, rtol=1e-5)
    by_transforms = torch.func.jacrev(blend_transforms, 1)(weights, transforms)
    # Row r of the result takes weights times row r of each transform.
    expected = torch.einsum("vj,rs,cd->vrcjsd", weights, torch.eye(3, 4), torch.eye(4))
    torch.testing.assert_close(by_transforms, expected)
