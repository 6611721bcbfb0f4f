"""The walk that maps its samples against the same steps one after the other."""

from dataclasses import replace

import pytest
import torch
from small_recipes import CASES

from twofold.geometry.cameras import pixel_grid, pixel_rays
from twofold.methods.subject import Subject
from twofold.sampling import shell_sampler
from twofold.sampling.shell_sampler import ShellSampler


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
