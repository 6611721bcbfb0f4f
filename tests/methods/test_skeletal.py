"""What HumanNeRF and MonoHuman share, held against loops over rays, samples and bones as the equations are written."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.ndimage import map_coordinates
from scipy.spatial.transform import Rotation
from small_recipes import CASES

from twofold.body.skeleton import PARENTS
from twofold.capture.types import Frame
from twofold.geometry.cameras import pixel_grid, pixel_rays
from twofold.losses import total
from twofold.methods.base import EVALUATION, Mode
from twofold.methods.subject import Subject
from twofold.metrics.perceptual import LPIPS
from twofold.outputs.mesh import posed_surface
from twofold.training.pixels import PixelSource

RECIPE, FAST = CASES["humannerf"], CASES["humannerf_fast"]
BACKGROUND = torch.tensor([0.2, 0.9, 0.4])
GONE = 20_000
"""A step at which the non-rigid motion sees pose and place."""


@pytest.fixture(scope="module")
def subject(person):
    return Subject.of(person)


def built(recipe, subject, density=20.0, **changed):
    """An avatar whose networks, volume and motion all do something."""
    method = replace(recipe.method, skeletal=replace(recipe.method.skeletal, **changed))
    avatar = method.build(subject, 0)
    generator = torch.Generator().manual_seed(5)
    with torch.no_grad():
        avatar.canonical.network.layers[-1].bias[3] += density
        for network, size in ((avatar.motion.network, 0.02), (avatar.correction.network, 0.03)):
            last = network.layers[-1].weight
            last.copy_(size * torch.randn(last.shape, generator=generator))
    avatar.trained_step.fill_(GONE)
    return avatar.eval()


@pytest.fixture(scope="module")
def avatar(subject):
    return built(RECIPE, subject)


def rays_of(frame: Frame, size: int):
    camera = frame.camera.resized(size, size)
    return pixel_rays(camera, pixel_grid(camera).flatten(0, 1))


def turn(axis_angle) -> np.ndarray:
    return Rotation.from_rotvec(np.asarray(axis_angle, dtype=np.float64)).as_matrix()


def corrected(axis_angle) -> np.ndarray:
    """Rodrigues with the angle sqrt(1e-5 + r^2)."""
    angle = math.sqrt(1e-5 + float(np.square(axis_angle).sum()))
    x, y, z = np.asarray(axis_angle) / angle
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + math.sin(angle) * cross + (1 - math.cos(angle)) * cross @ cross


def global_transforms(rotations, joints) -> list[np.ndarray]:
    """G_i: of each joint's frame, the root at its rest place."""
    found: list[np.ndarray] = []
    for joint in range(24):
        local = np.eye(4)
        local[:3, :3] = rotations[joint]
        parent = PARENTS[joint]
        local[:3, 3] = joints[joint] - (joints[parent] if parent >= 0 else 0)
        found.append(local if parent < 0 else found[parent] @ local)
    return found


