"""The shell against brute force: the samples it finds, the vertices it lists, and the leaps through empty space."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from little_body import posed_little_body
from scipy import ndimage

from twofold.geometry.cameras import Rays, clip_to_box
from twofold.geometry.surfaces import nearest_vertices
from twofold.sampling.shell import _listed_compiled, _listed_in_torch, build_shell, nearest_listed, sample_shell

RADIUS, VOXEL, STEP = 0.06, 0.02, 0.01


@pytest.fixture(scope="module")
def body():
    """As fine as SMPL: vertices two centimetres apart."""
    return posed_little_body(spacing=0.017)


@pytest.fixture(scope="module")
def shell(body):
    return build_shell(body.vertices, RADIUS, VOXEL)


def rays_towards(vertices, count=60, seed=0, dtype=torch.float32):
    """From three metres away past and through the body; every fourth misses it altogether."""
    generator = torch.Generator().manual_seed(seed)
    away = torch.nn.functional.normalize(torch.randn(count, 3, generator=generator), dim=1)
    target = vertices[torch.randint(len(vertices), (count,), generator=generator)]
    target = target + 0.05 * torch.randn(count, 3, generator=generator)
    target[::4] += 5
    origins = vertices.mean(0) + 3 * away
    directions = torch.nn.functional.normalize(target - origins, dim=1)
    near = torch.zeros(count)
    return Rays(origins.to(dtype), directions.to(dtype), near.to(dtype), torch.full_like(near, torch.inf, dtype=dtype))


def comb(shell, rays, start):
    """Ray, depth and point of every position that the comb of samples has in the shell's box, one by one."""
    clipped, hit = clip_to_box(rays, shell.low, shell.high)
    found = []
    for r in hit.nonzero()[:, 0].tolist():
        near, far, i = float(clipped.near[r]), float(clipped.far[r]), 0
        while (depth := near + STEP * (i + float(start[r]))) < far:
            found.append((r, i, depth, *(rays.origins[r].double() + depth * rays.directions[r].double()).tolist()))
            i += 1
    table = torch.tensor(found, dtype=torch.float64)
    return table[:, :2].long(), table[:, 2], table[:, 3:]


def numbered(shell, rays, samples, start):
    """Ray and place in the comb of samples that were found."""
    near = clip_to_box(rays, shell.low, shell.high)[0].near[samples.ray_index]
    return torch.stack(
        [samples.ray_index, ((samples.depth - near) / STEP - start[samples.ray_index]).round().long()], 1
    )


def as_set(pairs):
    return set(map(tuple, pairs.tolist()))


@pytest.mark.parametrize("jittered", [False, True])
def test_samples_are_the_comb_within_the_limit(body, shell, jittered):
    rays, limit = rays_towards(body.vertices), 0.05
    generator = torch.Generator().manual_seed(5) if jittered else None
    samples, nearest, squared = sample_shell(shell, rays, STEP, generator, limit)
    start = torch.rand(60, generator=torch.Generator().manual_seed(5)) if jittered else torch.full((60,), 0.5)
    places, depth, points = comb(shell, rays, start)
    distance, closest = nearest_vertices(points, body.vertices)
    sure = (distance[:, 0] - limit).abs() > 1e-5
    expected = as_set(places[sure & (distance[:, 0] < limit)])
    maybe = as_set(places[~sure])
    found = numbered(shell, rays, samples, start)
    assert len(as_set(found)) == len(found) > 1000
    assert not as_set(found) - expected - maybe, "nothing beyond the limit"
    # A voxel lists six vertices: now and then the nearest of a point is none of them.
    assert len(expected - as_set(found)) < 0.005 * len(expected)
    index = {place: i for i, place in enumerate(map(tuple, places.tolist()))}
    at = torch.tensor([index[tuple(place)] for place in found.tolist()])
    torch.testing.assert_close(samples.depth, depth[at].float(), atol=2e-6, rtol=0)
    assert (nearest == closest[at]).float().mean() > 0.97
    own = (points[at] - body.vertices[nearest[:, 0]]).square().sum(-1, keepdim=True)
    torch.testing.assert_close(squared, own.float(), atol=1e-6, rtol=1e-3)
    assert (squared.sqrt() >= distance[at].float() - 1e-5).all()


