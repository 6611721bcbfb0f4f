"""The walk that maps its samples, and looks only at some, against the same steps one after the other."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from small_recipes import CASES

from twofold.geometry.cameras import pixel_grid, pixel_rays
from twofold.geometry.surfaces import nearest_vertices
from twofold.methods.subject import Subject
from twofold.sampling import search_kernels, shell_sampler
from twofold.sampling.placement import FieldQuery
from twofold.sampling.pruning import visible
from twofold.sampling.sdf_grid import UNKNOWN, SdfGrid, tabulate
from twofold.sampling.shell_sampler import ShellSampler
from twofold.sampling.visibility import possible_samples
from twofold.volume.rendering import composite, composite_weights, laplace_density


def found_by(avatar, person, generator, monkeypatch, compiled):
    """Samples of an image's rays by the compiled walk, or step by step."""
    frame = person.train[1]
    rays = pixel_rays(frame.camera, pixel_grid(frame.camera).flatten(0, 1))
    with torch.no_grad():
        surface = avatar.pose(frame.pose, frame.translation).own.surface
    with monkeypatch.context() as patch:
        if not compiled:
            patch.setattr(shell_sampler, "can_walk", lambda *_: False)
        seed = None if generator is None else torch.Generator().manual_seed(generator)
        return avatar._sampler.well_warped(rays, surface, seed)


def by_place(placed):
    """Where each sample stands in the list, by ray and rounded depth."""
    pairs = zip(placed.samples.ray_index.tolist(), placed.samples.depth.tolist(), strict=True)
    return {(ray, round(depth / 0.0011)): i for i, (ray, depth) in enumerate(pairs)}


@pytest.mark.parametrize(
    ("neighbours", "falloff", "slack"),
    [(6, "smooth", 0.006), (6, "smooth", 0.0), (1, "exponential", 0.006), (3, "scene", 0.0)],
)
def test_samples_and_their_way_are_those_found_step_by_step(person, monkeypatch, neighbours, falloff, slack):
    sampler = ShellSampler(radius=0.06, step=0.011, miswarp_slack=slack)
    method = replace(CASES["quick"].method, sampler=sampler, neighbours=neighbours, falloff=falloff)
    avatar = method.build(Subject.of(person))
    for seed in (None, 3):
        ours, twin = (found_by(avatar, person, seed, monkeypatch, compiled) for compiled in (True, False))
        keys = [by_place(placed) for placed in (ours, twin)]
        both = sorted(set(keys[0]) & set(keys[1]))
        # Rounded otherwise, a point on the shell's rim or between two voxels changes sides.
        assert len(both) > 1000
        assert len(both) > 0.995 * max(map(len, keys))
        here, there = (torch.tensor([table[key] for key in both]) for table in keys)
        mine, other = ours[here], twin[there]
        same = (mine.nearest == other.nearest).all(1)
        assert same.float().mean() > 0.99
        for name, tolerance in (("weights", 1e-4), ("x_canonical", 1e-4), ("inverse", 1e-3)):
            torch.testing.assert_close(
                getattr(mine, name)[same], getattr(other, name)[same], atol=tolerance, rtol=tolerance
            )
        torch.testing.assert_close(mine.samples.depth, other.samples.depth)
        assert (ours.samples.ray_index.diff() >= 0).all()
        assert not ours.outlier.any()


def test_rays_that_miss_have_no_samples(person):
    avatar = CASES["quick"].method.build(Subject.of(person))
    frame = person.train[1]
    rays = pixel_rays(frame.camera, pixel_grid(frame.camera).flatten(0, 1)[:10])
    away = replace(rays, directions=-rays.directions)
    with torch.no_grad():
        placed = avatar._sampler.well_warped(away, avatar.pose(frame.pose, frame.translation).own.surface, None)
    assert len(placed.samples) == 0
    assert placed.x_canonical.shape == (0, 3)


