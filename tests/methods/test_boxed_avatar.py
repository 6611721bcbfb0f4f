"""Rendering of the methods with boxes, against sample-by-sample loops."""

import itertools
import math
from dataclasses import replace

import pytest
import torch
from small_recipes import CASES

from twofold.body.skeleton import joint_transforms, shape_body
from twofold.geometry.cameras import pixel_grid, pixel_rays
from twofold.geometry.rotations import axis_angle_to_matrix
from twofold.methods.base import EVALUATION, Mode
from twofold.methods.boxed_avatar import density_level, root_pose
from twofold.methods.subject import Subject
from twofold.outputs.mesh import posed_surface
from twofold.training.loop import train
from twofold.training.pixels import PixelSource

BACKGROUND = torch.tensor([0.2, 0.9, 0.4])
NAMES = [name for name, recipe in CASES.items() if hasattr(recipe.method, "boxed")]


@pytest.fixture(scope="module")
def subject(person):
    return Subject.of(person)


def density_of(avatar):
    return getattr(avatar, "local", avatar).radiance.density


@pytest.fixture(scope="module", params=NAMES)
def avatar(request, subject):
    """With densities of a few tens per metre, so that rays are neither opaque at once nor clear."""
    avatar = CASES[request.param].method.build(subject, 0).eval()
    with torch.no_grad():
        density_of(avatar).layers[-1].bias += 8
    return avatar


@pytest.fixture
def posed(avatar, person):
    return avatar.pose(person.train[1].pose, person.train[1].translation)


@pytest.fixture(scope="module")
def rays(person):
    camera = person.train[1].camera.resized(12, 12)
    return pixel_rays(camera, pixel_grid(camera).flatten(0, 1)[40:110:9])


def shaded_one_by_one(avatar, posed, origin, direction, depths):
    """Density and colour at each depth of a ray; zero where nothing is reached."""
    own, found = posed.own, []
    for depth in depths:
        point = (origin + depth * direction)[None]
        coordinates = torch.stack(
            [
                (frame[:3, :3] @ point[0] + frame[:3, 3]) / size
                for frame, size in zip(own.to_frame, own.half_sizes, strict=True)
            ]
        )[None]
        reached = bool(avatar.reached(coordinates))
        if avatar.settings.max_distance is not None:
            vertices = posed.body.vertices @ own.to_root[:3, :3].T + own.to_root[:3, 3]
            reached &= bool((vertices - point).norm(dim=-1).min() <= avatar.settings.max_distance)
        if reached:
            at = avatar.radiance_at(point, coordinates, direction[None], own, None)
            found.append((float(at.density), at.color[0]))
        else:
            found.append((0.0, torch.zeros(3)))
    return found


def composited_one_by_one(depths, values):
    """NeRF's rule: colour, opacity and the weights of a ray, with the last interval open."""
    through, color, weights = 1.0, torch.zeros(3), []
    for i, (density, own) in enumerate(values):
        length = depths[i + 1] - depths[i] if i + 1 < len(depths) else 1e10
        alpha = 1 - math.exp(-density * length)
        weights.append(through * alpha)
        color = color + weights[-1] * own
        through *= 1 - alpha + 1e-10
    return color, sum(weights), weights


def importance_one_by_one(depths, weights, count):
    """Quantiles, evenly spaced, of a distribution that is constant between the middles of neighbouring depths."""
    middles = [(a + b) / 2 for a, b in itertools.pairwise(depths)]
    shares = [
        (max(weights[i - 1], weights[i]) + max(weights[i], weights[i + 1])) / 2 + 0.01
        for i in range(1, len(weights) - 1)
    ]
    chosen = []
    for k in range(count):
        left = k / (count - 1) * sum(shares)
        for i, share in enumerate(shares):
            if left <= share + 1e-9 or i == len(shares) - 1:
                chosen.append(middles[i] + min(left / share, 1) * (middles[i + 1] - middles[i]))
                break
            left -= share
    return chosen


@torch.no_grad()
def test_pixels_are_those_of_a_loop_over_samples(avatar, posed, rays):
    settings = avatar.settings
    found = avatar.render(rays, posed, BACKGROUND)
    bounded, hit = avatar.bounded(rays, posed.own)
    assert hit.any()
    for ray in range(len(rays)):
        if not hit[ray]:
            assert torch.equal(found.color[ray], BACKGROUND)
            continue
        origin, direction = bounded.origins[ray], bounded.directions[ray]
        near, far = float(bounded.near[ray]), float(bounded.far[ray])
        depths = [near + (far - near) * i / (settings.coarse - 1) for i in range(settings.coarse)]
        values = shaded_one_by_one(avatar, posed, origin, direction, depths)
        coarse, opacity, weights = composited_one_by_one(depths, values)
        fine = importance_one_by_one(depths, weights, settings.fine)
        values += shaded_one_by_one(avatar, posed, origin, direction, fine)
        order = sorted(range(len(values)), key=lambda i: (depths + fine)[i])
        color, full_opacity, _ = composited_one_by_one([(depths + fine)[i] for i in order], [values[i] for i in order])
        expected = coarse + (1 - opacity) * BACKGROUND
        torch.testing.assert_close(found.extras["coarse"][ray], expected, rtol=0, atol=2e-3)
        torch.testing.assert_close(found.color[ray], color + (1 - full_opacity) * BACKGROUND, rtol=0, atol=2e-3)
        assert float(found.opacity[ray]) == pytest.approx(full_opacity, abs=2e-3)


