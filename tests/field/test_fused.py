"""The field as one compiled operation against the same field in PyTorch, in double precision."""

from dataclasses import replace

import pytest
import torch
from test_factorized_grid import BODY, POSE_SIZE, SMALL, make, off_the_start, parameter_gradients

from twofold.field.fused_tile_kernels import TILE

QUADS = replace(SMALL, features=4)


@pytest.fixture
def threads():
    before = torch.get_num_threads()
    yield torch.set_num_threads
    torch.set_num_threads(before)


def points(count):
    generator = torch.Generator().manual_seed(3)
    which = torch.randint(len(BODY.vertices), (count,), generator=generator)
    x = BODY.vertices[which] + 0.03 * torch.randn(count, 3, generator=generator)
    turns = torch.eye(3) + 0.3 * torch.randn(count, 3, 3, generator=generator)
    return x, torch.randn(POSE_SIZE, generator=generator), turns


def trained_by(field, x, pose, turns):
    """Gradients of a loss on everything that is differentiable: by the points and by the parameters."""
    x = x.clone().requires_grad_()
    out = field(x, pose, turns)
    s, g = field.distance_and_gradient(x, pose)
    loss = torch.sin(20 * out.sdf).mean() + torch.cos(2 * out.color).mean() + torch.sin(9 * out.base.sdf).mean()
    loss = loss + (out.base.color**2).mean() + ((g.norm(dim=-1) - 1) ** 2).mean() + torch.cos(11 * s).mean()
    return {"x": torch.autograd.grad(loss, x, retain_graph=True)[0], **parameter_gradients(field, loss)}


def partly_observed(field):
    """The field with a measure of observation that changes from node to node."""
    field.make_observable()
    observed = field.get_buffer("observed")
    field.load_state_dict({"observed": torch.linspace(-1, 2, len(observed)).clamp(0, 1)}, strict=False)
    return field


@pytest.mark.parametrize("config", [SMALL, QUADS], ids=["two features", "four features"])
@pytest.mark.parametrize(
    ("count", "change"), [(1, lambda f: f), (TILE, lambda f: f), (2 * TILE + 37, lambda f: f), (99, partly_observed)]
)
def test_values_and_gradients_of_any_number_of_samples_are_those_of_the_twin(count, change, config):
    field, twin = change(off_the_start(make(config))), change(off_the_start(make(config))).double()
    x, pose, turns = points(count)
    found, expected = trained_by(field, x, pose, turns), trained_by(twin, x.double(), pose.double(), turns.double())
    for name, gradient in expected.items():
        error = (found[name].double() - gradient).abs().max()
        assert gradient.any(), name
        assert error <= 2e-3 * float(gradient.abs().max()), name


def test_two_threads_share_the_samples(threads):
    field = off_the_start(make(SMALL))
    x, pose, turns = points(5000)
    threads(1)
    one = trained_by(field, x, pose, turns), field(x, pose, turns).color
    threads(2)
    two = trained_by(field, x, pose, turns), field(x, pose, turns).color
    assert torch.equal(one[1], two[1])
    torch.testing.assert_close(one[0], two[0], rtol=1e-3, atol=1e-6)


def test_gradient_does_not_depend_on_the_samples_beside_it():
    """What lies behind the last sample of a tile is left over from the tile before; it must not be counted."""
    field = off_the_start(make(SMALL))
    x, pose, turns = points(TILE + 5)
    whole = trained_by(field, x, pose, turns)["x"] * len(x)
    last = trained_by(field, x[TILE:], pose, turns[TILE:])["x"] * 5
    torch.testing.assert_close(whole[TILE:], last)


def test_a_parameter_changed_before_the_reverse_pass_is_noticed():
    field = off_the_start(make(QUADS))
    x, pose, turns = points(10)
    color = field(x, pose, turns).color.sum()
    with torch.no_grad():
        field.low_grid.table.mul_(2)
    with pytest.raises(RuntimeError, match="modified"):
        color.backward()
