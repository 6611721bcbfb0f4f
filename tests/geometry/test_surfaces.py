import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from shapes import edge_uses, is_closed, soup, sphere, volume

from twofold.geometry import surfaces
from twofold.geometry.surfaces import (
    closest_on_triangles,
    face_areas,
    face_normals,
    nearest_vertices,
    point_to_mesh,
    sample_surface,
    split_edges,
    vertex_normals,
)


def test_normals_of_a_sphere_point_outward():
    vertices, faces = sphere(2.0)
    away = torch.nn.functional.normalize(vertices, dim=-1)
    assert ((vertex_normals(vertices, faces) * away).sum(-1) > 0.995).all()
    centers = torch.nn.functional.normalize(vertices[faces].mean(1), dim=-1)
    assert ((face_normals(vertices, faces) * centers).sum(-1) > 0.99).all()


def test_vertex_normals_are_the_slow_sum_over_triangles():
    vertices, faces = sphere(1.0, 5, 6, dtype=torch.float64)
    vertices = vertices * torch.tensor([1.0, 0.4, 2.0], dtype=torch.float64)
    slow = torch.zeros_like(vertices)
    for a, b, c in faces.tolist():
        weighted = torch.linalg.cross(vertices[b] - vertices[a], vertices[c] - vertices[a])
        for corner in (a, b, c):
            slow[corner] += weighted
    assert torch.allclose(vertex_normals(vertices, faces), torch.nn.functional.normalize(slow, dim=-1))


def test_a_degenerate_triangle_has_a_zero_normal_not_a_nan():
    vertices = torch.tensor([[0.0, 0, 0], [1, 0, 0], [2, 0, 0]])
    assert face_normals(vertices, torch.tensor([[0, 1, 2]])).tolist() == [[0, 0, 0]]
    assert torch.isfinite(vertex_normals(vertices, torch.tensor([[0, 1, 2]]))).all()


def test_areas_add_up_to_the_sphere():
    vertices, faces = sphere(0.5, 60, 90)
    assert float(face_areas(vertices, faces).sum()) == pytest.approx(4 * math.pi * 0.25, rel=2e-3)


@pytest.mark.parametrize("k", [1, 3])
def test_nearest_vertices_agree_with_all_distances(k):
    g = torch.Generator().manual_seed(k)
    points, vertices = torch.randn(30, 3, generator=g), torch.randn(50, 3, generator=g)
    distances, indices = nearest_vertices(points, vertices, k)
    expected = torch.cdist(points, vertices).topk(k, largest=False)
    assert torch.equal(indices, expected.indices)
    assert torch.allclose(distances, expected.values, atol=1e-5)


@settings(max_examples=40)
@given(st.integers(0, 100_000))
def test_no_point_of_a_triangle_is_nearer_than_the_closest(seed):
    g = torch.Generator().manual_seed(seed)
    a, b, c, point = torch.randn(4, 3, generator=g, dtype=torch.float64)
    closest = closest_on_triangles(point, a, b, c)
    n = 60
    weights = torch.tensor([[i, j, n - i - j] for i in range(n + 1) for j in range(n + 1 - i)]).double() / n
    inside = weights @ torch.stack([a, b, c])
    assert (closest - point).norm() <= (inside - point).norm(dim=-1).min() + 1e-12
    # And it is itself on the triangle.
    assert (inside - closest).norm(dim=-1).min() <= 1.5 * max((b - a).norm(), (c - a).norm(), (c - b).norm()) / n


def test_closest_point_on_a_triangle_that_is_only_a_line():
    a, b, c = torch.tensor([0.0, 0, 0]), torch.tensor([1.0, 0, 0]), torch.tensor([2.0, 0, 0])
    assert closest_on_triangles(torch.tensor([1.5, 1, 0]), a, b, c).tolist() == [1.5, 0, 0]


