"""Surface figures against closed forms: parallel and tilted planes, spheres, a surface half missing."""

import math

import pytest
import torch
import trimesh
from torch import Tensor

from twofold.errors import TwofoldError
from twofold.geometry.surfaces import closest_on_triangles, face_normals, sample_surface
from twofold.metrics.shape import (
    PROTOCOLS,
    chamfer_cm,
    chamfer_vertices_cm2,
    compare_surfaces,
    normal_consistency_vertices,
)

Mesh = tuple[Tensor, Tensor]


def plane(n: int = 12, height: float = 0.0, width: float = 1.0) -> Mesh:
    """A square of side 1 m at z = height, facing +z; with `width` only that much of it, from x = 0."""
    x, y = torch.meshgrid(torch.linspace(0, width, n), torch.linspace(0, 1, n), indexing="ij")
    vertices = torch.stack([x, y, torch.full_like(x, height)], -1).reshape(-1, 3)
    corner = torch.arange(n * n).reshape(n, n)
    a, b, c, d = corner[:-1, :-1], corner[1:, :-1], corner[1:, 1:], corner[:-1, 1:]
    return vertices, torch.cat([torch.stack(t, -1).reshape(-1, 3) for t in ((a, b, c), (a, c, d))])


def sphere(radius: float, n: int = 60) -> Mesh:
    """By latitude and longitude, facing outward."""
    square, faces = plane(n)
    polar, around = (0.001 + 0.998 * square[:, 0]) * math.pi, square[:, 1] * 2 * math.pi
    directions = torch.stack([polar.sin() * around.cos(), polar.sin() * around.sin(), polar.cos()], -1)
    return radius * directions, faces


def test_parallel_planes_are_their_distance_apart() -> None:
    figures = compare_surfaces(*plane(5), *plane(14, height=0.02), samples=500)
    assert figures["chamfer_cm"] == pytest.approx(2.0, abs=1e-5)
    assert figures["normal_consistency"] == pytest.approx(1.0, abs=1e-6)
    assert figures["normal_consistency_vertices"] == pytest.approx(1.0, abs=1e-6)


def test_one_surface_meshed_twice_is_at_distance_zero() -> None:
    assert chamfer_cm(*plane(5), *plane(14), samples=500) == pytest.approx(0.0, abs=1e-4)


def test_concentric_spheres_differ_by_their_radii() -> None:
    figures = compare_surfaces(*sphere(0.31), *sphere(0.30), samples=2000)
    assert figures["chamfer_cm"] == pytest.approx(1.0, abs=0.02)
    assert figures["normal_consistency"] > 0.998
    # Vertex lies over vertex: each is exactly 1 cm away, there and back.
    assert figures["chamfer_vertices_cm2"] == pytest.approx(2.0, abs=1e-3)
    assert figures["normal_consistency_vertices"] > 0.998


def test_missing_half_counts_in_one_direction_only() -> None:
    half, whole = plane(width=0.5), plane()
    figures = compare_surfaces(*half, *whole, samples=4000)
    assert figures["accuracy_cm"] == pytest.approx(0.0, abs=1e-4)
    # Half of the whole square lies 0 to 50 cm away from the half: 25 cm on average, over all 12.5 cm.
    assert figures["completeness_cm"] == pytest.approx(12.5, abs=0.5)
    assert figures["chamfer_cm"] == pytest.approx(figures["completeness_cm"] / 2, abs=1e-4)
    assert chamfer_cm(*half, *whole, samples=4000) == pytest.approx(figures["chamfer_cm"], abs=1e-9)
    assert chamfer_cm(*whole, *half, samples=4000) == pytest.approx(figures["chamfer_cm"], abs=1e-9)


@pytest.mark.parametrize("angle", [0.3, 1.0])
def test_tilted_plane_has_the_closed_form_normals(angle: float) -> None:
    vertices, faces = plane()
    c, s = math.cos(angle), math.sin(angle)
    turned = vertices @ torch.tensor([[1.0, 0, 0], [0, c, -s], [0, s, c]]).T
    figures = compare_surfaces(turned, faces, vertices, faces, samples=300)
    assert figures["normal_consistency"] == pytest.approx(c, abs=1e-5)
    assert figures["normal_consistency_vertices"] == pytest.approx(1 - 2 * math.sin(angle / 2), abs=1e-5)


def test_only_the_signed_normals_notice_a_flipped_surface() -> None:
    vertices, faces = plane()
    figures = compare_surfaces(vertices, faces.flip(1), vertices, faces, samples=300)
    assert figures["normal_consistency"] == pytest.approx(1.0, abs=1e-6)
    assert figures["normal_consistency_vertices"] == pytest.approx(-1.0, abs=1e-6)


def test_vertex_figures_equal_all_pairs_by_hand() -> None:
    generator = torch.Generator().manual_seed(0)
    (ours, our_faces), (theirs, their_faces) = sphere(0.3, 14), sphere(0.32, 11)
    ours = ours + 0.02 * torch.randn(ours.shape, generator=generator)
    pairs = torch.cdist(ours, theirs)
    by_hand = 1e4 * (pairs.amin(0).square().mean() + pairs.amin(1).square().mean())
    assert chamfer_vertices_cm2(ours, theirs) == pytest.approx(by_hand.item(), rel=1e-4)

    def normals(vertices: Tensor, faces: Tensor) -> Tensor:
        total = torch.zeros_like(vertices)
        for face in faces:
            a, b, c = vertices[face]
            total[face] += torch.linalg.cross(b - a, c - a)
        return total / total.norm(dim=-1, keepdim=True).clamp_min(1e-20)

    difference = normals(theirs, their_faces) - normals(ours, our_faces)[pairs.argmin(0)]
    expected = 1 - difference.norm(dim=-1).mean().item()
    assert normal_consistency_vertices(ours, our_faces, theirs, their_faces) == pytest.approx(expected, abs=1e-5)


