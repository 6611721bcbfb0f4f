"""MonoHuman's own parts, held against the equations written as loops; recipes; resumption with key frames."""

import itertools
import math
from dataclasses import replace

import pytest
import torch
from small_recipes import CASES
from torch.nn import functional as F

from twofold.body.skeleton import PARENTS, joint_transforms
from twofold.deform.weight_volume import SkeletalPoints
from twofold.errors import TwofoldError
from twofold.geometry.cameras import project
from twofold.methods.base import Mode
from twofold.methods.key_frames import named_frames
from twofold.methods.monohuman import MonoHumanConfig, monohuman
from twofold.methods.subject import Subject
from twofold.methods.table import recipe_from_dict, recipe_to_dict
from twofold.training.loop import train
from twofold.training.pixels import PixelSource
from twofold.training.run import load, read_checkpoint

RECIPE = CASES["monohuman"]
STEP = 30_000


@pytest.fixture(scope="module")
def avatar(person):
    avatar = replace(RECIPE.method, key_frames=(0, 3)).build(Subject.of(person), 0)
    avatar.prepare_training(person, 0, torch.Generator())
    generator = torch.Generator().manual_seed(1)
    with torch.no_grad():
        for motion in avatar.motions:
            last = motion.network.layers[-1].weight
            last.copy_(0.02 * torch.randn(last.shape, generator=generator))
    avatar.trained_step.fill_(STEP)
    return avatar.eval()


@pytest.fixture(scope="module")
def points(avatar):
    generator = torch.Generator().manual_seed(2)
    joints = avatar.rest_joints[torch.randint(24, (40,), generator=generator)]
    return joints + 0.05 * torch.randn(joints.shape, generator=generator)


def bones_to_world(avatar, frame):
    return joint_transforms(avatar.rest_joints, frame.pose, frame.translation)


def looked_up(avatar, volume, x):
    """All bones' weights at one T-pose point, by the eight vertices around it."""
    joints, size = avatar.rest_joints, volume.shape[-1] - 1
    low, high = joints.amin(0) - 0.3, joints.amax(0) + 0.3
    place = (x - low) / (high - low) * size
    corner = place.floor().long()
    found = torch.zeros(24)
    for step in itertools.product((0, 1), repeat=3):
        index = corner + torch.tensor(step)
        if (index < 0).any() or (index > size).any():
            continue
        share = torch.where(torch.tensor(step) == 1, place - corner, 1 - (place - corner)).prod()
        found += share * volume[:24, index[2], index[1], index[0]]
    return found


def sent(avatar, volume, x, frame, bands):
    """A T-pose point in a frame's world by forward skinning and F, point by point."""
    weights = looked_up(avatar, volume, x)
    moves = bones_to_world(avatar, frame)
    # F works where the root is not turned.
    root = moves[0]
    total = sum(
        w * (torch.linalg.inv(root) @ m @ torch.cat([x, torch.ones(1)]))[:3]
        for w, m in zip(weights, moves, strict=True)
    )
    aligned = total / max(float(weights.sum()), 1e-4)
    moved = avatar.forward_motion(aligned[None], torch.zeros(69), bands)[0]
    return (root @ torch.cat([moved, torch.ones(1)]))[:3]


@pytest.mark.slow
def test_radiance_is_the_equations_point_by_point(avatar, person, points):
    frame, keys = person.train[1], named_frames(person, (0, 3))
    posed = avatar.pose(frame.pose, frame.translation, frame.frame_index, Mode(STEP))
    bands = 6 * (STEP - 5000) / 45_000
    moved = SkeletalPoints(torch.arange(len(points)), points, torch.linspace(0, 1, len(points)))
    with torch.no_grad():
        answer, extras = avatar.radiance(moved, points + 0.1, posed, Mode(STEP))
        volume, maps = avatar.volume(), avatar.features(avatar.key_images.float() / 255)
        theta = frame.pose[1:].flatten() + 0.01
        returned = []
        for index, point in enumerate(points):
            x = avatar.backward_motion(point[None], theta, bands)[0]
            columns = []
            for view, key in enumerate(keys):
                world = sent(avatar, volume, x, key, bands)
                pixel = project(key.camera, world[None])[0][0]
                grid = (2 * pixel / torch.tensor([63.0, 63.0]) - 1)[None, None, None]
                seen = [
                    F.grid_sample(source[view : view + 1], grid, align_corners=True)[0, :, 0, 0]
                    for source in (avatar.key_images.float() / 255, maps)
                ]
                columns.append(torch.cat(seen))
            scores = [avatar.blending.weight(torch.cat([c, torch.zeros(1)])) for c in columns]
            shares = torch.cat(scores).softmax(0)
            blended = shares[0] * columns[0] + shares[1] * columns[1]
            best, parent = math.inf, 0
            for child in range(1, 24):
                start, end = avatar.rest_joints[PARENTS[child]], avatar.rest_joints[child]
                along = end - start
                t = float(((x - start) @ along / (along @ along)).clamp(0, 1))
                away = float((start + t * along - x).norm())
                if away < best:
                    best, parent = away, PARENTS[child]
            expected = avatar.field(x[None], (x - avatar.rest_joints[parent])[None], blended[None])
            torch.testing.assert_close(answer.color[index], expected.color[0], rtol=0, atol=2e-4)
            torch.testing.assert_close(answer.density[index], expected.density[0], rtol=1e-3, atol=1e-3)
            if moved.likelihood[index] > 0.3:
                root = bones_to_world(avatar, frame)[0]
                back = torch.cat([sent(avatar, volume, x, frame, bands), torch.ones(1)])
                returned.append((torch.linalg.inv(root) @ back)[:3])
    torch.testing.assert_close(extras["returned"], torch.stack(returned), rtol=0, atol=1e-4)
    assert torch.equal(extras["observed"], (points + 0.1)[moved.likelihood > 0.3])


