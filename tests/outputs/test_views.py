"""Images: every ray where it belongs, and cameras that keep the person in view."""

import builtins
import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from little_body import little_body, moved_pose, posed_little_body

from twofold.body.skeleton import canonical_pose, pose_body, shape_body
from twofold.geometry.cameras import Camera, clip_to_box, pixel_grid, pixel_rays, project
from twofold.geometry.rotations import axis_angle_to_matrix
from twofold.methods.base import EVALUATION, Avatar, PosedAvatar, Rendering
from twofold.outputs.views import body_up, look_at, orbit, pose_canonically, rays_at_once, render_image

BACKGROUND = torch.tensor([0.2, 0.4, 0.6])
SHAPED = shape_body(little_body(spacing=0.1), torch.zeros(1))


def as_avatar(body):
    """`Painted` derives nothing else from a pose."""
    return PosedAvatar(body, None)


class Painted(Avatar):
    """Answers each ray by its own direction and bounds, and keeps what it was asked."""

    def __init__(self, with_base=True):
        super().__init__()
        self.with_base, self.asked = with_base, []

    def pose(self, pose, translation, frame_index=None, mode=EVALUATION):
        return as_avatar(pose_body(SHAPED, pose, translation))

    def render(self, rays, posed, background, mode=EVALUATION, generator=None):
        assert generator is None, "images have no noise"
        assert not torch.is_grad_enabled()
        self.asked.append(rays)
        color = 0.7 + 0.5 * rays.directions
        base = Rendering(background + 0 * color, rays.near, rays.far, -rays.directions) if self.with_base else None
        return Rendering(color, 0.5 + 0 * rays.near, rays.near, rays.directions, base)

    def losses(self, rendering, batch, posed, mode, generator):
        return {}

    def level(self, x, posed, branch="full"):
        return x[:, 0]

    def parameter_groups(self):
        return []


def some_pose(seed=0, size=0.3):
    generator = torch.Generator().manual_seed(seed)
    return size * torch.randn(24, 3, generator=generator), torch.randn(3, generator=generator)


def side_camera(posed, height=12, width=18):
    """Sees the body and a good part of nothing."""
    middle = posed.body.vertices.mean(0)
    intrinsics = torch.tensor([[10.0, 0, 8.5], [0, 10, 5.5], [0, 0, 1]])
    view = look_at(middle + torch.tensor([0.5, 0.3, 2.5]), middle, torch.tensor([0.0, 1, 0]))
    return Camera(view, intrinsics, height, width)


@pytest.mark.parametrize("chunk", [None, 7])
@pytest.mark.parametrize("with_base", [True, False])
def test_each_pixel_is_what_its_ray_sees_and_the_rest_is_background(with_base, chunk):
    avatar = Painted(with_base)
    posed = avatar.pose(*some_pose())
    camera = side_camera(posed)
    image = render_image(avatar, posed, camera, BACKGROUND, chunk)
    vertices = posed.body.vertices
    low, high = vertices.amin(0) - 0.35, vertices.amax(0) + 0.35
    followed = 0
    for row, column in pixel_grid(camera).flip(-1).flatten(0, 1).long().tolist():
        ray = pixel_rays(camera, torch.tensor([[column, row]]).float())
        clipped, hit = clip_to_box(ray, low, high)
        here = image.color[row, column]
        if hit:
            followed += 1
            expected = (0.7 + 0.5 * ray.directions[0]).clamp(0, 1)
            values = expected, torch.tensor(0.5), clipped.near[0], ray.directions[0]
            beneath = (BACKGROUND, -ray.directions[0]) if with_base else (expected, ray.directions[0])
        else:
            values = BACKGROUND, torch.tensor(0.0), torch.tensor(0.0), torch.zeros(3)
            beneath = BACKGROUND, torch.zeros(3)
        found = here, image.opacity[row, column], image.depth[row, column], image.normal[row, column]
        torch.testing.assert_close(found, values, atol=1e-5, rtol=0)
        torch.testing.assert_close((image.base[row, column], image.base_normal[row, column]), beneath)
    assert 30 < followed < 12 * 18, "both kinds of pixels are there"
    assert sum(map(len, avatar.asked)) == followed
    assert chunk is None or max(map(len, avatar.asked)) == chunk


