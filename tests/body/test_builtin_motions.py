import pytest
import torch
from motion_rigs import stick_body
from test_foot_contacts import slide_of_standing_feet

from twofold.body.builtin_motions import BUILTIN_MOTIONS
from twofold.body.joint_limits import beyond_limits
from twofold.body.motion import joint_frames

BODIES = {"usual": stick_body(), "tall": stick_body(thigh=1.1, shin=1.15), "child": stick_body(size=0.6)}


@pytest.fixture(scope="module", params=[(name, body) for name in BUILTIN_MOTIONS for body in BODIES], ids="-".join)
def moved(request):
    name, size = request.param
    body = BODIES[size]
    return name, body, BUILTIN_MOTIONS[name](body)


def test_no_joint_turns_further_than_a_persons(moved):
    _, _, motion = moved
    assert beyond_limits(motion.poses).max() < 1e-6


def test_feet_that_stand_stay_where_they_are(moved):
    _, body, motion = moved
    assert slide_of_standing_feet(body, motion, body, motion) < 0.008


def test_feet_never_go_through_the_floor_and_one_always_stands(moved):
    _name, body, motion = moved
    _, positions = joint_frames(body.joints, motion)
    rise = float(body.joints[10, 1] - body.vertices[:, 1].min())
    heights = positions[:, [10, 11], 1] - rise
    assert heights.min() > -0.004
    assert heights.amin(1).max() < 0.012


def test_nothing_jumps(moved):
    _, body, motion = moved
    rotations, positions = joint_frames(body.joints, motion)
    turns = rotations[:-1].transpose(-1, -2) @ rotations[1:]
    angles = ((turns.diagonal(dim1=-2, dim2=-1).sum(-1) - 1) / 2).clamp(-1, 1).acos()
    assert angles.max() * motion.fps < 14  # radians a second
    assert torch.diff(positions, n=2, dim=0).norm(dim=-1).max() < 0.08 * body.joints[10, 1].abs()


def test_walking_goes_ahead_with_the_arm_of_the_other_side():
    body = BODIES["usual"]
    motion = BUILTIN_MOTIONS["walk"](body)
    _, positions = joint_frames(body.joints, motion)
    assert positions[-1, 0, 2] - positions[0, 0, 2] > 4
    assert positions[:, 0, 0].abs().max() < 0.05
    feet, hands = (positions[:, a, 2] - positions[:, b, 2] for a, b in ((7, 8), (20, 21)))
    assert torch.corrcoef(torch.stack([feet, hands]))[0, 1] < -0.7


def test_turning_goes_once_around_to_the_left_on_the_spot():
    body = BODIES["usual"]
    motion = BUILTIN_MOTIONS["turn"](body)
    rotations, positions = joint_frames(body.joints, motion)
    facing = torch.atan2(rotations[:, 0, 0, 2], rotations[:, 0, 2, 2])
    steps = torch.remainder(torch.diff(facing) + torch.pi, 2 * torch.pi) - torch.pi
    assert steps.min() > -0.01
    assert float(steps.sum()) == pytest.approx(2 * torch.pi, abs=0.05)
    assert (positions[:, 0, [0, 2]]).norm(dim=-1).max() < 0.1
