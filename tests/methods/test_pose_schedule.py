"""What the pose-dependent branch is conditioned on, by pose, step and epoch."""

import math

import pytest
import torch

from twofold.methods.pose_schedule import PoseConfig, condition

POSE = 0.3 * torch.randn(24, 3, generator=torch.Generator().manual_seed(0))


def seen(step, epoch=0, **options):
    return condition(PoseConfig(**({"zero_until": 0, "zero_every": 0} | options)), POSE, step, epoch)


def test_pose_is_given_without_the_root_over_pi_or_as_it_is():
    torch.testing.assert_close(seen(None), POSE[1:].flatten() / math.pi)
    torch.testing.assert_close(seen(7, divide_by_pi=False, with_root=True), POSE.flatten())


def test_pose_is_zero_at_first_and_in_every_so_many_epochs_but_never_outside_of_training():
    options = {"zero_until": 10, "zero_every": 3}
    shown = [bool(seen(step, step // 5, **options).any()) for step in range(35)]
    assert shown == [step >= 10 and step // 5 % 3 != 0 for step in range(35)]
    assert seen(None, 0, **options).any()


def test_pose_is_zero_before_an_epoch_however_long_it_is():
    shown = [bool(seen(step, step // 7, zero_epochs=2).any()) for step in range(30)]
    assert shown == [step >= 14 for step in range(30)]


def test_pose_is_dropped_by_chance_as_often_as_asked_and_the_same_each_time():
    kept = [bool(seen(step, drop=0.2).any()) for step in range(1000)]
    assert 0.16 < 1 - sum(kept) / 1000 < 0.24
    assert kept == [bool(seen(step, drop=0.2).any()) for step in range(1000)]


@pytest.mark.parametrize("wrong", [{"drop": 1.5}, {"zero_every": -1}, {"refine_from": -1}])
def test_chances_and_steps_that_there_are_not_are_refused(wrong):
    with pytest.raises(ValueError, match=next(iter(wrong))):
        PoseConfig(**wrong)