def test_the_root_stands_still_and_all_else_follows(person):
    joints = shape_body(person.body, person.betas).joints
    frame = person.train[3]
    to_root, transforms = root_pose(joints, frame.pose, frame.translation)
    torch.testing.assert_close(transforms[0], torch.eye(4), rtol=0, atol=1e-6)
    world = joint_transforms(joints, frame.pose, frame.translation)
    torch.testing.assert_close(to_root @ world, transforms, rtol=0, atol=1e-5)
    torch.testing.assert_close(to_root[:3, :3], axis_angle_to_matrix(frame.pose[0]).T, rtol=0, atol=1e-6)


def test_level_falls_where_density_rises_and_is_zero_at_the_surface():
    level = density_level(torch.tensor([0.0, 2.0, 4.0, 8.0, 1e6]), 4.0)
    assert (level.diff() <= 0).all()
    assert level[2] == 0
    assert level.abs().max() <= 0.03


def test_density_noise_is_added_in_training_only(avatar, posed, rays):
    with torch.no_grad():
        still, noisy = (
            avatar.render(rays, posed, BACKGROUND, mode, torch.Generator().manual_seed(0)).color
            for mode in (EVALUATION, Mode(3))
        )
        assert torch.equal(still, avatar.render(rays, posed, BACKGROUND).color)
    assert not torch.equal(still, noisy)


def test_training_frames_have_codes_and_other_poses_their_mean(avatar, person):
    frame = person.train[2]
    own = avatar.pose(frame.pose, frame.translation, frame.frame_index).own.code
    new = avatar.pose(frame.pose, frame.translation, 10_000).own.code
    assert torch.equal(own, avatar.codes[2])
    torch.testing.assert_close(new, avatar.codes.mean(0))


def test_backgrounds_in_training_are_one_colour_a_ray(avatar):
    capture = torch.tensor([0.1, 0.2, 0.3])
    noise = avatar.background(capture, 50, torch.Generator().manual_seed(0))
    assert noise.shape == (50, 3)
    assert noise.std(0).min() > 0.2
    avatar.settings, before = replace(avatar.settings, background="capture"), avatar.settings
    assert torch.equal(avatar.background(capture, 50, torch.Generator()), capture)
    avatar.settings = before


def test_losses_are_absolute_differences_of_both_images(avatar, posed, rays, person):
    pixels = replace(CASES["pm_avatar"].training.pixels, rays=8)
    batch = PixelSource(person.train, person.body, person.betas, pixels).draw(1, torch.Generator().manual_seed(0))
    batch = batch.against(torch.rand(8, 3, generator=torch.Generator().manual_seed(1)))
    mode, generator = Mode(0), torch.Generator().manual_seed(0)
    rendering = avatar.render(batch.rays, posed, batch.background, mode, generator)
    terms = avatar.losses(rendering, batch, posed, mode, generator)
    truth = [batch.image[i] * batch.mask[i] + batch.background[i] * (1 - batch.mask[i]) for i in range(8)]
    for name, color in (("reconstruction", rendering.color), ("coarse", rendering.extras["coarse"])):
        expected = sum(float((color[i] - truth[i]).abs().sum().detach()) for i in range(8)) / 24
        assert float(terms[name].detach()) == pytest.approx(expected, rel=1e-5)


def test_points_away_from_the_body_are_empty_where_a_distance_is_set(subject, person):
    method = CASES["pm_avatar"].method
    near = replace(method, boxed=replace(method.boxed, max_distance=0.05)).build(subject, 0).eval()
    with torch.no_grad():
        near.radiance.density.layers[-1].bias += 30
        posed = near.pose(person.train[0].pose, person.train[0].translation)
        points = posed.body.vertices.mean(0) + torch.rand(400, 3, generator=torch.Generator().manual_seed(0)) - 0.5
        level = near.level(points, posed)
    away = torch.cdist(points, posed.body.vertices).amin(1)
    assert (level[away > 0.05] > 0).all()
    assert (level[away < 0.05] < 0).any()


def test_a_surface_comes_out_near_the_body(avatar, person):
    posed = avatar.pose(person.train[1].pose, person.train[1].translation)
    with torch.no_grad():
        density_of(avatar).layers[-1].bias += 30
        vertices, faces = posed_surface(avatar, posed, voxel=0.05)
        density_of(avatar).layers[-1].bias -= 30
    assert len(faces) > 100
    assert torch.cdist(vertices, posed.body.vertices).amin(1).max() < 0.3


@pytest.mark.parametrize("name", ["pm_avatar_fast", "danbo_fast"])
def test_an_interrupted_training_ends_with_the_same_numbers(name, person, tmp_path):
    start = CASES[name]
    training = replace(start.training, steps=4, checkpoint_every=2, preview_every=0, warmup=0)
    recipe = replace(start, training=training)
    whole = train(person, recipe, tmp_path / "whole", torch.device("cpu"))

    def stop(progress):
        if progress.step == 3:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        train(person, recipe, tmp_path / "parts", torch.device("cpu"), progress=stop)
    parts = train(person, recipe, tmp_path / "parts", torch.device("cpu"), resume=True)
    for key, tensor in whole.state_dict().items():
        assert torch.equal(tensor, parts.state_dict()[key]), key