def test_rays_are_followed_within_the_box_around_the_body():
    avatar = Painted()
    posed = avatar.pose(*some_pose())
    render_image(avatar, posed, side_camera(posed), BACKGROUND)
    (rays,) = avatar.asked
    low, high = posed.body.vertices.amin(0), posed.body.vertices.amax(0)
    assert rays.far.isfinite().all()
    for t in (rays.near, rays.far):
        ends = rays.origins + t[:, None] * rays.directions
        assert (ends > low - 0.351).all()
        assert (ends < high + 0.351).all()


def test_camera_that_looks_away_sees_background():
    avatar = Painted()
    posed = avatar.pose(*some_pose())
    eye = posed.body.vertices.mean(0) + torch.tensor([0.0, 0, 3])
    away = look_at(eye, eye + torch.tensor([0.0, 0, 1]), torch.tensor([0.0, 1, 0]))
    image = render_image(avatar, posed, Camera(away, side_camera(posed).intrinsics, 8, 9), BACKGROUND)
    assert torch.equal(image.color, BACKGROUND.expand(8, 9, 3))
    assert sum(map(len, avatar.asked)) == 0


def test_residual_is_what_the_base_lacks():
    avatar = Painted()
    posed = avatar.pose(*some_pose())
    image = render_image(avatar, posed, side_camera(posed), BACKGROUND)
    assert torch.equal(image.residual, image.color - BACKGROUND)
    assert image.residual.abs().max() > 0.1
    alone = render_image(Painted(with_base=False), posed, side_camera(posed), BACKGROUND)
    assert not alone.residual.any()


def test_images_come_back_from_the_device(device):
    posed = Painted().pose(*some_pose())
    expected = render_image(Painted(), posed, side_camera(posed), BACKGROUND)
    shaped = type(SHAPED)(**{name: tensor.to(device) for name, tensor in vars(SHAPED).items()})
    there = as_avatar(pose_body(shaped, *(tensor.to(device) for tensor in some_pose())))
    found = render_image(Painted().to(device), there, side_camera(posed), BACKGROUND)
    assert found.color.device.type == "cpu"
    torch.testing.assert_close(found.color, expected.color)


vectors = st.tuples(*[st.floats(-2, 2)] * 3).map(torch.tensor)


@given(eye=vectors, target=vectors, up=vectors)
def test_camera_looks_at_its_target_with_up_pointing_up(eye, target, up):
    forward = target - eye
    slanted = torch.linalg.cross(forward, up).norm()
    if slanted < 0.1 * forward.norm() or slanted < 0.1 * up.norm() or forward.norm() < 0.1 or up.norm() < 0.1:
        return
    transform = look_at(eye, target, up)
    rotation = transform[:3, :3]
    torch.testing.assert_close(rotation @ rotation.T, torch.eye(3), atol=1e-5, rtol=0)
    assert torch.linalg.det(rotation) > 0
    assert torch.equal(transform[3], torch.tensor([0.0, 0, 0, 1]))
    camera = Camera(transform, torch.tensor([[50.0, 0, 10], [0, 50, 10], [0, 0, 1]]), 21, 21)
    torch.testing.assert_close(camera.center, eye, atol=1e-5, rtol=0)
    pixel, depth = project(camera, target)
    torch.testing.assert_close(pixel, torch.tensor([10.0, 10]), atol=1e-3, rtol=0)
    torch.testing.assert_close(depth, forward.norm(), atol=1e-5, rtol=1e-5)
    above, _ = project(camera, target + 0.01 * up)
    assert above[1] < pixel[1]
    torch.testing.assert_close(above[0], pixel[0], atol=1e-2, rtol=0)