class BallField:
    """The distance to balls around the vertices of the canonical body; counts how many points were asked for."""

    def __init__(self, avatar, radius=0.02):
        self.avatar, self.radius, self.asked = avatar, radius, 0

    def __call__(self, x):
        self.asked += len(x)
        return nearest_vertices(x, self.avatar.canonical_points, 1)[0][:, 0] - self.radius


def seen_by(placed, field, beta, rays):
    """Opacity and mean depth of each ray."""
    samples = placed.samples
    with torch.no_grad():
        weights = composite_weights(laplace_density(field(placed.x_canonical), beta), samples)
        opacity, depth = composite(weights, torch.stack([torch.ones_like(weights), samples.depth], 1), samples, rays).T
    return opacity, depth / opacity.clamp_min(1e-6)


@pytest.fixture(scope="module")
def started(person):
    """An avatar whose field is the body, a frame's surface, rays of all of its pixels."""
    avatar = CASES["quick"].method.build(Subject.of(person))
    frame = person.train[1]
    with torch.no_grad():
        surface = avatar.pose(frame.pose, frame.translation).own.surface
    return avatar, surface, pixel_rays(frame.camera, pixel_grid(frame.camera).flatten(0, 1))


def walk_of(started, step, seed=3):
    avatar, surface, rays = started
    sampler = replace(avatar._sampler.config, step=step)
    placer = sampler.build(avatar.deformation, avatar.canonical_points, avatar.subject.body.faces)
    return placer._walk(placer._shell(surface), rays, surface, torch.Generator().manual_seed(seed))


@pytest.mark.parametrize(("beta", "radius"), [(0.01, 0.02), (0.003, 0.03), (0.05, 0.01)])
def test_samples_seen_on_the_way_are_the_visible_ones_of_all(started, beta, radius):
    avatar, _, rays = started
    walk, beta = walk_of(started, 0.011), torch.tensor(beta)
    whole, all_asked, asked = walk.whole(), BallField(avatar, radius), BallField(avatar, radius)
    with torch.no_grad():
        wanted = whole[visible(whole.samples, whole.x_canonical, len(rays), FieldQuery(all_asked, beta), 2e-3)]
        ours = walk.seen(FieldQuery(asked, beta), 2e-3, share=0.0)
    mine, theirs = by_place(ours), by_place(wanted)
    # Light is multiplied in another order, which decides about samples that are just seen or just not.
    assert len(set(mine) ^ set(theirs)) <= 0.002 * len(theirs)
    both = sorted(set(mine) & set(theirs))
    here, there = (torch.tensor([table[key] for key in both]) for table in (mine, theirs))
    for name in ("nearest", "weights", "x_canonical", "inverse"):
        torch.testing.assert_close(getattr(ours, name)[here], getattr(wanted, name)[there])
    assert (ours.samples.ray_index.diff() >= 0).all()
    # Further from a soft surface rays are followed in stretches, some samples of which turn out to be no samples.
    assert asked.asked <= (1.01 if beta > 0.005 else 1) * all_asked.asked


@pytest.mark.parametrize(("beta", "radius"), [(0.002, 0.01), (0.003, 0.02)])
def test_leaps_pass_over_nothing_that_counts(started, beta, radius):
    avatar, _, rays = started
    walk, beta = walk_of(started, 0.011), torch.tensor(beta)
    fields = [BallField(avatar, radius) for _ in range(2)]
    with torch.no_grad():
        every, leaping = (
            walk.seen(FieldQuery(field, beta), 2e-3, share) for field, share in zip(fields, (0.0, 0.7), strict=True)
        )
    (opaque, depth), (leaping_opaque, leaping_depth) = (
        seen_by(placed, field, beta, len(rays)) for placed, field in zip((every, leaping), fields, strict=True)
    )
    assert (opaque - leaping_opaque).abs().max() < 0.01
    assert (depth - leaping_depth)[opaque > 0.5].abs().max() < 0.002
    assert fields[1].asked < fields[0].asked


