"""The world is set upright, and nothing in any image moves."""

import math

import pytest
import torch
from acting import acted, before_camera, standing_camera, the_body
from hypothesis import given
from hypothesis import strategies as st

from twofold.body.skeleton import pose_body, shape_body
from twofold.geometry.cameras import Camera, project
from twofold.geometry.rotations import axis_angle_to_matrix, matrix_to_axis_angle
from twofold.geometry.upright import turn_world
from twofold.prepare.fitting.world_up import stand_upright, up_direction

angles = st.floats(-math.pi, math.pi)
turns = st.tuples(angles, angles, angles)


def tilted(turn):
    """A scene in a world that stands anyhow: body, poses, translations, cameras, rest position of the root."""
    body = the_body()
    motion = acted(body, 4)
    root = body.joints[0] + body.joint_basis[0] @ motion.betas
    rotation = axis_angle_to_matrix(torch.tensor(turn, dtype=torch.float64))
    shift = torch.tensor([0.4, -0.8, 1.5], dtype=torch.float64)
    cameras = {}
    for name, azimuth in (("front", 0.2), ("side", 1.9)):
        camera = standing_camera(azimuth)
        poses, translations, view = turn_world(
            rotation, root.double(), motion.full_pose().double(), motion.translation.double(),
            camera.world_to_camera.double(),
        )  # fmt: skip
        view[:3, 3] -= view[:3, :3] @ shift
        cameras[name] = Camera(view.float(), camera.intrinsics, camera.height, camera.width)
    return body, motion.betas, root, poses.float(), (translations + shift).float(), cameras


def vertices(body, betas, poses, translations):
    shaped = shape_body(body, betas)
    return torch.stack([pose_body(shaped, p, t).vertices for p, t in zip(poses, translations, strict=True)])


@given(turn=turns)
def test_no_pixel_moves_and_the_person_stands_on_the_floor(turn):
    body, betas, root, poses, translations, cameras = tilted(turn)
    up = up_direction(poses, calibrated=False)
    before = vertices(body, betas, poses, translations)
    lowest = float((before @ up).min())
    new_poses, new_translations, new_cameras = stand_upright(up, root, lowest, poses, translations, cameras)
    after = vertices(body, betas, new_poses, new_translations)
    for name, camera in cameras.items():
        for old, new in zip(project(camera, before), project(new_cameras[name], after), strict=True):
            torch.testing.assert_close(new, old, atol=5e-3, rtol=0)
    assert float(after[..., 1].min()) == pytest.approx(0, abs=1e-4)
    middle = (new_translations + root).mean(0)
    torch.testing.assert_close(middle[[0, 2]], torch.zeros(2), atol=1e-5, rtol=0)
    upright = axis_angle_to_matrix(new_poses[:, 0])[:, :, 1].mean(0)
    torch.testing.assert_close(upright, torch.tensor([0.0, 1, 0]), atol=1e-4, rtol=0)
    torch.testing.assert_close(new_poses[:, 1:], poses[:, 1:])


@pytest.mark.parametrize("tilt", [0.0, 0.05, 0.15, 0.25, 0.6])
def test_a_camera_that_looks_a_little_down_gets_a_level_floor(tilt):
    """A single camera's world has y down, so up is nearly opposite to y."""
    body = the_body()
    motion, camera = before_camera(body, acted(body, 4, turn=0.0), standing_camera(0.2))
    lean = axis_angle_to_matrix(torch.tensor([tilt, 0.3 * tilt, 0.5 * tilt]))
    poses = motion.full_pose()
    poses[:, 0] = matrix_to_axis_angle(lean @ axis_angle_to_matrix(poses[:, 0]))
    root = body.joints[0]
    moved, _, _ = stand_upright(up_direction(poses, False), root, 0.0, poses, motion.translation, {"cam": camera})
    upright = axis_angle_to_matrix(moved[:, 0])[:, :, 1]
    torch.testing.assert_close(upright, torch.tensor([0.0, 1, 0]).expand(4, 3), atol=1e-4, rtol=0)


@given(axis=st.integers(0, 2), sign=st.sampled_from([1.0, -1.0]), lean=st.floats(0, 0.3), turn=angles)
def test_calibrated_worlds_keep_their_axis_where_it_is_close(axis, sign, lean, turn):
    up = torch.zeros(3)
    up[axis] = sign
    across = torch.roll(up, 1)
    stands = axis_angle_to_matrix(lean * across)
    # Any rotation that takes y there, about itself by `turn`.
    start = torch.stack([torch.roll(up, 2), up, torch.linalg.cross(torch.roll(up, 2), up)], 1)
    about = axis_angle_to_matrix(torch.tensor([[0.0, turn + k, 0.0] for k in range(3)]))
    poses = torch.zeros(3, 24, 3)
    poses[:, 0] = matrix_to_axis_angle(stands @ start @ about)
    torch.testing.assert_close(up_direction(poses, calibrated=True), up)
    torch.testing.assert_close(up_direction(poses, calibrated=False), stands @ up, atol=1e-5, rtol=0)


def test_calibrated_worlds_without_an_upright_axis_go_by_the_person():
    poses = tilted((0.5, 0.0, 0.0))[3]
    torch.testing.assert_close(up_direction(poses, True), up_direction(poses, False))