@pytest.mark.parametrize("by_centers", [False, True])
@settings(max_examples=20, deadline=None)
@given(st.integers(0, 100_000))
def test_distance_to_a_mesh_is_the_least_over_all_triangles(by_centers, seed):
    vertices, faces = soup(seed, 60)
    vertices = vertices * 0.2
    # One triangle far larger than the others: its centre says little about where it is.
    vertices[:3] *= 40
    points = torch.randn(25, 3, generator=torch.Generator().manual_seed(seed + 1))
    if by_centers:  # the way on a GPU
        distance, triangle, nearest = surfaces._point_to_mesh_by_centers(points, vertices[faces])
    else:
        distance, triangle, nearest = point_to_mesh(points, vertices, faces)
    a, b, c = vertices[faces].unbind(1)
    all_feet = closest_on_triangles(
        points[:, None].expand(25, 60, 3), a.expand(25, 60, 3), b.expand(25, 60, 3), c.expand(25, 60, 3)
    )
    least = (all_feet - points[:, None]).norm(dim=-1).min(-1)
    assert torch.allclose(distance, least.values, atol=1e-6)
    assert (triangle == least.indices).float().mean() > 0.95
    assert torch.allclose((nearest - points).norm(dim=-1), distance, atol=1e-6)


def test_distance_to_a_sphere_is_known():
    vertices, faces = sphere(1.0, 60, 90)
    points = torch.tensor([[3.0, 0, 0], [0, 0.25, 0], [0, 0, -1.5]])
    assert torch.allclose(point_to_mesh(points, vertices, faces)[0], torch.tensor([2.0, 0.75, 0.5]), atol=2e-3)


def test_samples_are_spread_by_area_and_lie_on_the_surface():
    # A small and a large triangle, one on z = 0 and one on z = 1.
    vertices = torch.tensor([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1], [3, 0, 1], [0, 3, 1]])
    faces = torch.tensor([[0, 1, 2], [3, 4, 5]])
    points, normals = sample_surface(vertices, faces, 20_000, torch.Generator().manual_seed(0))
    upper = points[:, 2] > 0.5
    assert torch.allclose(points[:, 2], upper.float(), atol=1e-6)
    assert float(upper.float().mean()) == pytest.approx(0.9, abs=0.01)
    assert torch.allclose(points[upper].mean(0), torch.tensor([1.0, 1, 1]), atol=0.03)
    assert torch.equal(normals, torch.tensor([0.0, 0, 1]).expand(20_000, 3))


def test_samples_are_the_same_for_the_same_generator():
    vertices, faces = sphere()
    first, second = (sample_surface(vertices, faces, 50, torch.Generator().manual_seed(7))[0] for _ in range(2))
    assert torch.equal(first, second)


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 10_000))
def test_splitting_marked_edges_keeps_a_mesh_closed_and_in_place(seed):
    vertices, faces = sphere(1.0, 6, 7)
    marked = torch.rand(len(vertices), generator=torch.Generator().manual_seed(seed)) < 0.6
    finer, split, parents = split_edges(vertices, faces, marked)
    assert is_closed(split)
    assert volume(finer, split) == pytest.approx(volume(vertices, faces), rel=1e-6)
    assert torch.allclose(finer, vertices[parents].mean(1))
    assert torch.equal(finer[: len(vertices)], vertices)
    halved = {tuple(sorted(edge)) for edge in edge_uses(faces) if marked[list(edge)].all()}
    assert {tuple(p) for p in parents[len(vertices) :].tolist()} == halved


def test_splitting_every_edge_makes_four_of_each_triangle():
    vertices, faces = sphere(1.0, 6, 7)
    finer, split, _ = split_edges(vertices, faces, torch.ones(len(vertices), dtype=torch.bool))
    assert len(split) == 4 * len(faces)
    assert float(face_areas(finer, split).max()) < 0.3 * float(face_areas(vertices, faces).max())


def test_splitting_nothing_changes_nothing():
    vertices, faces = sphere(1.0, 6, 7)
    finer, split, _ = split_edges(vertices, faces, torch.zeros(len(vertices), dtype=torch.bool))
    assert torch.equal(finer, vertices)
    assert torch.equal(split, faces)
