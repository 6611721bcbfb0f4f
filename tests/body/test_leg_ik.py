import torch
from motion_rigs import stick_joints
from test_motion import random_motion

from twofold.body.leg_ik import ANKLES, reach
from twofold.body.motion import Motion, joint_frames, local_poses

JOINTS = stick_joints()


def bent():
    motion = random_motion(3, 20)
    poses = 0.3 * motion.poses
    poses[:, [4, 5], 0] = poses[:, [4, 5], 0].abs() + 0.9
    return Motion("bent", poses, motion.translations, 30.0)


def after(turned, motion):
    return joint_frames(JOINTS, Motion("after", local_poses(turned), motion.translations, 30.0))[1]


def test_ankles_come_to_their_places_and_nothing_else_turns():
    motion = bent()
    rotations, positions = joint_frames(JOINTS, motion)
    ankles = positions[:, list(ANKLES)] + 0.03 * random_motion(5, 20).poses[:, :2]
    turned = reach(rotations, positions, ankles)
    torch.testing.assert_close(after(turned, motion)[:, list(ANKLES)], ankles, atol=1e-6, rtol=0)
    same = [joint for joint in range(24) if joint not in (1, 2, 4, 5)]
    assert torch.equal(turned[:, same], rotations[:, same])


def test_ankles_that_are_there_already_leave_the_legs_alone():
    motion = bent()
    rotations, positions = joint_frames(JOINTS, motion)
    assert torch.equal(reach(rotations, positions, positions[:, list(ANKLES)]), rotations)


def test_places_out_of_reach_are_pointed_at_with_a_straight_leg():
    motion = bent()
    rotations, positions = joint_frames(JOINTS, motion)
    far = positions[:, [1, 2]] + torch.tensor([0.3, -2.0, 0.5])
    now = after(reach(rotations, positions, far), motion)
    toward = torch.nn.functional.normalize(far - positions[:, [1, 2]], dim=-1)
    reached = torch.nn.functional.normalize(now[:, list(ANKLES)] - now[:, [1, 2]], dim=-1)
    torch.testing.assert_close(reached, toward, atol=1e-5, rtol=0)


def test_a_straight_leg_bends_its_knee_ahead():
    motion = Motion("straight", torch.zeros(1, 24, 3, dtype=torch.float64), torch.zeros(1, 3).double(), 30.0)
    rotations, positions = joint_frames(JOINTS, motion)
    now = after(reach(rotations, positions, positions[:, list(ANKLES)] + torch.tensor([0, 0.1, 0])), motion)
    assert (now[0, [4, 5], 2] > positions[0, [4, 5], 2] + 0.05).all()