def test_samples_are_packed_by_ray_and_ordered_by_depth(body, shell):
    rays = rays_towards(body.vertices)
    samples, nearest, _ = sample_shell(shell, rays, STEP, None, RADIUS)
    same = samples.ray_index[1:] == samples.ray_index[:-1]
    assert (samples.ray_index[1:] >= samples.ray_index[:-1]).all()
    assert (samples.depth[1:] > samples.depth[:-1])[same].all()
    assert (samples.delta == STEP).all()
    assert not set(samples.ray_index.tolist()) & set(range(0, 60, 4)), "these rays miss the body"
    assert nearest.dtype == torch.int64


def test_near_and_far_bounds_of_rays_are_kept(body, shell):
    rays = rays_towards(body.vertices)
    everything = sample_shell(shell, rays, STEP, None, RADIUS)[0]
    middle = float(everything.depth.median())
    bounded = replace(rays, near=torch.full((60,), middle - 0.1), far=torch.full((60,), middle + 0.1))
    samples = sample_shell(shell, bounded, STEP, None, RADIUS)[0]
    assert 0 < len(samples) < len(everything)
    assert (samples.depth - middle).abs().max() < 0.1


@pytest.mark.parametrize("step", [0.01, 0.0007], ids=["a few a ray", "hundreds a ray"])
def test_compiled_walk_is_its_twin_in_torch(body, shell, step):
    rays = rays_towards(body.vertices, 40 if step == STEP else 6)
    clipped, hit = clip_to_box(rays, shell.low, shell.high)
    clipped = clipped[hit]
    start = torch.rand(len(clipped), generator=torch.Generator().manual_seed(1))
    compiled, twin = (walk(shell, clipped, start, step) for walk in (_listed_compiled, _listed_in_torch))
    places = [
        torch.stack([ray, ((depth - clipped.near[ray]) / step - start[ray]).round().long()], 1)
        for ray, depth, _ in (compiled, twin)
    ]
    first, second = map(as_set, places)
    assert len(first) > 24 * len(clipped) or step == STEP
    # They round differently, which now and then puts a point into the neighbouring voxel.
    assert len(first ^ second) <= 0.002 * len(first)
    index = {place: i for i, place in enumerate(map(tuple, places[1].tolist()))}
    both = [(i, index[place]) for i, place in enumerate(map(tuple, places[0].tolist())) if place in index]
    here, there = torch.tensor(both).T
    torch.testing.assert_close(compiled[1][here], twin[1][there], atol=1e-6, rtol=0)
    assert (compiled[2][here] == twin[2][there]).float().mean() > 0.998


def test_rays_in_double_precision_find_the_same(body, shell):
    single = sample_shell(shell, rays_towards(body.vertices), STEP, None, RADIUS)[0]
    double = sample_shell(shell, rays_towards(body.vertices, dtype=torch.float64), STEP, None, RADIUS)[0]
    assert double.depth.dtype == torch.float64
    counts = [torch.bincount(s.ray_index, minlength=60) for s in (single, double)]
    assert (counts[0] - counts[1]).abs().sum() <= 0.002 * len(single)


@pytest.mark.parametrize("step", [0.01, 0.0031])
def test_leaps_skip_nothing(body, shell, step):
    rays = rays_towards(body.vertices, 80, seed=2)
    patient = replace(shell, row=shell.row.clamp_min(-1))
    assert shell.row.min() < -8, "there is room for leaps"
    leaping, walking = (sample_shell(s, rays, step, torch.Generator().manual_seed(3), RADIUS) for s in (shell, patient))
    assert torch.equal(leaping[0].ray_index, walking[0].ray_index)
    assert torch.equal(leaping[0].depth, walking[0].depth)
    assert torch.equal(leaping[1], walking[1])


def test_empty_voxels_tell_how_far_the_shell_is(shell):
    row = shell.row.numpy()
    away = ndimage.distance_transform_edt(row < 0)
    assert (away[row < 0] >= -row[row < 0] - 1).all()


def test_every_point_within_the_radius_lies_in_the_shell(body, shell):
    generator = torch.Generator().manual_seed(4)
    offset = torch.nn.functional.normalize(torch.randn(len(body.vertices), 3, generator=generator), dim=1)
    points = body.vertices + RADIUS * torch.rand(len(offset), 1, generator=generator) * offset
    rows = shell.rows_at(points)
    assert (rows >= 0).all()
    assert rows.max() < len(shell.nearest)