def test_steps_near_the_surface_are_divided_down_to_twice_the_scale(started):
    avatar, _, _ = started
    walk, field = walk_of(started, 0.012), BallField(avatar)
    with torch.no_grad():
        found = {
            scale: walk.seen(FieldQuery(field, torch.tensor(scale)), 2e-3, 0.7, finest=0.003)
            for scale in (0.01, 0.003, 0.0005)
        }
    for scale, step in ((0.01, 0.012), (0.003, 0.006), (0.0005, 0.003)):
        assert found[scale].samples.delta.unique().tolist() == pytest.approx([step])
    fine, coarse = found[0.003], walk.seen(FieldQuery(field, torch.tensor(0.003)), 2e-3, 0.7)
    # Each lies within half a step of one of the coarse samples, in depth order, and all of these are divided.
    ray, depth = fine.samples.ray_index, fine.samples.depth
    same = ray.diff() == 0
    assert (depth.diff()[same] > 0.0059).all()
    for r in coarse.samples.ray_index.unique()[::97]:
        around = coarse.samples.depth[coarse.samples.ray_index == r]
        gap = (depth[ray == r][:, None] - around).abs().amin(1)
        torch.testing.assert_close(gap, torch.full_like(gap, 0.003), atol=1e-5, rtol=0)
    # A finer walk from the same start finds the same surface: the light that comes through agrees.
    assert 0.9 < len(ray.unique()) / len(coarse.samples.ray_index.unique()) < 1.1


@pytest.mark.parametrize(("beta", "radius", "finest"), [(0.002, 0.01, 0.0), (0.003, 0.02, 0.0), (0.002, 0.02, 0.003)])
def test_a_grid_finds_the_samples_that_the_field_would_find(started, beta, radius, finest):
    avatar, _, _ = started
    walk, beta = walk_of(started, 0.011), torch.tensor(beta)
    field, asked = BallField(avatar, radius), [BallField(avatar, radius) for _ in range(2)]
    with torch.no_grad():
        grid = tabulate(field, avatar.canonical_points, 0.015, 0.09, covered=0.99)
        every, found = (
            walk.seen(FieldQuery(own, beta), 2e-3, share, finest, table)
            for own, share, table in zip(asked, (0.0, 0.7), (None, grid), strict=True)
        )
    keys = [by_place(placed) for placed in (found, every)]
    assert len(keys[1]) > 1000
    # With divided steps the light is followed twice, first in whole steps that decide what is divided.
    assert len(set(keys[0]) ^ set(keys[1])) <= (0.03 if finest else 0.005) * len(keys[1])
    assert asked[1].asked < 0.95 * asked[0].asked
    both = sorted(set(keys[0]) & set(keys[1]))
    here, there = (torch.tensor([table[key] for key in both]) for table in keys)
    for name in ("nearest", "weights", "x_canonical", "inverse"):
        torch.testing.assert_close(getattr(found, name)[here], getattr(every, name)[there])


def test_a_grid_alone_chooses_where_queries_are_costly(started):
    avatar, _, rays = started
    walk, beta, field = walk_of(started, 0.011), torch.tensor(0.003), BallField(avatar, 0.02)
    with torch.no_grad():
        grid = tabulate(field, avatar.canonical_points, 0.015, 0.09, covered=0.75)
        asked = BallField(avatar, 0.02)
        alone = walk.seen(FieldQuery(asked, beta, costly=True), 2e-3, 0.7, 0.0, grid)
        every = walk.whole()
        other = every[
            visible(every.samples, every.x_canonical, len(rays), FieldQuery(asked, beta, (), True), 2e-3, grid)
        ]
        exact = walk.seen(FieldQuery(BallField(avatar, 0.02), beta), 2e-3, 0.7)
    assert asked.asked == 0
    # As on GPUs, but for where light is multiplied in another order; nearly all that queries find, and some more.
    chosen = [set(by_place(placed)) for placed in (alone, other, exact)]
    assert len(chosen[0] ^ chosen[1]) <= 0.01 * len(chosen[1])
    assert len(chosen[2] - chosen[0]) <= 0.02 * len(chosen[2])
    assert len(chosen[0]) < 1.5 * len(chosen[2])