def test_normals_count_in_both_directions() -> None:
    """A square beside the same square with a wall on it: only from the wall are the normals perpendicular."""
    floor, faces = plane(height=0.0)
    wall = floor[:, [0, 2, 1]] + torch.tensor([0.0, 0.5, 1e-4])
    both = (torch.cat([floor, wall]), torch.cat([faces, faces + len(floor)]))
    figures = compare_surfaces(floor, faces, *both, samples=4000)
    assert figures["normal_consistency"] == pytest.approx((1 + 0.5) / 2, abs=0.02)


def test_same_seed_same_figure_and_another_seed_nearly() -> None:
    meshes = (*sphere(0.3, 12), *sphere(0.25, 12))
    first = chamfer_cm(*meshes, samples=1000, seed=1)
    assert chamfer_cm(*meshes, samples=1000, seed=1) == first
    other = chamfer_cm(*meshes, samples=1000, seed=2)
    assert other != first
    assert other == pytest.approx(first, rel=0.1)


def test_figures_are_those_of_an_exhaustive_search() -> None:
    """Large triangles beside small ones, points far and near: all triangles, one by one."""

    def exhaustive(source: Mesh, target: Mesh) -> tuple[float, float]:
        points, normals = sample_surface(*source, 150, torch.Generator().manual_seed(0))
        a, b, c = (target[0][target[1][:, i]].expand(150, -1, -1) for i in range(3))
        away = (closest_on_triangles(points[:, None].expand_as(a), a, b, c) - points[:, None]).norm(dim=-1)
        cosines = (normals * face_normals(*target)[away.argmin(1)]).sum(-1).abs()
        return 100 * away.amin(1).mean().item(), cosines.mean().item()

    coarse, fine, other = plane(3), sphere(0.1, 24), sphere(0.3, 25)
    vertices = torch.cat([coarse[0], fine[0] + torch.tensor([0.5, 0.5, 0.12])])
    mixed = vertices, torch.cat([coarse[1], fine[1] + len(coarse[0])])
    (accuracy, cosine), (completeness, cosine_back) = exhaustive(other, mixed), exhaustive(mixed, other)
    figures = compare_surfaces(*other, *mixed, samples=150)
    assert figures["accuracy_cm"] == pytest.approx(accuracy, rel=1e-4)
    assert figures["completeness_cm"] == pytest.approx(completeness, rel=1e-4)
    assert figures["normal_consistency"] == pytest.approx((cosine + cosine_back) / 2, abs=1e-3)


def test_empty_or_broken_surface_is_one_clear_sentence() -> None:
    vertices, faces = plane()
    with pytest.raises(TwofoldError, match="second of the two surfaces to compare is empty"):
        chamfer_cm(vertices, faces, vertices, faces[:0])
    with pytest.raises(TwofoldError, match=r"first .* not finite"):
        chamfer_cm(vertices * math.nan, faces, vertices, faces)


def test_figures_are_those_of_trimeshs_search() -> None:
    ours, theirs = sphere(0.3, 14), sphere(0.25, 11)
    figures = compare_surfaces(*ours, *theirs, samples=300)
    distances, cosines = [], []
    for source, target in ((ours, theirs), (theirs, ours)):
        points, normals = sample_surface(*source, 300, torch.Generator().manual_seed(0))
        mesh = trimesh.Trimesh(target[0].double().numpy(), target[1].numpy(), process=False)
        _, away, nearest = trimesh.proximity.closest_point_naive(mesh, points.double().numpy())
        distances.append(100 * away)
        cosines.append(abs((mesh.face_normals[nearest] * normals.numpy()).sum(1)).mean())
    assert figures["accuracy_cm"] == pytest.approx(distances[0].mean(), rel=1e-4)
    assert figures["chamfer_cm"] == pytest.approx((distances[0].mean() + distances[1].mean()) / 2, rel=1e-4)
    squares = ((distances[0] ** 2).mean() + (distances[1] ** 2).mean()) / 2
    assert figures["chamfer_l2_cm2"] == pytest.approx(squares, rel=1e-4)
    assert figures["normal_consistency"] == pytest.approx(sum(cosines) / 2, abs=1e-3)


def test_units_are_one_figure_in_other_words() -> None:
    figures = compare_surfaces(*sphere(0.31, 20), *sphere(0.30, 20), samples=200)
    assert figures["chamfer_l2_m2"] == pytest.approx(1e-4 * figures["chamfer_l2_cm2"])
    assert figures["chamfer_vertices_halved_cm2"] == pytest.approx(1.0, abs=1e-3)
    # 1 cm off: 1e-4 m^2, times 100.
    assert figures["chamfer_vertices_m2_x100"] == pytest.approx(0.01, abs=1e-5)


def test_every_figure_has_its_protocol() -> None:
    assert compare_surfaces(*plane(), *plane(), samples=10).keys() == PROTOCOLS.keys()
