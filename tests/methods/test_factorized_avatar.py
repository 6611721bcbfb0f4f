import math
from dataclasses import replace

import pytest
import torch
from small_recipes import CASES, LATE

from twofold.geometry.cameras import pixel_grid, pixel_rays
from twofold.methods.base import EVALUATION, Mode
from twofold.methods.subject import Subject
from twofold.metrics.perceptual import LPIPS
from twofold.outputs.views import render_image
from twofold.sampling.error_bounded import ErrorBoundedSampler
from twofold.sampling.shell_sampler import ShellSampler
from twofold.training.pixels import PixelSource
from twofold.training.run import load
from twofold.volume.rendering import laplace_density

QUICK, RELEASED = CASES["quick"].method, CASES["released"].method
BLACK = torch.zeros(3)


@pytest.fixture(scope="module")
def subject(person):
    return Subject.of(person)


def pose_of(avatar, person, which=1, time=None, step=None):
    frame = person.train[which]
    return avatar.pose(frame.pose, frame.translation, time, EVALUATION if step is None else Mode(step, step // 5))


def rays_of(person, size=10):
    camera = person.train[1].camera.resized(size, size)
    return pixel_rays(camera, pixel_grid(camera).flatten(0, 1))


@pytest.mark.parametrize("form", ["softplus", "absolute"])
@pytest.mark.parametrize("beta", [0.002, 0.01, 0.1, 1.0])
def test_density_scale_starts_as_configured(subject, form, beta):
    avatar = replace(QUICK, beta=beta, beta_floor=1e-4, beta_form=form).build(subject)
    assert float(avatar.beta.detach()) == pytest.approx(beta, rel=1e-5)


@pytest.mark.parametrize("form", ["softplus", "absolute"])
def test_density_scale_never_falls_below_its_floor(subject, form):
    avatar = replace(QUICK, beta=0.01, beta_floor=1e-3, beta_form=form).build(subject)
    for raw in (-10.0, -0.1, 0.0, 0.1):
        with torch.no_grad():
            avatar.raw_beta.fill_(raw)
        assert float(avatar.beta.detach()) >= 0.999e-3


@pytest.mark.parametrize(("epochs", "length"), [("moments", 5), ("training", 3)])
def test_epochs_of_the_zero_pose_are_frames_or_those_of_the_training(subject, person, epochs, length):
    pose = replace(QUICK.pose, epochs=epochs, zero_until=10, zero_every=3, drop=0.0)
    avatar = replace(QUICK, pose=pose).build(subject)
    frame = person.train[1]
    modes = [Mode(step, step // 3) for step in range(35)]
    conditions = [avatar.pose(frame.pose, frame.translation, mode=mode).own.condition for mode in modes]
    shown = [bool(condition.any()) for condition in conditions]
    assert shown == [step >= 10 and step // length % 3 != 0 for step in range(35)]


def test_poses_are_corrected_from_the_given_step_on_and_only_in_training_frames(subject, person):
    avatar = replace(QUICK, pose=replace(QUICK.pose, refine_from=5)).build(subject)
    with torch.no_grad():
        avatar.refinement.translation[1] = torch.tensor([0.1, 0.0, 0.0])
    plain, time = pose_of(avatar, person), person.train[1].frame_index
    moved = pose_of(avatar, person, time=time, step=5)
    torch.testing.assert_close(moved.body.joints - plain.body.joints, torch.tensor([0.1, 0, 0]).expand(24, 3))
    assert moved.own.surface.forward.requires_grad
    assert not pose_of(avatar, person, time=time, step=4).own.surface.forward.requires_grad
    assert torch.equal(pose_of(avatar, person, time=1234).body.joints, plain.body.joints)


@pytest.mark.parametrize("parts", [(), ("root",), ("body", "shape"), ("root", "body", "translation", "shape")])
def test_only_the_parts_to_be_refined_learn(subject, person, parts):
    avatar = replace(QUICK, pose=replace(QUICK.pose, refine=parts)).build(subject)
    group = next(g.parameters for g in avatar.parameter_groups() if g.name == "pose")
    assert {id(p) for p in group} == {id(getattr(avatar.refinement, part)) for part in parts}
    posed = pose_of(avatar, person, time=1, step=LATE)
    assert posed.own.surface.forward.requires_grad == bool(parts)


def test_shells_follow_corrections_only_at_a_refresh_and_then_with_the_shape(subject, person):
    avatar = replace(QUICK, shell_refresh=10).build(subject)
    time = person.train[1].frame_index
    before = pose_of(avatar, person, time=time, step=8).own.surface.shell
    with torch.no_grad():
        avatar.refinement.translation += 0.2
        avatar.refinement.shape += 1.0
    avatar.before_step(Mode(9))
    assert pose_of(avatar, person, time=time, step=9).own.surface.shell is before
    # A resumed run builds the shell anew from what is stored, and must get the same one.
    resumed = replace(QUICK, shell_refresh=10).build(subject, 1)
    resumed.load_state_dict(avatar.state_dict())
    assert torch.equal(pose_of(resumed, person, time=time, step=9).own.surface.shell.vertices, before.vertices)
    avatar.before_step(Mode(10))
    after = pose_of(avatar, person, time=time, step=10)
    torch.testing.assert_close(after.own.surface.shell.vertices, after.body.vertices.detach(), rtol=0, atol=1e-6)


def test_shells_are_built_anew_only_for_bodies_that_left_their_margin(subject, person):
    avatar = replace(QUICK, shell_refresh=10).build(subject)
    near, far = person.train[1].frame_index, person.train[2].frame_index
    before = [pose_of(avatar, person, time=time, step=8).own.surface.shell for time in (near, far)]
    with torch.no_grad():
        avatar.refinement.translation[avatar.refinement.rows[near]] = torch.tensor([0.0024, 0, 0])
        avatar.refinement.translation[avatar.refinement.rows[far]] = torch.tensor([0.0026, 0, 0])
    avatar.before_step(Mode(10))
    after = [pose_of(avatar, person, time=time, step=10) for time in (near, far)]
    assert after[0].own.surface.shell is before[0]
    assert after[1].own.surface.shell is not before[1]
    # Samples are measured against the body as it is now, whatever its shell was built from.
    frame = person.train[1]
    rays = pixel_rays(frame.camera, pixel_grid(frame.camera).flatten(0, 1))
    placed = avatar._sampler.candidates(rays, after[0].own.surface, None)
    away = torch.cdist(placed.samples.points(rays), after[0].body.vertices.detach()).amin(1)
    assert 0.055 < float(away.max()) < 0.0601
    resumed = replace(QUICK, shell_refresh=10).build(subject, 1)
    resumed.load_state_dict(avatar.state_dict())
    for time, posed in zip((near, far), after, strict=True):
        again = pose_of(resumed, person, time=time, step=11).own.surface.shell
        assert torch.equal(again.nearest, posed.own.surface.shell.nearest)


def trained_with(trained, **options):
    """The trained tiny avatar with other options of its method."""
    avatar, _ = load(trained.folder)
    other = replace(avatar.config, **options).build(avatar.subject).eval()
    other.load_state_dict(avatar.state_dict())
    return other


def images(avatar, person):
    frame = person.splits["novel_view"][0]
    return render_image(avatar, avatar.pose(frame.pose, frame.translation), frame.camera.resized(32, 32), BLACK)


def test_error_bounded_and_shell_sampler_draw_the_same_image(trained, person):
    """Within one step of 8 bits on average and twelve at any pixel, where both end at the same distance."""
    # At the shell's rim lists of vertices decide what is a sample; the avatar's surface reaches it in one pixel.
    shell = ShellSampler(radius=0.06, step=0.004, voxel=0.03, min_weight=0.0)
    bounded = ErrorBoundedSampler(ends="ray")
    first, second = (
        images(trained_with(trained, sampler=s, outlier_distance=shell.radius), person) for s in (shell, bounded)
    )
    difference = (first.color - second.color).abs()
    assert first.opacity.mean() > 0.1
    assert difference.mean() < 1 / 255
    assert difference.max() < 12 / 255


def test_samples_left_out_for_their_small_weight_are_not_missed(trained, person):
    sampler = trained_with(trained).config.sampler
    all_, some = (
        images(trained_with(trained, sampler=replace(sampler, min_weight=least)), person) for least in (0.0, 1e-3)
    )
    assert (all_.color - some.color).abs().max() < 0.02


@pytest.mark.parametrize("neighbours", [2, 7])
def test_weights_of_several_neighbours_draw_nearly_the_same(trained, person, neighbours):
    one, several = (images(trained_with(trained, neighbours=k), person) for k in (1, neighbours))
    difference = (one.color - several.color).abs()
    assert 0 < difference.mean() < 0.03


def test_both_samplers_take_several_neighbours(subject, person):
    avatar = replace(RELEASED, neighbours=3).build(subject).eval()
    with torch.no_grad():
        found = avatar.render(rays_of(person, 4), pose_of(avatar, person), BLACK)
    assert found.color.isfinite().all()


def test_outliers_are_empty_in_shading_only_where_asked(subject, person):
    """As released they are forgotten there: what lies far from the body then shows."""
    opacity = {}
    for choice in (True, False):
        avatar = replace(RELEASED, outliers_in_shading=choice, outlier_distance=0.02).build(subject).eval()
        with torch.no_grad():
            opacity[choice] = avatar.render(rays_of(person), pose_of(avatar, person), BLACK).opacity.mean()
    assert opacity[True] < 0.8 * opacity[False]


def test_released_scene_units_thin_or_thicken_the_density(subject, person):
    metres, scene = (replace(RELEASED, scene_scale=units).build(subject).eval() for units in ("metres", "released"))
    assert metres.scale == 1
    assert scene.scale == subject.scene_scale > 1
    with torch.no_grad():
        thin, thick = (a.render(rays_of(person), pose_of(a, person), BLACK).opacity.mean() for a in (metres, scene))
    assert thin < thick


def test_one_sample_composites_as_the_formula_says(subject, person):
    """Opacity of the shell sampler's ray by a plain loop over its samples."""
    avatar = replace(QUICK, sampler=replace(QUICK.sampler, min_weight=0.0)).build(subject).eval()
    rays, posed = rays_of(person), pose_of(avatar, person)
    with torch.no_grad():
        found = avatar.render(rays, posed, BLACK)
        placed = avatar.place(rays, posed, EVALUATION, None)
        samples, nearest = placed.samples, placed.nearest
        which = int(torch.bincount(samples.ray_index).argmax())
        own = samples.ray_index == which
        forward = posed.own.surface.forward[nearest[own, 0]]
        moved = samples.points(rays)[own]
        home = torch.stack([torch.linalg.solve(f[:, :3], x - f[:, 3]) for f, x in zip(forward, moved, strict=True)])
        density = laplace_density(avatar.field.sdf(home, posed.own.condition), avatar.beta)
    light = 1.0
    for sigma, delta in zip(density.tolist(), samples.delta[own].tolist(), strict=True):
        light *= math.exp(-sigma * delta)
    assert 1 - light > 0.05
    assert float(found.opacity[which]) == pytest.approx(1 - light, abs=2e-4)


def losses_of(recipe, avatar, person, step):
    source = PixelSource(person.train, person.body, person.betas, recipe.training.pixels)
    generator = torch.Generator().manual_seed(0)
    frame, batch = person.train[1], source.draw(1, generator)
    batch, mode = batch.against(torch.tensor(person.background)), Mode(step, step // 5)
    posed = avatar.pose(frame.pose, frame.translation, frame.frame_index, mode)
    rendering = avatar.render(batch.rays, posed, batch.background, mode, generator)
    return avatar.losses(rendering, batch, posed, mode, generator)


def test_perceptual_network_is_used_from_its_step_on_and_is_no_part_of_the_avatar(subject, person):
    recipe = CASES["fast"]
    avatar = recipe.method.build(subject)
    before = list(avatar.state_dict())
    assert "lpips" not in losses_of(recipe, avatar, person, LATE)
    network = LPIPS(((4,), (8,)))
    for parameter in network.parameters():
        torch.nn.init.uniform_(parameter, 0.1, 0.2)
    avatar.attach_perceptual(network)
    assert list(avatar.state_dict()) == before
    assert "lpips" not in losses_of(recipe, avatar, person, recipe.method.losses.lpips_start - 1)
    terms = losses_of(recipe, avatar, person, recipe.method.losses.lpips_start)
    assert terms["lpips"] > 0
    terms["lpips"].backward()
    assert any(p.grad is not None and p.grad.any() for p in avatar.field.parameters())


def test_a_term_without_weight_is_left_out_and_others_count_by_theirs(subject, person):
    recipe = CASES["fast"]
    avatar = recipe.method.build(subject)
    whole = losses_of(recipe, avatar, person, 5)
    assert set(whole) == {"reconstruction", "common", "eikonal", "mask", "s3im"}
    avatar.config = replace(avatar.config, losses=replace(avatar.config.losses, mask=0.0, common=2.0, eikonal=0.0))
    less = losses_of(recipe, avatar, person, 5)
    assert set(less) == {"reconstruction", "common", "s3im"}
    assert less["common"].item() == pytest.approx(4 * whole["common"].item())


def test_eikonal_points_lie_around_the_canonical_body(subject, person, monkeypatch):
    avatar = QUICK.build(subject)
    seen = []
    original = avatar.field.distance_and_gradient
    monkeypatch.setattr(avatar.field, "distance_and_gradient", lambda x, pose: (seen.append(x), original(x, pose))[1])
    losses_of(CASES["quick"], avatar, person, 5)
    distance = torch.cdist(seen[0], avatar.canonical_points).amin(1)
    assert len(seen[0]) == QUICK.losses.eikonal_points
    assert distance.max() < 6 * QUICK.losses.eikonal_spread
    assert distance.max() > 0.5 * QUICK.losses.eikonal_spread