def reference(avatar, frame: Frame, ray) -> tuple[np.ndarray, float]:
    """Colour and opacity of one ray by loops."""
    origin, direction = ray
    joints = avatar.rest_joints.double().numpy()
    pose, translation = frame.pose.double().numpy(), frame.translation.double().numpy()
    # The root's turn and place go into the camera.
    root = turn(pose[0])
    origin = root.T @ (origin - translation - joints[0]) + joints[0]
    direction = root.T @ direction
    theta = (pose[1:].flatten() + 0.01).astype(np.float32)
    with torch.no_grad():
        corrections = avatar.correction.network(torch.from_numpy(theta)[None])[0].reshape(23, 3).double().numpy()
    given = [np.eye(3)] + [turn(p) for p in pose[1:]]
    right = [np.eye(3)] + [turn(p) @ corrected(c) for p, c in zip(pose[1:], corrections, strict=True)]
    # The box of the joints as given.
    placed = np.array([g[:3, 3] for g in global_transforms(given, joints)])
    margin = 0.3 + 0.01 / avatar.subject.scene_scale
    low, high = placed.min(0) - margin, placed.max(0) + margin
    safe = np.where(np.abs(direction) < 1e-5, 1e-5, direction)
    hits = []
    for axis in range(3):
        for plane in (low[axis], high[axis]):
            t = (plane - origin[axis]) / safe[axis]
            where = origin + t * safe
            if (where >= low - 1e-6).all() and (where <= high + 1e-6).all():
                hits.append(t)
    background = BACKGROUND.numpy()
    if len(hits) != 2:
        return background, 0.0
    near, far = sorted(hits)
    count = avatar.settings.samples
    depths = [near + (far - near) * i / (count - 1) for i in range(count)]
    canonical, posed = global_transforms([np.eye(3)] * 24, joints), global_transforms(right, joints)
    moves = [c @ np.linalg.inv(g) for c, g in zip(canonical, posed, strict=True)]
    with torch.no_grad():
        volume = avatar.volume().double().numpy()
    size = volume.shape[1] - 1
    box_low, box_high = joints.min(0) - 0.3, joints.max(0) + 0.3
    color, through = np.zeros(3), 1.0
    for index, t in enumerate(depths):
        x = np.append(origin + t * direction, 1.0)
        weighted, likelihood = np.zeros(3), 0.0
        for bone in range(24):
            at = (moves[bone] @ x)[:3]
            place = (at - box_low) / (box_high - box_low) * size
            w = map_coordinates(volume[bone], place[::-1, None], order=1, mode="grid-constant")[0]
            weighted, likelihood = weighted + w * at, likelihood + w
        skeletal = torch.from_numpy(weighted / max(likelihood, 1e-4)).float()[None]
        bands = (
            6 * max(GONE - avatar.settings.motion_from, 0) / (avatar.settings.motion_full - avatar.settings.motion_from)
        )
        with torch.no_grad():
            moved = avatar.motion(skeletal, torch.from_numpy(theta), bands)
            answer = avatar.canonical(moved)
        delta = depths[index + 1] - t if index < count - 1 else 1e10
        alpha = (1 - math.exp(-float(answer.density) * delta)) * likelihood
        color += through * alpha * answer.color[0].double().numpy()
        through *= 1 - alpha + 1e-10
    return color + through * background, 1 - through


@pytest.mark.slow
def test_render_is_the_equations_sample_by_sample(avatar, person):
    frame = person.train[1]
    rays = rays_of(frame, 7)
    with torch.no_grad():
        found = avatar.render(rays, avatar.pose(frame.pose, frame.translation), BACKGROUND)
    expected = [
        reference(avatar, frame, (o.double().numpy(), d.double().numpy()))
        for o, d in zip(rays.origins, rays.directions, strict=True)
    ]
    colors = torch.tensor(np.array([color for color, _ in expected])).float()
    assert found.opacity.max() > 0.2
    torch.testing.assert_close(found.color, colors, rtol=0, atol=1e-4)
    torch.testing.assert_close(found.opacity, torch.tensor([o for _, o in expected]).float(), rtol=0, atol=1e-4)


def test_unlikely_samples_may_be_left_out(subject, person):
    frame, rays = person.train[1], rays_of(person.train[1], 12)
    images = []
    for threshold in (None, 1e-4, 2e-2):
        avatar = built(RECIPE, subject, min_likelihood=threshold)
        with torch.no_grad():
            images.append(avatar.render(rays, avatar.pose(frame.pose, frame.translation), BACKGROUND).color)
    assert (images[1] - images[0]).abs().max() < 2e-3
    assert (images[2] - images[0]).abs().mean() < 5e-3


def test_samples_that_cannot_be_seen_may_be_left_out_with_the_same_gradients(subject, person):
    frame, rays = person.train[1], rays_of(person.train[1], 12)
    images, gradients, shaded = [], [], []
    for min_weight in (0.0, 1e-4, 2e-3):
        # Denser than people are trained to be, so that there is much to hide.
        avatar = built(RECIPE, subject, density=200.0, min_likelihood=1e-3, min_weight=min_weight)
        queried = []
        avatar.canonical.register_forward_hook(
            lambda module, arguments, answer, queried=queried: queried.append(answer.density) and None
        )
        color = avatar.render(rays, avatar.pose(frame.pose, frame.translation, None, Mode(GONE)), BACKGROUND).color
        color.square().mean().backward()
        images.append(color.detach())
        gradients.append(torch.cat([p.grad.flatten() for p in avatar.canonical.parameters()]))
        shaded.append(sum(len(density) for density in queried if density.requires_grad))
    assert shaded[0] > shaded[1] > shaded[2] > 0
    for kept, image, gradient in ((1, 2e-4, 2e-4), (2, 1e-2, 1e-2)):
        assert (images[kept] - images[0]).abs().max() < image
        assert (gradients[kept] - gradients[0]).norm() < gradient * gradients[0].norm()


