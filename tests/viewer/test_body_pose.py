import math

import numpy as np
import pytest
import torch

from twofold.body.motion import Motion
from twofold.body.motion_files import read_motion
from twofold.body.skeleton import JOINT_NAMES, joint_transforms
from twofold.geometry.rotations import axis_angle_to_matrix
from twofold.viewer.body_pose import (
    BodyPose,
    canonical_like,
    joint_place,
    joint_ranges,
    save_poses,
    turned_motion,
    with_pelvis_at,
    with_world_rotation,
)

ELBOW = JOINT_NAMES.index("left_elbow")


@pytest.fixture
def posed(generator):
    return BodyPose(0.4 * torch.randn(24, 3, generator=generator), torch.tensor([0.3, -0.2, 0.5]))


def test_another_joint_leaves_the_others_and_the_pose_before(posed):
    before = posed.pose.clone()
    bent = posed.with_joint(ELBOW, torch.tensor([0.1, 0.2, 0.3]))
    assert torch.equal(posed.pose, before)
    changed = (bent.pose != posed.pose).any(-1).nonzero().flatten().tolist()
    assert changed == [ELBOW]


def test_a_gizmo_stands_where_forward_kinematics_puts_the_joint(viewed, posed):
    rotation, place = joint_place(viewed.body, posed, ELBOW)
    transform = joint_transforms(viewed.body.joints, posed.pose, posed.translation)[ELBOW]
    assert torch.allclose(rotation, transform[:3, :3], atol=1e-5)
    assert torch.allclose(place, transform[:3, :3] @ viewed.body.joints[ELBOW] + transform[:3, 3], atol=1e-5)


@pytest.mark.parametrize("joint", [0, ELBOW])
def test_a_world_rotation_is_reached_by_turning_one_joint(viewed, posed, joint):
    wanted = axis_angle_to_matrix(torch.tensor([0.4, -1.0, 0.7]))
    turned = with_world_rotation(viewed.body, posed, joint, wanted)
    assert torch.allclose(joint_place(viewed.body, turned, joint)[0], wanted, atol=1e-5)
    assert (turned.pose != posed.pose).any(-1).sum() == 1


def test_pelvis_goes_where_it_is_moved(viewed, posed):
    place = torch.tensor([1.0, 2.0, -0.5])
    assert torch.allclose(joint_place(viewed.body, with_pelvis_at(viewed.body, posed, place), 0)[1], place, atol=1e-6)


def test_sliders_reach_what_a_person_does_and_what_the_pose_has():
    hip = JOINT_NAMES.index("left_hip")
    (low, high), *_ = joint_ranges(hip, torch.zeros(3))
    assert (round(math.degrees(low)), round(math.degrees(high))) == (-125, 30)
    (low, high), *_ = joint_ranges(hip, torch.tensor([1.0, 0, 0]))
    assert low < -2
    assert 1.0 <= high < 1.1
    assert joint_ranges(0, torch.zeros(3))[1] == (-math.pi, math.pi)


def test_canonical_pose_is_upright_where_the_person_stands(posed):
    turn = torch.diag(torch.tensor([1.0, -1.0, -1.0]))
    canonical = canonical_like(posed, turn)
    assert torch.equal(canonical.translation, posed.translation)
    assert torch.allclose(axis_angle_to_matrix(canonical.pose[0]), turn, atol=1e-6)
    assert canonical.pose[1, 2] == pytest.approx(math.pi / 6)


def test_a_turned_motion_is_the_motion_seen_from_a_turned_world(viewed, generator):
    motion = Motion("m", 0.5 * torch.randn(3, 24, 3, generator=generator), torch.randn(3, 3, generator=generator), 30.0)
    turn = axis_angle_to_matrix(torch.tensor([math.pi / 2, 0, 0]))
    turned = turned_motion(motion, turn, viewed.body.joints[0])
    for joint in (0, ELBOW, 15):
        for frame in range(3):
            own = BodyPose(motion.poses[frame], motion.translations[frame])
            other = BodyPose(turned.poses[frame], turned.translations[frame])
            expected = turn @ joint_place(viewed.body, own, joint)[1]
            assert torch.allclose(joint_place(viewed.body, other, joint)[1], expected, atol=1e-5)


def test_saved_poses_are_read_back_as_a_motion(viewed, tmp_path):
    poses = [BodyPose(torch.zeros(24, 3), torch.tensor([0.2, 0.1, 0.3]))]
    poses.append(poses[0].with_joint(ELBOW, torch.tensor([0.0, -1.0, 0.2])))
    save_poses(tmp_path / "new" / "pose.npz", poses, 24.0, torch.tensor([0.3]))
    read = read_motion(tmp_path / "new" / "pose.npz", viewed.body)
    assert (read.fps, read.frames, read.format) == (24.0, 2, "capture")
    for frame, posed in enumerate(poses):
        own = axis_angle_to_matrix(read.motion.poses[frame])
        assert torch.allclose(own, axis_angle_to_matrix(posed.pose), atol=1e-6)
        assert torch.allclose(read.motion.translations[frame], posed.translation, atol=1e-6)
    assert np.load(tmp_path / "new" / "pose.npz")["betas"].tolist() == pytest.approx([0.3])