@given(seed=st.integers(0, 999), size=st.floats(0, 0.8), turn=vectors, views=st.integers(1, 4), start=st.floats(-4, 4))
def test_circling_cameras_keep_the_whole_body_in_view(seed, size, turn, views, start):
    pose, translation = some_pose(seed, size)
    pose[0] = turn
    body = pose_body(SHAPED, pose, translation)
    posed = as_avatar(body)
    cameras = list(orbit(posed, 64, views, start=start))
    assert len(cameras) == views
    for camera in cameras:
        assert (camera.height, camera.width) == (64, 64)
        pixels, depth = project(camera, body.vertices)
        assert depth.min() > 0.5
        assert pixels.min() > -0.5
        assert pixels.max() < 63.5
        extent = (pixels.amax(0) - pixels.amin(0)).max()
        assert views < 3 or extent > 20, "and not from afar"


def test_circle_begins_in_front_goes_round_evenly_and_keeps_its_height():
    avatar = Painted()
    posed = pose_canonically(avatar)
    middle = (posed.body.vertices.amin(0) + posed.body.vertices.amax(0)) / 2
    cameras = list(orbit(posed, 32, 5, up=torch.tensor([0.0, 1, 0])))
    arms = torch.stack([c.center for c in cameras]) - middle
    angles = torch.atan2(arms[:, 0], arms[:, 2])
    expected = torch.arange(5) * 2 * math.pi / 5
    assert angles[0].abs() < 0.1, "the person faces +z"
    torch.testing.assert_close((angles - angles[0]) % (2 * math.pi), expected, atol=1e-4, rtol=0)
    torch.testing.assert_close(arms[:, 1], torch.zeros(5), atol=1e-5, rtol=0)
    torch.testing.assert_close(arms.norm(dim=1), arms[0].norm().expand(5), atol=1e-4, rtol=0)
    left, right = project(cameras[0], posed.body.joints)[0][[20, 21], 0]
    assert left > right, "seen from the front, the left hand is on the right"
    shifted = next(orbit(posed, 32, 1, up=torch.tensor([0.0, 1, 0]), start=2 * math.pi / 5))
    torch.testing.assert_close(shifted.center, cameras[1].center, atol=1e-4, rtol=0)


@given(seed=st.integers(0, 999))
def test_cameras_circle_with_the_body_wherever_it_lies(seed):
    generator = torch.Generator().manual_seed(seed)
    pose, translation = some_pose(seed)
    turn, shift = torch.randn(3, generator=generator), torch.randn(3, generator=generator)
    bodies = [
        pose_body(SHAPED, *p)
        for p in ((pose, translation), moved_pose(pose, translation, SHAPED.joints[0], turn, shift))
    ]
    here, there = map(as_avatar, bodies)
    rotation = axis_angle_to_matrix(turn)
    torch.testing.assert_close(body_up(there), rotation @ body_up(here), atol=1e-4, rtol=0)
    # The box around a turned body is another one, so only the direction to the camera follows exactly.
    centers = []
    for posed in (here, there):
        vertices = posed.body.vertices
        camera = next(orbit(posed, 32, 1))
        centers.append(torch.nn.functional.normalize(camera.center - (vertices.amin(0) + vertices.amax(0)) / 2, dim=0))
    torch.testing.assert_close(centers[1], rotation @ centers[0], atol=1e-3, rtol=0)


def test_up_is_from_the_feet_to_the_neck():
    posed = as_avatar(posed_little_body(size=0))
    torch.testing.assert_close(body_up(posed), torch.tensor([0.0, 1, 0]), atol=0.05, rtol=0)


def test_canonical_pose_stands_at_the_origin():
    posed = pose_canonically(Painted())
    assert torch.equal(posed.body.pose, canonical_pose())
    torch.testing.assert_close(posed.body.joints[0], SHAPED.joints[0])


def test_chunks_are_neither_tiny_nor_huge(monkeypatch):
    assert 1024 <= rays_at_once(torch.device("cpu")) <= 131_072

    def nothing(*_, **__):
        raise FileNotFoundError

    monkeypatch.setattr(builtins, "open", nothing)
    assert rays_at_once(torch.device("cpu")) == 2**30 // 65536
