"""PM-Avatar: its parameters, its fast recipe, and losses of its own."""

from dataclasses import replace

import pytest
import torch
from small_recipes import CASES

from twofold.methods.base import Mode
from twofold.methods.pm_avatar import pm_avatar, pm_avatar_fast
from twofold.methods.subject import Subject
from twofold.training.pixels import PixelSource


@pytest.fixture(scope="module")
def subject(person):
    return Subject.of(person)


def test_parameters_are_those_of_the_authors_program(subject):
    avatar = pm_avatar().method.build(subject)
    assert sum(p.numel() for p in avatar.parameters()) == 3_011_684 + 128 * len(subject.times)


def test_fast_computes_what_matters_of_the_same_field(subject, person):
    """Where both compute a point, leaving far boxes out changes its density by next to nothing."""
    whole = pm_avatar().method.build(subject, 0).eval()
    fast = replace(pm_avatar_fast().method, boxed=replace(pm_avatar_fast().method.boxed, hidden_dtype="float32"))
    fast = fast.build(subject, 0).eval()
    with torch.no_grad():
        for avatar in (whole, fast):
            avatar.radiance.density.layers[-1].bias += 1
        frame = person.train[1]
        first, second = (avatar.pose(frame.pose, frame.translation) for avatar in (whole, fast))
        points = (first.body.vertices[::20] @ first.own.to_root[:3, :3].T) + first.own.to_root[:3, 3]
        coordinates = whole._coordinates(points, first.own)
        kept = fast.reached(coordinates)
        one = whole.density_at(points[kept], coordinates[kept], first.own)
        other = fast.density_at(points[kept], coordinates[kept], second.own)
    assert kept.float().mean() > 0.9
    assert (one - other).abs().max() < 0.02 * one.mean()


def test_boxes_are_kept_tight_by_their_volume(subject, person):
    recipe = CASES["pm_avatar"]
    avatar = recipe.method.build(subject, 0)
    batch = PixelSource(person.train, person.body, person.betas, recipe.training.pixels).draw(0, torch.Generator())
    batch = batch.against(torch.zeros(3))
    posed = avatar.pose(person.train[0].pose, person.train[0].translation, 0, Mode(0))
    rendering = avatar.render(batch.rays, posed, batch.background, Mode(0))
    term = avatar.losses(rendering, batch, posed, Mode(0), torch.Generator())["boxes"]
    sizes = avatar.boxes().detach().tolist()
    assert float(term.detach()) == pytest.approx(1e-3 * sum(x * y * z for x, y, z in sizes), rel=1e-5)


def test_rays_beside_all_boxes_are_sampled_as_released_or_not_at_all(subject, person):
    released, fast = (CASES[name].method.build(subject, 0) for name in ("pm_avatar", "pm_avatar_fast"))
    source = PixelSource(person.train, person.body, person.betas, replace(CASES["pm_avatar"].training.pixels, rays=200))
    rays = source.draw(0, torch.Generator().manual_seed(0)).rays
    frame = person.train[0]
    sampled = [avatar.bounded(rays, avatar.pose(frame.pose, frame.translation).own)[1] for avatar in (released, fast)]
    assert (sampled[0] | ~sampled[1]).all()
    assert sampled[0].sum() >= sampled[1].sum()
