"""Where a body's weight is, against plain arithmetic."""

import pytest
import torch
from little_body import little_body

from twofold.body.balance import GRAVITY, MASS, center_of_mass, center_of_pressure
from twofold.body.skeleton import JOINT_NAMES

UP = torch.tensor([0.0, -1.0, 0.0], dtype=torch.float64)
FLOOR = torch.zeros((), dtype=torch.float64)


def test_masses_are_a_whole_body_and_its_center_lies_in_the_trunk():
    joints = little_body().joints
    assert sum(MASS.get(name.split("_")[-1], 0.0) for name in JOINT_NAMES) == pytest.approx(1, abs=0.01)
    center = center_of_mass(joints[None])[0]
    assert joints[JOINT_NAMES.index("left_hip"), 1] - 0.05 < center[1] < joints[JOINT_NAMES.index("spine3"), 1]
    torch.testing.assert_close(center_of_mass(joints[None] + 1)[0], center + 1)
    literal = sum(MASS.get(name.split("_")[-1], 0.0) * joints[k] for k, name in enumerate(JOINT_NAMES))
    torch.testing.assert_close(center, literal, atol=0.01, rtol=0)


@pytest.mark.parametrize("frames", [1, 2, 40])
def test_the_point_of_zero_moment_is_below_what_rests(frames):
    rest = torch.tensor([[0.2, -1.0, 3.0]], dtype=torch.float64).repeat(frames, 1)
    below = center_of_pressure(rest, FLOOR, UP, 20.0)
    torch.testing.assert_close(below, torch.tensor([[0.2, 0.0, 3.0]], dtype=torch.float64).expand(frames, 3))


def test_the_point_of_zero_moment_lags_what_speeds_up_as_a_cart_on_a_table():
    """x - z x'' / g."""
    seconds = torch.arange(40, dtype=torch.float64) / 20
    center = torch.tensor([[0.2, -1.0, 3.0]], dtype=torch.float64).repeat(40, 1)
    center[:, 0] += 0.5 * 2.0 * seconds**2
    lagging = center_of_pressure(center, FLOOR, UP, 20.0)[10:-10]
    torch.testing.assert_close(lagging[:, 0], center[10:-10, 0] - 2.0 / GRAVITY, atol=1e-6, rtol=0)


def test_gradients_are_right():
    center = torch.randn(8, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    assert torch.autograd.gradcheck(lambda c: center_of_pressure(c, FLOOR, UP, 5.0), center.requires_grad_())