def test_motion_sees_the_pose_from_the_first_step(avatar, person):
    frame = person.train[1]
    own = avatar.pose(frame.pose, frame.translation, frame.frame_index, Mode(0)).own
    assert own.condition.any()
    assert own.open_bands == 0


def test_features_learn_at_every_so_many_steps(person):
    avatar = replace(RECIPE.method, features_every=3).build(Subject.of(person), 0)
    frame = person.train[1]
    learns = [avatar.pose(frame.pose, frame.translation, None, Mode(s)).own.maps.requires_grad for s in range(4)]
    assert learns == [True, False, False, True]


def test_recipe_has_the_authors_numbers():
    recipe = monohuman()
    training, method = recipe.training, recipe.method
    assert (training.steps, training.pixels.patches, training.pixels.patch_size) == (400_000, 12, 16)
    assert (training.pixels.rays, training.pixels.patch_on_subject) == (0, 0.9)
    rates, skeletal = method.rates, method.skeletal
    assert (rates.networks, rates.volume, rates.motion, rates.pose) == (5e-4, 5e-6, 5e-5, 5e-5)
    assert (skeletal.motion_from, skeletal.motion_full, skeletal.correct_poses) == (5000, 50_000, False)
    assert (skeletal.lpips, skeletal.squared_error, method.consistency) == (1.0, 0.2, 1.0)
    assert recipe_from_dict(recipe_to_dict(recipe), "recipe.json") == recipe


def test_one_key_frame_is_refused():
    with pytest.raises(ValueError, match="key_frames should be two frame indices or none"):
        MonoHumanConfig(key_frames=(3,))


@pytest.mark.slow
def test_parameters_are_as_many_as_the_authors(person):
    avatar = monohuman().method.build(Subject.of(person), 0)
    assert sum(p.numel() for p in avatar.parameters()) == 73_676_456


def small(**changed):
    start = CASES["monohuman_fast"]
    skeletal = replace(start.method.skeletal, motion_from=1, motion_full=5, volume_every=3, guard_steps=(2,))
    training = replace(start.training, steps=6, checkpoint_every=4, preview_every=0)
    return replace(start, method=replace(start.method, skeletal=skeletal, **changed), training=training)


@pytest.mark.slow
def test_interrupted_training_resumes_to_the_same_numbers_with_its_key_frames(person, tmp_path):
    cpu = torch.device("cpu")
    train(person, small(), tmp_path / "whole", cpu)

    def interrupt(progress):
        if progress.step == 5:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        train(person, small(), tmp_path / "parts", cpu, progress=interrupt)
    train(person, small(), tmp_path / "parts", cpu, resume=True)
    whole, parts = (read_checkpoint(tmp_path / name)[0] for name in ("whole", "parts"))
    assert whole["avatar.key_images"].any()
    assert all(torch.equal(whole[name], parts[name]) for name in whole)
    assert torch.equal(load(tmp_path / "whole")[0].key_images, whole["avatar.key_images"])


def test_images_have_a_say_in_the_weight_volume_of_the_fast_recipe(person):
    recipe, cpu = CASES["monohuman_fast"], torch.device("cpu")
    avatar = recipe.method.build(Subject.of(person), 0).train()
    avatar.prepare_training(person, 0, torch.Generator())
    mode = Mode(step=0)
    avatar.before_step(mode)
    config = replace(recipe.training.pixels, rays=600)
    source = PixelSource(person.train, avatar.subject.body, avatar.subject.betas, config, avatar.ray_margin)
    squared = dict.fromkeys(("reconstruction", "consistency"), 0.0)
    for row, frame in enumerate(person.train):
        generator = torch.Generator().manual_seed(row)
        batch = source.draw(row, generator, cpu)
        batch = batch.against(avatar.background(torch.zeros(3), len(batch.rays), generator))
        posed = avatar.pose(frame.pose, frame.translation, frame.frame_index, mode)
        rendering = avatar.render(batch.rays, posed, batch.background, mode, generator)
        terms = avatar.losses(rendering, batch, posed, mode, generator)
        last = avatar.volume.upsampling[-1].taps
        for name in squared:
            (gradient,) = torch.autograd.grad(terms[name], last, retain_graph=True)
            squared[name] += float(gradient.square().sum())
    # Norms of one size: Adam follows whichever is the larger.
    assert 0 < squared["consistency"] < 10**2 * squared["reconstruction"]


def test_training_names_key_frames_that_do_not_exist(person, tmp_path):
    with pytest.raises(TwofoldError, match="key_frames names frame 99"):
        train(person, small(key_frames=(0, 99)), tmp_path / "run", torch.device("cpu"))
    assert not (tmp_path / "run").exists()
