import torch
from hypothesis import given
from hypothesis import strategies as st

from twofold.body.joint_limits import beyond_limits, joint_limits, within_limits
from twofold.body.skeleton import JOINT_NAMES


def test_limits_of_both_sides_are_mirror_images():
    low, high = joint_limits()
    for joint, name in enumerate(JOINT_NAMES):
        if name.startswith("left"):
            other = JOINT_NAMES.index(name.replace("left", "right"))
            assert torch.equal(low[joint, 0], low[other, 0])
            assert torch.equal(low[joint, 1:], -high[other, 1:])
    assert (low < high).all()


@given(seed=st.integers(0, 1000))
def test_clamped_poses_are_within_and_stay_when_clamped_again(seed):
    poses = 3 * torch.randn(4, 24, 3, generator=torch.Generator().manual_seed(seed))
    clamped = within_limits(poses)
    assert beyond_limits(clamped).max() == 0
    assert torch.equal(within_limits(clamped), clamped)
    assert torch.equal(clamped[:, 0], poses[:, 0])


def test_a_knee_bent_ahead_is_beyond_its_limits():
    pose = torch.zeros(24, 3)
    pose[4, 0] = -0.5
    assert beyond_limits(pose)[4] > 0.3
    assert beyond_limits(pose).count_nonzero() == 1
