import dataclasses

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from motion_rigs import stick_joints
from scipy.spatial.transform import Rotation, Slerp

from twofold.body.motion import (
    UP_AXES,
    Motion,
    joint_frames,
    leg_length,
    local_poses,
    resampled,
    started_at_origin,
    turned_upright,
    up_axis,
)
from twofold.errors import TwofoldError

JOINTS = stick_joints()


def random_motion(seed=0, frames=7, fps=30.0):
    random = torch.Generator().manual_seed(seed)
    poses = 0.8 * torch.randn(frames, 24, 3, generator=random, dtype=torch.float64)
    return Motion("random", poses, torch.randn(frames, 3, generator=random, dtype=torch.float64), fps)


@given(seed=st.integers(0, 1000))
def test_local_poses_undo_forward_kinematics(seed):
    motion = random_motion(seed, 3)
    rotations, _ = joint_frames(JOINTS, motion)
    again, _ = joint_frames(JOINTS, dataclasses.replace(motion, poses=local_poses(rotations)))
    torch.testing.assert_close(again, rotations, atol=1e-7, rtol=0)


def test_rotations_are_resampled_along_the_shortest_arc():
    motion = random_motion()
    made = resampled(motion, 50.0)
    times = np.arange(len(made)) / 50
    for joint in (0, 5, 18):
        slerp = Slerp(np.arange(7) / 30, Rotation.from_rotvec(motion.poses[:, joint].numpy()))
        expected = slerp(times)
        off = expected.inv() * Rotation.from_rotvec(made.poses[:, joint].numpy())
        assert np.abs(off.magnitude()).max() < 1e-6
    np.testing.assert_allclose(made.translations[:, 0], np.interp(times, np.arange(7) / 30, motion.translations[:, 0]))


def test_half_the_rate_keeps_every_second_frame():
    made = resampled(random_motion(), 15.0)
    assert len(made) == 4
    torch.testing.assert_close(made.translations, random_motion().translations[::2])


@pytest.mark.parametrize("fps", [0.0, -3.0, float("nan")])
def test_a_rate_that_is_no_rate_is_refused(fps):
    with pytest.raises(TwofoldError, match="positive number"):
        resampled(random_motion(), fps)


@pytest.mark.parametrize("up", UP_AXES)
def test_turning_a_world_upright_turns_all_joints_alike(up):
    motion = random_motion()
    turn = torch.tensor(UP_AXES[up], dtype=torch.float64)
    _, before = joint_frames(JOINTS, motion)
    _, after = joint_frames(JOINTS, turned_upright(motion, up, JOINTS[0]))
    torch.testing.assert_close(after, before @ turn.T)
    axis = torch.zeros(3, dtype=torch.float64)
    axis["xyz".index(up[-1])] = -1 if up.startswith("-") else 1
    assert (turn @ axis).tolist() == [0, 1, 0]
    assert torch.linalg.det(turn) == pytest.approx(1)
    assert up_axis(axis.expand(4, 3)) == up


def test_lying_people_show_no_up_axis():
    assert up_axis(torch.tensor([[1.0, 0.1, 0.0], [-1.0, 0.0, 0.1], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])) is None


def test_the_first_pelvis_is_moved_over_the_origin_and_keeps_its_height():
    motion = random_motion()
    _, before = joint_frames(JOINTS, motion)
    _, after = joint_frames(JOINTS, started_at_origin(motion, JOINTS))
    assert after[0, 0].tolist() == pytest.approx([0, float(before[0, 0, 1]), 0])
    torch.testing.assert_close(after - after[0, 0], before - before[0, 0])


def test_leg_length_is_thigh_and_shin():
    assert leg_length(stick_joints(thigh=2.0)) - leg_length(stick_joints()) == pytest.approx(0.3906, abs=1e-3)
