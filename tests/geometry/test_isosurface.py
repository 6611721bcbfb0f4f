"""Surfaces of shapes whose form is known."""

import math
from functools import partial

import pytest
import torch
from torch import Tensor

from twofold.errors import TwofoldError
from twofold.geometry.isosurface import extract_surface, keep_largest

CENTER = torch.tensor([0.31, -0.22, 0.1])


def on_sphere(radius: float = 0.2, count: int = 400, center: Tensor = CENTER) -> Tensor:
    directions = torch.randn(count, 3, generator=torch.Generator().manual_seed(0))
    return center + radius * directions / directions.norm(dim=-1, keepdim=True)


def sphere(points: Tensor, radius: float = 0.2, center: Tensor = CENTER) -> Tensor:
    return (points - center).norm(dim=-1) - radius


def enclosed_volume(vertices: Tensor, faces: Tensor) -> float:
    a, b, c = vertices[faces].unbind(1)
    return (torch.linalg.cross(a, b) * c).sum().item() / 6


def edge_uses(faces: Tensor) -> Tensor:
    edges = torch.cat([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    return torch.unique(edges.sort(1).values, dim=0, return_counts=True)[1]


def test_sphere_comes_out_round_closed_and_facing_outward() -> None:
    vertices, faces = extract_surface(sphere, on_sphere(), voxel=0.02, radius=0.08)
    assert (sphere(vertices).abs() < 1e-3).all()
    assert (edge_uses(faces) == 2).all()
    assert len(vertices) - len(edge_uses(faces)) + len(faces) == 2, "Euler's number of a sphere"
    assert enclosed_volume(vertices, faces) == pytest.approx(4 / 3 * math.pi * 0.2**3, rel=0.02)


def test_field_is_asked_only_near_the_body_and_in_chunks() -> None:
    near, asked = on_sphere(), []

    def level(points: Tensor) -> Tensor:
        asked.append(points)
        return sphere(points)

    vertices, faces = extract_surface(level, near, voxel=0.015, radius=0.09, chunk=2000)
    assert max(len(part) for part in asked) == 2000
    points = torch.cat(asked)
    assert len(points.unique(dim=0)) == len(points), "no point twice"
    assert torch.cdist(points, near).amin(1).max() < 0.09 + 1.5 * 0.015 * math.sqrt(3)
    everything = torch.cartesian_prod(*[torch.arange(-0.3, 0.3, 0.015) for _ in range(3)]) + CENTER
    assert len(points) < 0.9 * (torch.cdist(everything, near).amin(1) < 0.09).sum(), "few on the fine grid"
    assert enclosed_volume(vertices, faces) == pytest.approx(4 / 3 * math.pi * 0.2**3, rel=0.01)


@pytest.mark.parametrize("slope", [0.3, 1.4])
def test_thin_things_between_points_of_the_coarse_grid_are_found(slope: float) -> None:
    """Spheres of less than two voxels, wherever they lie and however steep the field."""
    generator = torch.Generator().manual_seed(0)
    for _ in range(10):
        center = CENTER + 0.1 * torch.rand(3, generator=generator)
        level = partial(sphere, radius=0.009, center=center)
        vertices, _ = extract_surface(lambda x, f=level: slope * f(x), center[None] + 0.01, voxel=0.01, radius=0.04)
        assert torch.allclose(vertices.mean(0), center, atol=3e-3)


def test_smaller_piece_is_dropped_with_its_vertices() -> None:
    other = CENTER + torch.tensor([0.5, 0, 0])

    def two(points: Tensor) -> Tensor:
        return torch.minimum(sphere(points), sphere(points, 0.1, other))

    near = torch.cat([on_sphere(), on_sphere(0.1, center=other)])
    vertices, faces = extract_surface(two, near, voxel=0.025, radius=0.08)
    assert (sphere(vertices).abs() < 2e-3).all()
    assert sorted(faces.unique().tolist()) == list(range(len(vertices)))


def test_area_decides_not_the_number_of_triangles() -> None:
    large = torch.tensor([[0.0, 0, 0], [9, 0, 0], [0, 9, 0]])
    small = torch.tensor([[20.0, 0, 0], [21, 0, 0], [20, 1, 0], [21, 1, 0]])
    vertices, faces = keep_largest(torch.cat([small, large]), torch.tensor([[0, 1, 2], [1, 3, 2], [4, 5, 6]]))
    assert torch.equal(vertices, large)
    assert faces.tolist() == [[0, 1, 2]]


def test_something_away_from_the_body_is_not_found() -> None:
    far = CENTER + torch.tensor([0.6, 0, 0])

    def with_a_larger_floater(points: Tensor) -> Tensor:
        return torch.minimum(sphere(points), sphere(points, 0.3, far))

    vertices, _ = extract_surface(with_a_larger_floater, on_sphere(), voxel=0.02, radius=0.05)
    assert (sphere(vertices).abs() < 1e-3).all()


@pytest.mark.parametrize("offset", [-1.0, 1.0])
def test_no_surface_is_one_clear_sentence(offset: float) -> None:
    with pytest.raises(TwofoldError, match="no surface within 5 cm"):
        extract_surface(lambda x: sphere(x) + offset, on_sphere(), voxel=0.03, radius=0.05)


def test_diverged_field_is_one_clear_sentence() -> None:
    with pytest.raises(TwofoldError, match="not finite"):
        extract_surface(lambda x: sphere(x) * math.nan, on_sphere(), voxel=0.03, radius=0.05)


def test_surface_ends_where_the_asked_points_end() -> None:
    """Made-up values beyond them must not bend it: a plane through a patch of vertices stays a plane."""
    near = torch.cartesian_prod(torch.linspace(0, 0.3, 20), torch.linspace(0, 0.2, 14), torch.zeros(1))
    vertices, faces = extract_surface(lambda x: x[:, 2] - 0.003, near, voxel=0.02, radius=0.07)
    assert torch.allclose(vertices[:, 2], torch.tensor(0.003), atol=1e-6)
    a, b, c = vertices[faces].unbind(1)
    assert (torch.linalg.cross(b - a, c - a)[:, 2] > 0).all()
    assert (vertices[:, :2].amax(0) > torch.tensor([0.34, 0.24])).all()
