"""An SDF grid saves queries of the field, and images stay as they are."""

from dataclasses import replace

import pytest
import torch
from small_recipes import CASES

from twofold.geometry.cameras import pixel_grid, pixel_rays
from twofold.methods.base import EVALUATION, Mode
from twofold.methods.subject import Subject
from twofold.sampling import shell_sampler
from twofold.sampling.pruning import miswarped
from twofold.sampling.shell import build_shell, expected_samples
from twofold.sampling.shell_sampler import ShellSampler
from twofold.training.loop import train

BLACK = torch.zeros(3)


@pytest.fixture(scope="module")
def dense(person, tmp_path_factory):
    """A dense avatar trained long enough to have a surface that lies in the shell."""
    recipe = CASES["fast"]
    losses = replace(recipe.method.losses, mask=1.0, s3im=0.0)
    method = replace(recipe.method, beta=0.01, losses=losses, field=replace(recipe.method.field, radius=0.3))
    method = replace(method, rates=replace(method.rates, low=2e-3, high=1e-3))
    training = replace(recipe.training, steps=60, preview_every=0)
    recipe = replace(recipe, method=method, training=training)
    return train(person, recipe, tmp_path_factory.mktemp("dense") / "run", torch.device("cpu"))


@pytest.fixture
def looking(dense, person, monkeypatch):
    """Renders with a table of some spacing, and counts the samples for which the distance network is queried."""
    monkeypatch.setattr(shell_sampler, "_GRID_PAYS", 10)
    asked = []
    sdf = dense.field._sdf
    monkeypatch.setattr(dense.field, "_sdf", lambda x, networks: asked.append(len(x)) or sdf(x, networks))
    config = dense._sampler.config
    frame = person.train[1]
    rays = pixel_rays(frame.camera, pixel_grid(frame.camera).flatten(0, 1))

    def look(spacing, posed=None, min_weight=config.min_weight):
        dense._sampler.config = replace(config, sdf_grid_voxel=spacing, min_weight=min_weight)
        posed = posed or dense.pose(frame.pose, frame.translation)
        before = sum(asked)
        with torch.no_grad():
            return dense.render(rays, posed, BLACK), sum(asked) - before, posed

    yield look
    dense._sampler.config = config


def test_images_are_the_same_with_a_table(looking, dense, monkeypatch):
    monkeypatch.setattr(dense.field, "dense", False)  # Queries count as cheap: the field has the last word.
    (plain, many, _), (tabled, _, posed) = looking(0.0), looking(0.015)
    assert 0.1 < plain.opacity.mean() < 0.9
    for name in ("color", "opacity", "depth", "normal"):
        torch.testing.assert_close(getattr(tabled, name), getattr(plain, name), atol=4e-3, rtol=0)
    # With the table made already, fewer samples are left to ask about.
    again, few, _ = looking(0.015, posed)
    assert torch.equal(again.color, tabled.color)
    assert 0 < few < 0.8 * many


def test_a_table_alone_chooses_samples_as_well_as_queries_do(looking):
    """Both against the image of all samples."""
    (plain, many, _), (tabled, _, posed), (whole, _, _) = looking(0.0), looking(0.015), looking(0.0, min_weight=0.0)
    assert 0.1 < whole.opacity.mean() < 0.9
    for name, bound in (("color", 1e-3), ("opacity", 1e-3), ("normal", 2e-3)):
        by_queries, by_table = ((getattr(image, name) - getattr(whole, name)).abs().mean() for image in (plain, tabled))
        assert by_table < 1.2 * by_queries + 1e-4
        assert by_table < bound
    # With the table made already, the field is not queried at all.
    again, few, _ = looking(0.015, posed)
    assert torch.equal(again.color, tabled.color)
    assert few == 0 < many


def test_a_table_belongs_to_one_pose_and_one_state_of_the_field(looking, dense):
    _, first, posed = looking(0.03)
    _, again, _ = looking(0.03, posed)
    _, other, _ = looking(0.03)
    assert again < first == other
    with torch.no_grad():
        next(dense.field.parameters()).mul_(1)
    _, changed, _ = looking(0.03, posed)
    assert changed > 2 * again


def test_a_training_step_makes_the_grid_of_before_invalid(looking, dense):
    """Fused Adam does not count versions of the parameters that it changes."""
    _, _, posed = looking(0.03)
    _, again, _ = looking(0.03, posed)
    dense.before_step(Mode(7))
    _, after, _ = looking(0.03, posed)
    assert after > 2 * again


def test_few_samples_are_asked_about_one_by_one(looking, monkeypatch):
    monkeypatch.setattr(shell_sampler, "_GRID_PAYS", 10**9)
    assert looking(0.03)[1] == looking(0.0)[1]


