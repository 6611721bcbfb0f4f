import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from twofold.field.encoding import fourier_encoding
from twofold.field.inverted_sphere import (
    InvertedSphereFieldConfig,
    inverse_distances,
    inverse_intervals,
    inverted_sphere_points,
    sphere_exit,
)
from twofold.geometry.rotations import cross_matrix


def rays(seed, count=5, radius=3.0):
    generator = torch.Generator().manual_seed(seed)
    directions = torch.randn(count, 3, generator=generator, dtype=torch.float64)
    origins = torch.rand(count, 3, generator=generator, dtype=torch.float64) * radius / 2
    return origins, directions / directions.norm(dim=1, keepdim=True)


def literal_point(o, d, rho, radius):
    """The sphere hit rotated about o x hit by asin(|p_mid| / R) - asin(|p_mid| rho)."""
    middle = o - (o @ d) * d
    hit = o + sphere_exit(o[None], d[None], radius)[0] * d
    axis = torch.linalg.cross(o, hit)
    k = cross_matrix(axis / axis.norm())
    angle = math.asin(middle.norm() / radius) - math.asin(middle.norm() * rho)
    turn = torch.eye(3, dtype=o.dtype) + math.sin(angle) * k + (1 - math.cos(angle)) * k @ k
    return torch.cat([turn @ hit / radius, o.new_tensor([rho])])


@given(st.integers(0, 1000), st.floats(0, 1))
def test_points_are_where_the_rotation_ends(seed, fraction):
    origins, directions = rays(seed)
    rho = fraction / 3
    found = inverted_sphere_points(origins, directions, torch.full((5, 1), rho, dtype=torch.float64))
    for o, d, point in zip(origins, directions, found[:, 0], strict=True):
        torch.testing.assert_close(point, literal_point(o, d, rho, 3.0))


@given(st.integers(0, 1000))
def test_points_lie_on_their_ray_at_their_distance(seed):
    origins, directions = rays(seed)
    inverse = torch.linspace(0.05, 1 / 3, 7, dtype=torch.float64).expand(5, 7)
    found = inverted_sphere_points(origins, directions, inverse)
    torch.testing.assert_close(found[..., :3].norm(dim=-1), torch.ones(5, 7, dtype=torch.float64))
    offset = found[..., :3] / inverse[..., None] - origins[:, None]
    across = torch.linalg.cross(offset, directions[:, None].expand_as(offset))
    torch.testing.assert_close(across, torch.zeros_like(across), atol=1e-9, rtol=0)
    assert ((offset * directions[:, None]).sum(-1) > 0).all()


def test_ray_through_the_origin_of_space_is_followed():
    o, d = torch.zeros(1, 3), torch.tensor([[0.0, 0.0, 1.0]])
    assert inverted_sphere_points(o, d, torch.tensor([[0.2, 0.0]]))[0].tolist() == [
        pytest.approx([0, 0, 1, 0.2]),
        pytest.approx([0, 0, 1, 0]),
    ]


def test_gradients_are_those_of_finite_differences():
    origins, directions = rays(2)
    inverse = torch.full((5, 2), 0.2, dtype=torch.float64)
    inputs = [t.requires_grad_() for t in (origins, directions, inverse)]
    assert torch.autograd.gradcheck(inverted_sphere_points, inputs)


def test_exit_lies_on_the_sphere():
    origins, directions = rays(3)
    hit = origins + sphere_exit(origins, directions)[:, None] * directions
    torch.testing.assert_close(hit.norm(dim=1), torch.full((5,), 3.0, dtype=torch.float64))


def test_random_inverse_distances_stay_in_their_strata(generator):
    found = inverse_distances(200, 4, 2.0, generator)
    edges = torch.tensor([1, 5 / 6, 1 / 2, 1 / 6, 0]) / 2
    assert ((found <= edges[:-1] + 1e-6) & (found >= edges[1:] - 1e-6)).all()
    assert found.std(0).min() > 0.01
    assert (inverse_intervals(found)[:, :-1] >= 0).all()


def dense(h, layers, activation):
    for layer in layers:
        h = activation(h @ layer.direction.T + layer.bias)
    return h


def test_field_is_the_printed_chain(generator):
    field = InvertedSphereFieldConfig().build(generator).double()
    points = torch.randn(3, 4, generator=generator, dtype=torch.float64)
    views = torch.randn(3, 3, generator=generator, dtype=torch.float64)
    code = torch.randn(32, generator=generator, dtype=torch.float64)
    softplus = torch.nn.Softplus(beta=100)
    encoded, layers = fourier_encoding(points, 10, include_pi=False), field.geometry.layers
    h = dense(torch.cat([encoded, code.expand(3, -1)], 1), layers[:4], softplus)
    h = dense(torch.cat([h, encoded], 1) / math.sqrt(2), layers[4:8], softplus)
    answer = dense(h, layers[8:], torch.nn.Identity())
    seen = torch.cat([fourier_encoding(views, 4, include_pi=False), answer[:, 1:], code.expand(3, -1)], 1)
    color = dense(dense(seen, field.color.layers[:1], torch.relu), field.color.layers[1:], torch.sigmoid)
    output = field(points, views, code)
    torch.testing.assert_close(output.density, answer[:, 0].abs())
    torch.testing.assert_close(output.color, color)


def test_parameter_counts_are_the_authors():
    field = InvertedSphereFieldConfig().build()
    assert sum(p.numel() for p in field.geometry.parameters()) == 534_957
    assert sum(p.numel() for p in field.color.parameters()) == 40_835


@pytest.mark.parametrize("setting", [{"width": 84}, {"skip_layer": 8}, {"code_size": 0}])
def test_impossible_sizes_are_refused(setting):
    with pytest.raises(ValueError, match=next(iter(setting))):
        InvertedSphereFieldConfig(**setting)
