"""The four conventions of where a body stands: in double precision they are one."""

import pytest
import torch

from twofold.capture.readers.body_placement import (
    as_rows,
    from_model_origin,
    from_pelvis,
    moved_world,
    to_model_origin,
    to_pelvis,
)
from twofold.geometry.rotations import axis_angle_to_matrix


@pytest.fixture(params=range(5))
def placed(request):
    """Points of a body, its root joint, and where it stands in SMPL's own convention, of three frames."""
    generator = torch.Generator().manual_seed(request.param)
    points = torch.randn(40, 3, generator=generator, dtype=torch.float64)
    joint = torch.randn(3, generator=generator, dtype=torch.float64) * 0.3
    root = torch.randn(3, 3, generator=generator, dtype=torch.float64) * 0.9
    translation = torch.randn(3, 3, generator=generator, dtype=torch.float64)
    return points, joint, root, translation


def smpl(points, joint, root, translation):
    """R (x - j) + j + t, literally."""
    return (axis_angle_to_matrix(root) @ (points - joint).T).transpose(-1, -2) + joint + translation[:, None]


def test_about_the_models_origin(placed):
    points, joint, root, translation = placed
    turn, shift = to_model_origin(root, translation, joint)
    literal = (axis_angle_to_matrix(turn) @ points.T).transpose(-1, -2) + shift[:, None]
    torch.testing.assert_close(literal, smpl(*placed), atol=1e-9, rtol=0)
    again = from_model_origin(turn, shift, torch.zeros(3, 3).double(), joint)
    torch.testing.assert_close(smpl(points, joint, *again), literal, atol=1e-9, rtol=0)


def test_about_the_pelvis(placed):
    points, joint, root, translation = placed
    turn, shift = to_pelvis(root, translation, joint)
    literal = (axis_angle_to_matrix(turn) @ (points - joint).T).transpose(-1, -2) + shift[:, None]
    torch.testing.assert_close(literal, smpl(*placed), atol=1e-9, rtol=0)
    again = from_pelvis(turn, shift, torch.zeros(3, 3).double(), joint)
    torch.testing.assert_close(smpl(points, joint, *again), literal, atol=1e-9, rtol=0)


def test_scaled(placed):
    """s (R (x - j) + j + t), seen by a camera whose translation is scaled too, has the same image."""
    literal = 0.37 * smpl(*placed)
    torch.testing.assert_close(literal / 0.37, smpl(*placed), atol=1e-9, rtol=0)


@pytest.mark.parametrize("read", [from_model_origin, from_pelvis])
def test_a_root_rotation_within_the_pose_comes_first(read, placed):
    points, joint, root, translation = placed
    turn = root.roll(1, 0)
    inner = (axis_angle_to_matrix(root) @ (points - joint).T).transpose(-1, -2) + joint
    pivot = joint if read is from_pelvis else torch.zeros(3).double()
    literal = (axis_angle_to_matrix(turn) @ (inner - pivot).transpose(-1, -2)).transpose(-1, -2) + translation[:, None]
    found = read(turn, translation, root, joint)
    torch.testing.assert_close(smpl(points, joint, *found), literal, atol=1e-9, rtol=0)


def test_a_world_that_moves(placed):
    points, joint, root, translation = placed
    change, shift = axis_angle_to_matrix(root.flip(0)), translation.flip(0)
    literal = (change @ smpl(*placed).transpose(-1, -2)).transpose(-1, -2) + shift[:, None]
    found = moved_world(change, shift, root, translation, joint)
    torch.testing.assert_close(smpl(points, joint, *found), literal, atol=1e-9, rtol=0)


def test_flat_poses_are_taken_joint_by_joint():
    flat = torch.arange(144.0).reshape(2, 72)
    assert as_rows(flat)[1, 2].tolist() == [78, 79, 80]