@pytest.mark.parametrize("changed", [{}, {"min_likelihood": 0.02, "min_weight": 1e-3}])
def test_density_in_another_unit_is_the_same_avatar(changed, subject, person):
    """Outputs that are a twentieth, in a unit of twenty a metre: images and level do not change."""
    plain, other = built(RECIPE, subject, **changed), built(RECIPE, subject, density_unit=20.0, **changed)
    with torch.no_grad():
        last = other.canonical.network.layers[-1]
        last.weight[3] /= 20
        last.bias[3] /= 20
        frame = person.train[1]
        rays = rays_of(frame, 10)
        one, two = (a.render(rays, a.pose(frame.pose, frame.translation), BACKGROUND) for a in (plain, other))
        points = plain.pose(frame.pose, frame.translation).body.vertices[::40]
        levels = [a.level(points, a.pose(frame.pose, frame.translation)) for a in (plain, other)]
    assert one.opacity.max() > 0.5
    torch.testing.assert_close(two.color, one.color, rtol=0, atol=1e-5)
    torch.testing.assert_close(levels[1], levels[0], rtol=0, atol=1e-5)


def test_losses_are_means_over_patch_images_and_single_rays(avatar, person):
    pixels = replace(RECIPE.training.pixels, rays=5, patches=2, patch_size=16)
    batch = PixelSource(person.train, person.body, person.betas, pixels).draw(0, torch.Generator().manual_seed(0))
    batch = batch.against(BACKGROUND)
    frame = person.train[0]
    posed = avatar.pose(frame.pose, frame.translation, frame.frame_index, Mode(GONE))
    with torch.no_grad():
        rendering = avatar.render(batch.rays, posed, batch.background, Mode(GONE), torch.Generator().manual_seed(0))
    errors = [float(e) for e in (rendering.color - batch.color)[:5].square().flatten()]
    for patch in batch.patch_pixels:
        for ray in patch.flatten().tolist():
            difference = rendering.color[ray] - batch.color[ray] if ray >= 0 else torch.zeros(3)
            errors += difference.square().tolist()

    class Network(LPIPS):
        def forward(self, shown, truth):
            outside = (batch.patch_pixels < 0)[:, None].expand_as(shown)
            assert torch.equal(shown[outside], BACKGROUND[:, None, None].expand(2, 3, 16, 16)[outside])
            return (shown - truth).abs().mean((1, 2, 3))

    avatar.attach_perceptual(Network())
    terms = avatar.losses(rendering, batch, posed, Mode(GONE), torch.Generator())
    avatar.attach_perceptual(None)
    assert float(terms["reconstruction"]) == pytest.approx(0.2 * sum(errors) / len(errors), rel=1e-5)
    assert float(terms["lpips"]) > 0
    assert set(avatar.losses(rendering, batch, posed, Mode(GONE), torch.Generator())) == {"reconstruction"}


def test_motion_sees_nothing_before_it_begins_and_all_in_the_end(avatar, person):
    frame, config = person.train[1], avatar.settings
    for step, bands in ((0, 0.0), (config.motion_from - 1, 0.0), (30_000, 3.0), (config.motion_full, 6.0)):
        own = avatar.pose(frame.pose, frame.translation, frame.frame_index, Mode(step)).own
        assert own.open_bands == pytest.approx(bands)
        assert bool(own.condition.any()) == (step >= config.motion_from)


def test_evaluation_goes_by_the_step_that_was_trained_last(subject, person):
    avatar = built(RECIPE, subject)
    frame = person.train[1]
    avatar.before_step(Mode(30_000))
    assert avatar.pose(frame.pose, frame.translation).own.open_bands == pytest.approx(3.0)
    other = RECIPE.method.build(subject, 1)
    other.load_state_dict(avatar.state_dict())
    assert other.pose(frame.pose, frame.translation).own.open_bands == pytest.approx(3.0)


