import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from shapes import soup, sphere

from twofold.geometry import raster
from twofold.geometry.cameras import Camera, pixel_grid, pixel_rays, project
from twofold.geometry.raster import box_filter, depth_map, rasterize, silhouette, supersampled
from twofold.geometry.rotations import axis_angle_to_matrix, rigid_inverse, rigid_transform


def front_camera(size=48, focal=60.0, distance=4.0):
    """Stands on +z, looks back; its image's middle is the origin."""
    world_to_camera = torch.diag(torch.tensor([1.0, -1.0, -1.0, 1.0]))
    world_to_camera[2, 3] = distance
    c = (size - 1) / 2
    return Camera(world_to_camera, torch.tensor([[focal, 0, c], [0, focal, c], [0, 0, 1]]), size, size)


def cast_rays_slowly(camera, vertices, faces):
    """Every ray against every triangle, in float64: nearest face, its depth, and where rounding could decide."""
    grid = pixel_grid(camera).view(-1, 2).double()
    exact = Camera(camera.world_to_camera.double(), camera.intrinsics.double(), camera.height, camera.width)
    rays = pixel_rays(exact, grid)
    nearest = torch.full((len(grid),), math.inf, dtype=torch.float64)
    face = torch.full((len(grid),), -1)
    doubtful = torch.zeros(len(grid), dtype=torch.bool)
    forward = exact.world_to_camera[2, :3]
    for f, (a, b, c) in enumerate(vertices.double()[faces]):
        edges = torch.stack([b - a, c - a], -1).expand(len(grid), 3, 2)
        system = torch.cat([edges, -rays.directions[:, :, None]], -1)
        u, v, t = torch.linalg.solve(system, rays.origins - a).unbind(-1)
        margin = torch.stack([u, v, 1 - u - v]).amin(0)
        depth = t * (rays.directions @ forward)
        meets = (margin >= 0) & (t > 0)
        doubtful |= (margin.abs() < 1e-4) | (meets & ((depth - nearest).abs() < 1e-5))
        face = torch.where(meets & (depth < nearest), f, face)
        nearest = torch.where(meets, torch.minimum(nearest, depth), nearest)
    return face, nearest, doubtful


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 10_000))
def test_every_pixel_sees_what_a_ray_through_it_meets_first(seed):
    camera = front_camera(14, 16.0, 6.0)
    vertices, faces = soup(seed, 5)
    expected_face, expected_depth, doubtful = cast_rays_slowly(camera, vertices, faces)
    hits = rasterize(camera, vertices, faces)
    face = torch.full((14 * 14,), -1)
    depth = torch.full((14 * 14,), math.inf)
    face[hits.pixel], depth[hits.pixel] = hits.face, hits.depth
    sure = ~doubtful
    assert torch.equal(face[sure], expected_face[sure])
    assert torch.allclose(depth[sure], expected_depth[sure].float(), atol=1e-4)


def test_agrees_with_embree_on_a_sphere():
    pytest.importorskip("embreex")
    from embreex import rtcore_scene
    from embreex.mesh_construction import TriangleMesh

    camera = front_camera(96, 120.0)
    vertices, faces = sphere(1.0, 40, 60)
    turned = vertices @ axis_angle_to_matrix(torch.tensor([0.3, 0.5, 0.1])).T
    hits = rasterize(camera, turned, faces)
    scene = rtcore_scene.EmbreeScene()
    TriangleMesh(scene, turned.numpy().astype(np.float32), faces.numpy().astype(np.int32))
    rays = pixel_rays(camera, pixel_grid(camera).view(-1, 2))
    origins = rays.origins.contiguous().numpy().astype(np.float32)
    found = scene.run(origins, rays.directions.numpy().astype(np.float32), output=True)
    seen = np.nonzero(found["primID"] >= 0)[0]
    assert len(set(seen) ^ set(hits.pixel.tolist())) <= 2
    same = np.intersect1d(seen, hits.pixel.numpy())
    ours = np.searchsorted(hits.pixel.numpy(), same)
    assert (found["primID"][same] == hits.face.numpy()[ours]).mean() > 0.995
    forward = camera.world_to_camera[2, :3].numpy()
    depth = found["tfar"][same] * (rays.directions.numpy()[same] @ forward)
    assert np.abs(depth - hits.depth.numpy()[ours]).max() < 1e-4


