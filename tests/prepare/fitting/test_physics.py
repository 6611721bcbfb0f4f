"""Standing and balance: against plain arithmetic, gradients against differences, and what is believed of them."""

from dataclasses import replace

import pytest
import torch
from acting import acted, the_body, with_numbers

from twofold.body.balance import GRAVITY, center_of_mass
from twofold.prepare.fitting import physics
from twofold.prepare.fitting.body_landmarks import body_points
from twofold.prepare.fitting.footing import SOLES
from twofold.prepare.fitting.parameters import pose_motion
from twofold.prepare.fitting.physics import PhysicsWeights, Support, limited

UP = torch.tensor([0.0, -1.0, 0.0], dtype=torch.float64)


def random(*shape, seed=0):
    return torch.randn(shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def both(frames, carries=1.0):
    return Support(torch.ones(frames, 2, dtype=torch.float64), torch.full((frames,), carries, dtype=torch.float64))


def test_slopes_and_directions_are_one_another():
    slope = torch.tensor([0.3, -0.4])
    up = physics.up_of(slope)
    assert float(up.norm()) == pytest.approx(1)
    assert float(up[1]) < 0
    torch.testing.assert_close(physics.slope_of(up), slope)


def test_large_errors_pull_less_and_less():
    errors = torch.tensor([0.0, 0.1, 5.0, 10.0, 20.0], dtype=torch.float64, requires_grad=True)
    costs = limited(errors)
    costs.sum().backward()
    costs = costs.detach()
    assert float(costs[0]) == 0
    assert float(costs[1]) == pytest.approx(0.005, rel=0.02)
    assert float(costs[-1]) < 8
    slopes = errors.grad.tolist()
    assert slopes[2] > slopes[3] > slopes[4] > 0


def test_level_soles_cost_nothing_and_a_raised_one_does():
    sole = random(5, 2, 2, 3)
    sole[..., 1] = 0.3
    stands = torch.ones(5, 2, dtype=torch.float64)
    assert float(physics.level_term(sole, stands, UP, 0.02)) == pytest.approx(0, abs=1e-9)
    raised = sole.clone()
    raised[2, 1, :, 1] -= 0.2
    assert float(physics.level_term(raised, stands, UP, 0.02)) > 1
    stands[2, 1] = 0
    assert float(physics.level_term(raised, stands, UP, 0.02)) == pytest.approx(0, abs=1e-9)


def standing_body(lean=0.0, frames=6):
    """Joints and soles of a body that leans ahead as a whole, its feet on the floor, the image's y down."""
    body = with_numbers(the_body())
    c, s = torch.cos(torch.tensor(lean)).double(), torch.sin(torch.tensor(lean)).double()
    turn = torch.eye(3, dtype=torch.float64)
    turn[1, 1], turn[1, 2], turn[2, 1], turn[2, 2] = c, -s, s, c
    sole = body_points(the_body()).place.double()[SOLES].repeat(frames, 1, 1, 1)
    about = sole[0].mean((0, 1))
    joints = ((body.joints - about) @ turn.T + about)[None].repeat(frames, 1, 1)
    flip = torch.tensor([1.0, -1.0, -1.0], dtype=torch.float64)
    return joints * flip, sole * flip


@pytest.mark.parametrize(("lean", "falls"), [(0.0, False), (0.35, True), (-0.35, True)])
def test_a_body_that_leans_far_falls(lean, falls):
    joints, sole = standing_body(lean)
    error = PhysicsWeights().balance
    assert (float(physics.balance_term(joints, sole, both(6), UP, 10.0, error)) > 0.5) is falls
    # Where something else may hold it nothing is said.
    assert float(physics.balance_term(joints, sole, both(6, 0.0), UP, 10.0, 0.05)) == 0


def test_somebody_who_speeds_up_may_lean():
    joints, sole = standing_body(0.35)
    seconds = torch.arange(6, dtype=torch.float64) / 10
    # Towards where the body leans, as fast as the lean needs: a cart on a table.
    off = center_of_mass(joints)[0] - sole[0].mean((0, 1))
    level = off - (off @ UP) * UP
    path = 0.5 * GRAVITY * seconds[:, None] ** 2 * level / (off @ UP)
    # At both ends there is no acceleration to be had.
    support = both(6)
    support.carries[[0, 1, 4, 5]] = 0
    moving = physics.balance_term(joints + path[:, None], sole + path[:, None, None], support, UP, 10.0, 0.05)
    still = physics.balance_term(joints, sole, support, UP, 10.0, 0.05)
    assert float(moving) < 0.02
    assert float(still) > 0.3


def test_one_foot_in_the_air_is_no_support():
    joints, sole = standing_body()
    far = joints + torch.tensor([0.25, 0.0, 0.0], dtype=torch.float64) * torch.sign(sole[0, 1, 0, 0] - sole[0, 0, 0, 0])
    one = both(6)
    one.stands[:, 1] = 0
    assert float(physics.balance_term(far, sole, one, UP, 10.0, 0.05)) > 1.5 * float(
        physics.balance_term(far, sole, both(6), UP, 10.0, 0.05)
    )


@pytest.mark.parametrize("term", ["level", "balance", "whole"])
def test_gradients_are_right(term):
    sole, joints, slope = random(5, 2, 2, 3), random(5, 24, 3, seed=1), 0.1 * random(2, seed=2)
    stands = torch.tensor([[1, 1], [1, 0], [0, 1], [1, 1], [0, 0]], dtype=torch.float64)
    support = Support(stands, torch.tensor([1.0, 0.5, 0.2, 1.0, 0.0], dtype=torch.float64))
    if term == "level":
        # The weights by which the level is found are held fixed in its gradient; here all are alike.
        flat = 1e-3 * sole

        def loss(x):
            return physics.level_term(x, torch.ones(5, 2, dtype=torch.float64), UP, 0.1)

        assert torch.autograd.gradcheck(loss, (flat.requires_grad_(),), atol=1e-4)
    elif term == "balance":
        level = sole.clone()
        level[..., 1] = 0.3

        def loss(j):
            return physics.balance_term(j, level, support, UP, 10.0, 0.1)

        assert torch.autograd.gradcheck(loss, (joints.requires_grad_(),))
    else:
        body, points = with_numbers(the_body()), with_numbers(body_points(the_body()))
        motion = with_numbers(acted(the_body(), 5))

        def loss(translation):
            moved = replace(motion, translation=translation, slope=slope)
            weights = PhysicsWeights()
            return physics.physics_term(body, pose_motion(body, moved), points, moved, support, 10.0, weights)

        # Moved as a whole nothing but the acceleration changes.
        along = torch.ones(5, 3, dtype=torch.float64)
        a, b = (float(loss(motion.translation + k * along)) for k in (0.0, 1.0))
        assert a == pytest.approx(b, rel=1e-6)


def test_a_vertical_far_off_the_body_or_soles_on_no_level_are_not_believed():
    body, points = the_body(), body_points(the_body())
    motion = acted(body, 6)
    still = replace(
        motion, guess=torch.diag(torch.tensor([1.0, -1.0, -1.0])).expand(6, 3, 3).clone(),
        pose=torch.zeros(6, 23, 3), translation=torch.zeros(6, 3),
    )  # fmt: skip
    support = Support(torch.ones(6, 2), torch.ones(6))

    def believed(motion):
        return physics.believable(body, pose_motion(body, motion), points, motion, support)

    assert believed(still)
    assert believed(replace(still, slope=torch.tensor([0.1, -0.2])))
    assert not believed(replace(still, slope=torch.tensor([1.2, 0.0])))
    jumps = torch.zeros(6, 3)
    jumps[::2, 1] = 0.3
    assert not believed(replace(still, translation=jumps))
