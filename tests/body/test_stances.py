import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from twofold.body.skeleton import joint_transforms
from twofold.body.stances import REHEARSED, UNREHEARSED, Arm, Leg, Stance, choreograph, stance_poses

JOINTS = torch.zeros(24, 3)
"""A stick figure: arms along x, legs along -y."""
for _side, _sign in ((0, 1.0), (1, -1.0)):
    JOINTS[13 + _side], JOINTS[16 + _side] = torch.tensor([_sign * 0.05, 0.4, 0]), torch.tensor([_sign * 0.2, 0.4, 0])
    JOINTS[18 + _side], JOINTS[20 + _side] = torch.tensor([_sign * 0.5, 0.4, 0]), torch.tensor([_sign * 0.8, 0.4, 0])
    JOINTS[22 + _side] = torch.tensor([_sign * 0.9, 0.4, 0])
    JOINTS[1 + _side], JOINTS[4 + _side] = torch.tensor([_sign * 0.1, 0.0, 0]), torch.tensor([_sign * 0.1, -0.4, 0])
    JOINTS[7 + _side], JOINTS[10 + _side] = (
        torch.tensor([_sign * 0.1, -0.8, 0]),
        torch.tensor([_sign * 0.1, -0.85, 0.1]),
    )


def stand(stance, yaw=0.0):
    """Posed joints of the stick figure."""
    pose = torch.from_numpy(stance_poses(np.array([stance.numbers()], dtype=float), np.array([yaw]))[0]).float()
    transforms = joint_transforms(JOINTS, pose, torch.zeros(3))
    return (transforms[:, :3, :3] @ JOINTS[:, :, None])[..., 0] + transforms[:, :3, 3]


def direction(points, a, b):
    return torch.nn.functional.normalize(points[b] - points[a], dim=0).tolist()


def straight(**arm):
    return Arm(**({"twist": 0, "elbow": 0} | arm))


@pytest.mark.parametrize(("side", "sign"), [("left", 1), ("right", -1)])
@pytest.mark.parametrize(
    ("raise_", "forward", "expected"),
    [(0, 0, (0, -1, 0)), (90, 0, (1, 0, 0)), (90, 90, (0, 0, 1)), (180, 0, (0, 1, 0)), (45, 90, (0, -0.7071, 0.7071))],
)
def test_an_arm_points_where_its_angles_say(side, sign, raise_, forward, expected):
    stance = Stance(**{f"{side}_arm": straight(raise_=raise_, forward=forward)})
    points = stand(stance)
    shoulder, wrist = (16, 20) if side == "left" else (17, 21)
    x, y, z = expected
    assert direction(points, shoulder, wrist) == pytest.approx([sign * x, y, z], abs=1e-4)


def test_a_bent_elbow_of_a_hanging_arm_brings_the_hand_ahead():
    points = stand(Stance(straight(raise_=0, elbow=90), straight(raise_=0, elbow=90)))
    for elbow, wrist in ((18, 20), (19, 21)):
        assert direction(points, elbow, wrist) == pytest.approx([0, 0, 1], abs=1e-4)


def test_legs_lift_ahead_knees_bend_back_and_soles_stay_level():
    points = stand(Stance(left_leg=Leg(25, 0, 0, 40), right_leg=Leg(0, 20, 0, 0)))
    thigh, shin = direction(points, 1, 4), direction(points, 4, 7)
    assert thigh[2] == pytest.approx(np.sin(np.radians(25)), abs=1e-4)
    assert shin[2] == pytest.approx(-np.sin(np.radians(15)), abs=1e-4)
    assert direction(points, 2, 5)[0] == pytest.approx(-np.sin(np.radians(20)), abs=1e-4)
    level, flat = direction(JOINTS, 7, 10), direction(points, 7, 10)
    assert flat[1] == pytest.approx(level[1], abs=1e-3)


def test_turning_the_body_turns_its_left_hand_away():
    ahead, turned = stand(Stance()), stand(Stance(), yaw=90.0)
    assert turned[18] - turned[0] == pytest.approx(
        torch.stack([(ahead[18] - ahead[0])[2], (ahead[18] - ahead[0])[1], -(ahead[18] - ahead[0])[0]]), abs=1e-4
    )


def facing(poses):
    """Direction of the body's front in the plane of the floor, radians."""
    from scipy.spatial.transform import Rotation

    ahead = Rotation.from_rotvec(poses[:, 0]).apply([0, 0, 1])
    return np.arctan2(ahead[:, 0], ahead[:, 2])


@settings(max_examples=15, deadline=None)
@given(st.integers(0, 1000), st.integers(12, 80))
def test_the_training_motion_shows_every_side(seed, rehearsed):
    poses, _ = choreograph(seed, rehearsed, 4)
    angles = np.sort(facing(poses[:rehearsed]) % (2 * np.pi))
    gaps = np.diff(np.append(angles, angles[0] + 2 * np.pi))
    assert gaps.max() < 2 * np.pi * 3 / rehearsed + 0.15


@settings(max_examples=15, deadline=None)
@given(st.integers(0, 1000))
def test_motion_is_smooth_and_within_what_joints_can_do(seed):
    poses, sway = choreograph(seed, 60, 16)
    # From one frame to the next, a twelfth of a second, no limb flies off.
    assert np.abs(np.diff(poses[:60, 1:], axis=0)).max() < 0.75
    assert np.abs(sway).max() < 0.05
    assert (poses[:, [4, 5], 0] >= 0).all()
    assert poses[:, [4, 5], 0].max() < 2.2
    assert (poses[:, 18, 1] <= 0).all()
    assert (poses[:, 19, 1] >= 0).all()
    assert np.linalg.norm(poses[:, [3, 6, 9]], axis=-1).max() < 0.5
    assert np.isfinite(poses).all()


@settings(max_examples=10, deadline=None)
@given(st.integers(0, 1000))
def test_unseen_poses_are_other_poses(seed):
    poses, _ = choreograph(seed, 64, 16)
    # Root left out: turning is no new pose.
    away = np.abs(poses[64:, None, 1:] - poses[None, :64, 1:]).max((-1, -2)).min(1)
    assert np.median(away) > 0.35
    assert away.max() < 2.0


def test_the_same_seed_moves_the_same_and_another_does_not():
    (a, _), (b, _), (c, _) = (choreograph(seed, 20, 5) for seed in (1, 1, 2))
    assert (a == b).all()
    assert np.abs(a - c).max() > 0.2


@pytest.mark.parametrize(("rehearsed", "unrehearsed"), [(2, 1), (3, 1), (8, 2), (400, 100)])
def test_any_number_of_frames_can_be_danced(rehearsed, unrehearsed):
    poses, sway = choreograph(0, rehearsed, unrehearsed)
    assert poses.shape == (rehearsed + unrehearsed, 24, 3)
    assert sway.shape == (rehearsed + unrehearsed, 2)


def test_rehearsed_and_unrehearsed_stances_differ():
    assert len({tuple(s.numbers()) for s in REHEARSED + UNREHEARSED}) == len(REHEARSED) + len(UNREHEARSED)