def test_barycentric_weights_give_the_point_on_the_pixels_ray():
    camera = front_camera()
    vertices, faces = soup(3)
    hits = rasterize(camera, vertices, faces)
    points = (hits.barycentric[..., None] * vertices[faces[hits.face]]).sum(1)
    pixel, depth = project(camera, points)
    expected = torch.stack([hits.pixel % 48, hits.pixel // 48], -1)
    assert len(hits.pixel) > 100
    assert torch.allclose(pixel, expected.float(), atol=5e-3)
    assert torch.allclose(depth, hits.depth, atol=1e-4)
    assert torch.allclose(hits.barycentric.sum(-1), torch.ones(len(points)), atol=1e-6)
    assert (hits.pixel.diff() > 0).all()


def test_a_closed_mesh_looks_the_same_without_the_triangles_turned_away():
    camera = front_camera()
    vertices, faces = sphere()
    both, front = rasterize(camera, vertices, faces), rasterize(camera, vertices, faces, cull=True)
    assert torch.equal(both.pixel, front.pixel)
    assert (both.face == front.face).float().mean() > 0.99
    inside_out = rasterize(camera, vertices, faces.flip(1), cull=True)
    assert torch.equal(inside_out.pixel, both.pixel)
    assert (inside_out.depth > both.depth).float().mean() > 0.99


def test_no_pixel_falls_between_triangles_that_share_an_edge():
    camera = front_camera(64, 300.0)
    g = torch.Generator().manual_seed(0)
    n = 40
    x, y = torch.meshgrid(torch.linspace(-1, 1, n), torch.linspace(-1, 1, n), indexing="ij")
    jitter = 0.02 * torch.randn(n, n, 3, generator=g)
    vertices = (torch.stack([x, y, torch.zeros_like(x)], -1) + jitter).view(-1, 3)
    i = (torch.arange(n - 1)[:, None] * n + torch.arange(n - 1)).flatten()
    faces = torch.cat([torch.stack([i, i + n, i + 1], -1), torch.stack([i + 1, i + n, i + n + 1], -1)])
    assert len(rasterize(camera, vertices, faces).pixel) == 64 * 64


def test_what_lies_behind_the_camera_is_not_drawn():
    camera = front_camera()
    behind = torch.tensor([[-1.0, -1, 5], [1, -1, 5], [0, 1, 5]])
    across = torch.tensor([[-1.0, -1, 0], [1, -1, 0], [0, 1, 9]])
    for vertices in (behind, across):
        assert len(rasterize(camera, vertices, torch.tensor([[0, 1, 2]])).pixel) == 0


def test_a_triangle_without_area_is_not_drawn():
    vertices = torch.tensor([[-1.0, 0, 0], [0, 0, 0], [1, 0, 0]])
    assert len(rasterize(front_camera(), vertices, torch.tensor([[0, 1, 2]])).pixel) == 0


def test_working_in_small_pieces_changes_nothing(monkeypatch):
    camera = front_camera()
    vertices, faces = soup(5)
    whole = rasterize(camera, vertices, faces)
    monkeypatch.setattr(raster, "_PAIRS_AT_ONCE", 50)
    pieces = rasterize(camera, vertices, faces)
    assert torch.equal(whole.face, pieces.face)
    assert torch.equal(whole.depth, pieces.depth)


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 10_000))
def test_moving_mesh_and_camera_together_changes_no_pixel(seed):
    g = torch.Generator().manual_seed(seed)
    move = rigid_transform(axis_angle_to_matrix(torch.randn(3, generator=g)), torch.randn(3, generator=g))
    camera = front_camera()
    moved_camera = Camera(camera.world_to_camera @ rigid_inverse(move), camera.intrinsics, 48, 48)
    vertices, faces = sphere(1.0, 12, 16)
    here = depth_map(camera, vertices, faces)[0]
    there = depth_map(moved_camera, vertices @ move[:3, :3].T + move[:3, 3], faces)[0]
    both = here.isfinite() & there.isfinite()
    assert (here.isfinite() != there.isfinite()).sum() <= 2
    assert torch.allclose(here[both], there[both], atol=1e-3)


def test_the_silhouette_of_a_rectangle_covers_exactly_its_share_of_each_pixel():
    camera = Camera(torch.eye(4), torch.eye(3), 6, 8)
    # At depth 1 with unit focal length, metres are pixels: columns 1.25 .. 4.75, rows 0.5 .. 3.5.
    vertices = torch.tensor([[1.25, 0.5, 1], [4.75, 0.5, 1], [4.75, 3.5, 1], [1.25, 3.5, 1]])
    cover = silhouette(camera, vertices, torch.tensor([[0, 1, 2], [0, 2, 3]]), factor=4)
    columns = torch.tensor([0, 0.25, 1, 1, 1, 0.25, 0, 0])
    rows = torch.tensor([0.0, 1, 1, 1, 0, 0])
    assert torch.allclose(cover, rows[:, None] * columns)


def test_the_silhouette_of_a_sphere_has_the_area_of_its_outline():
    camera = front_camera(64, 60.0)
    vertices, faces = sphere(1.0, 80, 120)
    outline = math.pi * (60.0 * math.tan(math.asin(1 / 4.0))) ** 2
    assert float(silhouette(camera, vertices, faces).sum()) == pytest.approx(outline, rel=6e-3)


def test_the_box_filter_is_the_mean_over_each_pixels_samples():
    camera = front_camera(5)
    g = torch.Generator().manual_seed(0)
    fine = torch.rand(15 * 15, 2, generator=g)
    kept = torch.nonzero(torch.rand(225, generator=g) < 0.6)[:, 0]
    filtered = box_filter(camera, 3, kept, fine[kept])
    sparse = torch.zeros_like(fine)
    sparse[kept] = fine[kept]
    assert torch.allclose(filtered, sparse.view(5, 3, 5, 3, 2).mean((1, 3)), atol=1e-6)


def test_a_supersampled_view_has_its_samples_inside_the_pixel():
    camera = front_camera(5)
    assert supersampled(camera, 1).intrinsics.tolist() == camera.intrinsics.tolist()
    wide = supersampled(camera, 3)
    assert (wide.height, wide.width) == (15, 15)
    # The middle sample of a pixel is its centre.
    assert torch.allclose(pixel_rays(wide, torch.tensor([1.0, 4.0])).directions,
                          pixel_rays(camera, torch.tensor([0.0, 1.0])).directions)  # fmt: skip


def test_an_empty_view_gives_no_hits():
    vertices, faces = sphere(0.1, center=(50.0, 0.0, 0.0))
    hits = rasterize(front_camera(), vertices, faces)
    assert len(hits.pixel) == 0
    depth, seen = depth_map(front_camera(), vertices, faces)
    assert not seen.any()
    assert depth.isinf().all()