def test_training_asks_about_every_sample(dense, person, looking):
    looking(0.03)
    frame = person.train[1]
    posed = dense.pose(frame.pose, frame.translation, frame.frame_index, Mode(5))
    rays = pixel_rays(frame.camera, pixel_grid(frame.camera).flatten(0, 1)[:40])
    dense._sampler._last_grid = None
    dense.render(rays, posed, BLACK, Mode(5), torch.Generator().manual_seed(0))
    assert dense._sampler._last_grid is None


def test_samples_that_are_carried_to_another_part_are_air(dense, person):
    """The rest are as far from the canonical body as they were from the posed one."""
    frame = person.train[1]
    with torch.no_grad():
        posed = dense.pose(frame.pose, frame.translation)
    rays = pixel_rays(frame.camera, pixel_grid(frame.camera).flatten(0, 1))
    sampler, surface = dense.config.sampler, posed.own.surface
    placed = sampler.build(dense.deformation, dense.canonical_points, posed.body.faces).candidates(rays, surface, None)
    x = placed.x_canonical
    canonical = build_shell(dense.canonical_points, sampler.radius, sampler.voxel)
    stray = miswarped(placed, rays, surface, canonical, 0.006)
    away = (placed.samples.points(rays) - posed.body.vertices[placed.nearest[:, 0]]).norm(dim=-1)
    nearer = away - torch.cdist(x, dense.canonical_points).amin(1)
    assert 0 < stray.sum() < len(stray)
    assert nearer.max() > 0.02
    assert (nearer[stray] > 0.0059).all()
    # What a voxel does not list may still be nearer, hence not all.
    assert (nearer[~stray] < 0.0061).float().mean() > 0.99
    assert not miswarped(placed, rays, surface, canonical, 1.0).any()


def test_strays_are_air_in_training_and_in_images(person):
    recipe = CASES["quick"]
    frame = person.train[1]
    rays = pixel_rays(frame.camera, pixel_grid(frame.camera).flatten(0, 1))
    counts = {}
    for stray in (0.0, 0.006):
        sampler = replace(recipe.method.sampler, miswarp_slack=stray, min_weight=0.0)
        avatar = replace(recipe.method, sampler=sampler).build(Subject.of(person))
        for training in (True, False):
            mode = Mode(5) if training else EVALUATION
            posed = avatar.pose(frame.pose, frame.translation, frame.frame_index, mode)
            noise = torch.Generator().manual_seed(0) if training else None
            counts[stray, training] = len(avatar.place(rays, posed, mode, noise).samples)
    assert 0 < counts[0.006, True] < counts[0.0, True]
    assert 0 < counts[0.006, False] < counts[0.0, False]


@pytest.mark.parametrize(
    "wrong",
    [
        {"radius": 0.0},
        {"step": -1.0},
        {"sdf_grid_voxel": -0.1},
        {"miswarp_slack": -0.01},
        {"sdf_grid_voxel": 1e-3},
    ],
)
def test_sizes_that_leave_nothing_to_sample_are_refused(wrong):
    with pytest.raises(ValueError, match=r"(radius|step|miswarp_slack|sdf_grid_voxel)=.* should be 0"):
        ShellSampler(**wrong)


def test_the_grid_of_small_networks_pays_for_large_images_only(person, monkeypatch):
    avatar = CASES["quick"].method.build(Subject.of(person)).eval()
    frame = person.train[0]
    rays = pixel_rays(frame.camera, pixel_grid(frame.camera).flatten(0, 1))
    with torch.no_grad():
        posed = avatar.pose(frame.pose, frame.translation)
    found = {}
    for pays in (10**9, 10):
        monkeypatch.setattr(shell_sampler, "_GRID_PAYS", pays)
        with torch.no_grad():
            found[pays] = avatar.render(rays, posed, BLACK)
        assert (avatar._sampler._last_grid is None) == (pays > 10)
    assert found[10].opacity.max() > 0.9
    for name in ("color", "opacity", "depth", "normal"):
        torch.testing.assert_close(getattr(found[10], name), getattr(found[10**9], name), atol=4e-3, rtol=0)


def test_expected_samples_are_about_those_that_there_are(dense, person):
    frame = person.train[1]
    rays = pixel_rays(frame.camera, pixel_grid(frame.camera).flatten(0, 1))
    with torch.no_grad():
        surface = dense.pose(frame.pose, frame.translation).own.surface
        placed = dense._sampler.candidates(rays, surface, None)
    expected = expected_samples(surface.shell, rays, dense.config.sampler.step)
    assert 0.5 < expected / len(placed.samples) < 2
