"""DANBO: its parameters and the losses of its own."""

import pytest
import torch
from small_recipes import CASES

from twofold.methods.base import Mode
from twofold.methods.danbo import danbo
from twofold.methods.subject import Subject
from twofold.training.pixels import PixelSource


@pytest.fixture(scope="module")
def subject(person):
    return Subject.of(person)


def test_parameters_are_those_of_the_authors_program(subject):
    avatar = danbo().method.build(subject)
    assert sum(p.numel() for p in avatar.parameters()) == 2_454_852 + 128 * len(subject.times)


def test_samples_that_are_seen_belong_to_one_box_and_boxes_are_tight(subject, person):
    recipe = CASES["danbo"]
    avatar = recipe.method.build(subject, 0)
    with torch.no_grad():
        avatar.local.radiance.density.layers[-1].bias += 3
    batch = PixelSource(person.train, person.body, person.betas, recipe.training.pixels).draw(0, torch.Generator())
    batch = batch.against(torch.zeros(3))
    posed = avatar.pose(person.train[0].pose, person.train[0].translation, 0, Mode(0))
    rendering = avatar.render(batch.rays, posed, batch.background, Mode(0))
    terms = avatar.losses(rendering, batch, posed, Mode(0), torch.Generator())
    weights, assigned = rendering.extras["weights"].tolist(), rendering.extras["extra"].tolist()
    errors = [
        ((1 if w > 0 else 0) - p) ** 2 for ws, ps in zip(weights, assigned, strict=True)
        for w, p in zip(ws, ps, strict=True)
    ]  # fmt: skip
    assert max(max(row) for row in weights) > 0.01
    assert float(terms["assignment"].detach()) == pytest.approx(1e-3 * sum(errors) / len(errors), rel=1e-4)
    volumes = [x * y * z for x, y, z in avatar.boxes().detach().tolist()]
    assert float(terms["boxes"].detach()) == pytest.approx(1e-3 * sum(volumes), rel=1e-5)


def test_nothing_is_outside_of_all_boxes(subject, person):
    avatar = CASES["danbo"].method.build(subject, 0).eval()
    with torch.no_grad():
        avatar.local.radiance.density.layers[-1].bias += 30
        posed = avatar.pose(person.train[0].pose, person.train[0].translation)
        points = posed.body.vertices.mean(0) + 2 * torch.rand(500, 3, generator=torch.Generator().manual_seed(0)) - 1
        level = avatar.level(points, posed)
        moved = points @ posed.own.to_root[:3, :3].T + posed.own.to_root[:3, 3]
        inside = avatar.reached(avatar._coordinates(moved, posed.own))
    assert inside.any()
    assert torch.equal(level < 0, inside)