def test_poses_are_corrected_from_a_step_on(subject, person):
    avatar = built(RECIPE, subject, correct_from=100)
    frame = person.train[1]
    early, late = (avatar.pose(frame.pose, frame.translation, None, Mode(s)).body.pose for s in (99, 100))
    torch.testing.assert_close(early, frame.pose, rtol=0, atol=1e-6)
    assert (late - frame.pose)[1:].abs().max() > 1e-3
    assert avatar.pose_corrections()["body"] > 1e-3
    avatar.trained_step.fill_(5)
    assert avatar.pose_corrections() == {}


def test_volume_learns_at_every_so_many_steps_and_is_kept_between(subject, person):
    avatar, frame = built(RECIPE, subject, volume_every=3).train(), person.train[1]
    learns = [avatar.pose(frame.pose, frame.translation, None, Mode(s)).own.weights.requires_grad for s in range(5)]
    assert learns == [True, False, False, True, False]
    first, again = (avatar.pose(frame.pose, frame.translation).own.weights for _ in range(2))
    assert first is again
    with torch.no_grad():
        avatar.volume.code += 1
    assert not torch.equal(avatar.pose(frame.pose, frame.translation).own.weights, first)


@pytest.mark.parametrize(("density", "step", "answer"), [
    (-50.0, 99, "restart"), (-50.0, 98, "continue"), (20.0, 99, "continue"),
])  # fmt: skip
def test_training_begins_again_where_nobody_is_seen(subject, person, density, step, answer):
    avatar = built(RECIPE, subject, density=density)
    assert avatar.after_step(Mode(step), person) == answer


def test_training_images_get_a_random_background(avatar):
    generator = torch.Generator().manual_seed(0)
    first, second = (avatar.background(torch.zeros(3), 10, generator) for _ in range(2))
    assert first.shape == (3,)
    assert not torch.equal(first, second)
    assert first.min() >= 0
    assert first.max() <= 1


def test_surface_of_the_density_lies_around_the_posed_body(subject, person):
    avatar, frame = built(FAST, subject, density=60.0), person.train[2]
    posed = avatar.pose(frame.pose, frame.translation)
    vertices, faces = posed_surface(avatar, posed, voxel=0.03)
    assert len(faces) > 500
    near = torch.cdist(vertices, posed.body.vertices).amin(1)
    assert near.quantile(0.9) < 0.12


def test_networks_in_bfloat16_see_nearly_the_same(subject, person):
    frame, rays = person.train[1], rays_of(person.train[1], 12)
    colors = []
    for choice in ("float32", "bfloat16"):
        avatar = built(RECIPE, subject, hidden_dtype=choice)
        with torch.no_grad():
            colors.append(avatar.render(rays, avatar.pose(frame.pose, frame.translation), BACKGROUND).color)
    assert 0 < (colors[0] - colors[1]).abs().max() < 0.03


def test_rendering_in_parts_without_gradients_changes_nothing(avatar, person, monkeypatch):
    frame, rays = person.train[1], rays_of(person.train[1], 12)
    posed = avatar.pose(frame.pose, frame.translation)
    with torch.no_grad():
        whole = avatar.render(rays, posed, BACKGROUND).color
        monkeypatch.setattr("twofold.methods.skeletal.RAYS_AT_ONCE", 11)
        parts = avatar.render(rays, posed, BACKGROUND).color
    torch.testing.assert_close(parts, whole, rtol=0, atol=2e-6)


def test_losses_reach_volume_motion_and_poses(subject, person):
    avatar, frame = built(RECIPE, subject).train(), person.train[1]
    batch = PixelSource(person.train, person.body, person.betas, RECIPE.training.pixels).draw(
        1, torch.Generator().manual_seed(0)
    )
    posed = avatar.pose(frame.pose, frame.translation, frame.frame_index, Mode(GONE + 10_000))
    rendering = avatar.render(batch.rays, posed, BACKGROUND, Mode(GONE), torch.Generator().manual_seed(0))
    total(avatar.losses(rendering, batch.against(BACKGROUND), posed, EVALUATION, torch.Generator())).backward()
    for group in avatar.parameter_groups():
        assert all(p.grad is not None and p.grad.any() for p in group.parameters), group.name