def test_a_grid_that_knows_nothing_leaves_everything_to_the_field(started):
    avatar, _, _ = started
    walk, beta = walk_of(started, 0.011), torch.tensor(0.003)
    empty = SdfGrid(torch.full((4, 4, 4), UNKNOWN), torch.zeros(3), 0.02, 0.0)
    with torch.no_grad():
        every, found = (walk.seen(FieldQuery(BallField(avatar), beta), 2e-3, 0.0, 0.0, g) for g in (None, empty))
    assert len(every.samples) > 1000
    assert set(by_place(found)) == set(by_place(every))


def test_bounds_of_a_grid_decide_like_possible_samples(started, generator):
    """The compiled decision against that of `visibility.possible_samples`."""
    avatar, _, _ = started
    walk, beta = walk_of(started, 0.011), torch.tensor(0.003)
    whole = walk.whole()
    with torch.no_grad():
        grid = tabulate(BallField(avatar), avatar.canonical_points, 0.02, 0.09)
        nearer, further = grid.bounds(whole.x_canonical)
        most, fewest = laplace_density(nearer, beta), laplace_density(further, beta)
        wanted = possible_samples(whole.samples, fewest, most, 2e-3)
    ray_at, number = whole.samples.ray_index.numpy(), np.arange(len(whole.samples))
    possible = np.empty(len(number), bool)
    own = np.float32(beta), np.float32(2e-3), np.float32(walk.step)
    search_kernels.mark_possible(number, ray_at, whole.x_canonical.numpy(), grid.arrays(), *own, possible)
    # Where nothing is known a sample counts here, and there only as far as its step is long.
    assert (possible != wanted.numpy()).mean() < 0.002
    assert 0.02 < possible.mean() < 0.98


def test_a_finer_walk_and_a_divided_one_show_the_same_surface(started):
    avatar, _, rays = started
    beta = torch.tensor(0.002)
    with torch.no_grad():
        fine = walk_of(started, 0.003).seen(FieldQuery(BallField(avatar), beta), 2e-3, 0.0)
        divided = walk_of(started, 0.012).seen(FieldQuery(BallField(avatar), beta), 2e-3, 0.7, finest=0.003)
    (opaque, depth), (divided_opaque, divided_depth) = (
        seen_by(placed, BallField(avatar), beta, len(rays)) for placed in (fine, divided)
    )
    assert (opaque - divided_opaque).abs().mean() < 0.002
    assert (depth - divided_depth)[opaque > 0.5].abs().quantile(0.95) < 0.002


@pytest.mark.parametrize("slack", [0.0, 0.006])
def test_divided_steps_are_those_of_the_twin_in_torch(started, monkeypatch, slack):
    avatar, surface, rays = started
    sampler = replace(avatar._sampler.config, step=0.012, finest=0.003, leap=0.0, min_weight=2e-3, miswarp_slack=slack)
    placer = sampler.build(avatar.deformation, avatar.canonical_points, avatar.subject.body.faces)
    query = FieldQuery(BallField(avatar), torch.tensor(0.0025))
    ours = placer.place(rays, surface, query, True, torch.Generator().manual_seed(1))
    monkeypatch.setattr(shell_sampler, "can_walk", lambda *_: False)
    twin = placer.place(rays, surface, query, True, torch.Generator().manual_seed(1))
    keys = [by_place(placed) for placed in (ours, twin)]
    both = sorted(set(keys[0]) & set(keys[1]))
    assert len(both) > 0.98 * max(map(len, keys))
    assert len(both) > 500
    here, there = (torch.tensor([table[key] for key in both]) for table in keys)
    torch.testing.assert_close(ours.x_canonical[here], twin.x_canonical[there], atol=1e-3, rtol=1e-3)
    assert ours.samples.delta.unique().tolist() == twin.samples.delta.unique().tolist() == pytest.approx([0.004])


def test_divided_steps_need_a_least_weight():
    with pytest.raises(ValueError, match="it needs a min_weight above 0"):
        ShellSampler(finest=0.003, min_weight=0.0)