def test_shell_is_little_more_than_the_radius(body, shell):
    inside = (shell.row >= 0).nonzero()
    centers = shell.low + (inside + 0.5) * VOXEL
    distance, _ = nearest_vertices(centers, body.vertices)
    assert distance.max() <= RADIUS + 3**0.5 / 2 * VOXEL + 1e-6
    assert len(inside) == len(shell.nearest)
    assert len(shell.row[shell.row >= 0].unique()) == len(inside), "each voxel has its own row"


def test_voxels_list_what_is_nearest_to_their_centres(body, shell):
    inside = (shell.row >= 0).nonzero()[::50]
    centers = shell.low + (inside + 0.5) * VOXEL
    expected = torch.cdist(centers.double(), body.vertices.double()).sort(1).values[:, :6].float()
    listed = shell.nearest[shell.rows_at(centers)].long()
    found = (body.vertices[listed] - centers[:, None]).norm(dim=-1)
    torch.testing.assert_close(found, expected, atol=2e-6, rtol=0)


@given(point=st.tuples(*[st.floats(-4, 4)] * 3))
def test_points_outside_the_grid_are_in_no_voxel(body, shell, point):
    size = shell.high - shell.low
    point = shell.low + size * (torch.tensor(point) + 0.5)
    outside = bool((point < shell.low - 1e-4).any() or (point > shell.high + 1e-4).any())
    row = int(shell.rows_at(point))
    assert row < 0 or not outside
    if row >= 0:
        near = float((body.vertices - point).norm(dim=-1).min())
        assert near <= RADIUS + 3**0.5 * VOXEL + 1e-5


@pytest.mark.parametrize("k", [1, 3])
def test_nearest_among_the_listed_is_nearest_of_all_but_seldom(body, shell, k):
    generator = torch.Generator().manual_seed(6)
    points = body.vertices.repeat(2, 1) + 0.02 * torch.randn(2 * len(body.vertices), 3, generator=generator)
    rows = shell.rows_at(points)
    points, rows = points[rows >= 0], rows[rows >= 0]
    found, squared = nearest_listed(shell, points, rows, k)
    own = (body.vertices[found] - points[:, None]).square().sum(-1)
    torch.testing.assert_close(squared, own, atol=1e-7, rtol=1e-4)
    assert (squared.diff(dim=1) >= 0).all()
    distance, closest = nearest_vertices(points, body.vertices, k)
    # Missed where vertices lie far closer than a voxel is wide, as where two sausages meet.
    assert (found[:, 0] == closest[:, 0]).float().mean() > 0.97
    excess = squared[:, 0].sqrt() - distance[:, 0]
    assert excess.min() > -1e-5
    assert excess.max() < VOXEL
    assert excess.mean() < 1e-4


def test_no_ray_meets_the_shell_and_nothing_comes_out(body, shell):
    rays = rays_towards(body.vertices)
    away = replace(rays, directions=-rays.directions)
    samples, nearest, squared = sample_shell(shell, away, STEP, None, RADIUS)
    assert len(samples) == 0
    assert nearest.shape == squared.shape == (0, 1)


def test_the_generator_decides_everything(body, shell):
    rays = rays_towards(body.vertices)
    draws = [sample_shell(shell, rays, STEP, torch.Generator().manual_seed(s), RADIUS)[0].depth for s in (1, 1, 2)]
    assert torch.equal(draws[0], draws[1])
    assert not torch.equal(draws[0], draws[2])


@pytest.mark.parametrize("candidates", [1, 6])
def test_bodies_with_hardly_any_vertices_have_shells_too(candidates):
    vertices = torch.tensor([[0.0, 0, 0], [0.1, 0, 0], [0, 0.1, 0]])
    shell = build_shell(vertices, 0.05, 0.02, candidates)
    assert shell.nearest.shape[1] == min(candidates, 3)
    assert int(shell.nearest.max()) == 2
    assert int(shell.nearest[shell.rows_at(vertices[1])][0]) == 1


def test_the_voxel_list_is_the_same_for_a_posed_body_that_wants_gradients(body, shell):
    again = build_shell(body.vertices.clone().requires_grad_(), RADIUS, VOXEL)
    np.testing.assert_array_equal(again.row, shell.row)
    assert not again.vertices.requires_grad
