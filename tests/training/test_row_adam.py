"""Training with gradients of tables added up in rows against ordinary ones."""

from dataclasses import replace

import pytest
import torch
from small_recipes import CASES

from twofold.methods.subject import Subject
from twofold.training import loop
from twofold.training.row_adam import RowAdam


def trained(person, recipe, folder, steps, monkeypatch, rows=True, resume=False):
    with monkeypatch.context() as patch:
        if not rows:
            make = loop.make_optimizer
            patch.setattr(loop, "make_optimizer", lambda avatar, config, *_: make(avatar, config, alone=False))
        recipe = replace(recipe, training=replace(recipe.training, steps=steps, checkpoint_every=3, decay=1.0))
        return loop.train(person, recipe, folder, torch.device("cpu"), resume=resume).state_dict()


@pytest.fixture(scope="module")
def recipe():
    return CASES["quick"]


def test_rows_and_ordinary_gradients_train_the_same(person, recipe, tmp_path, monkeypatch):
    states = [trained(person, recipe, tmp_path / f"rows {rows}", 6, monkeypatch, rows) for rows in (True, False)]
    start = recipe.method.build(Subject.of(person), recipe.seed).state_dict()
    for name in ("field.low_grid.table", "field.high_grid.table"):
        mine, other = (state[name] for state in states)
        moved = (other - start[name]).abs().max()
        assert moved > 1e-3
        # A sign decides about Adam's first steps, and rounding about the sign of what is nearly zero.
        assert ((mine - other).abs() > 1e-3 * moved).float().mean() < 0.01
        assert torch.equal(mine == start[name], other == start[name])


def test_resumed_rows_repeat_the_steps(person, recipe, tmp_path, monkeypatch):
    whole = trained(person, recipe, tmp_path / "whole", 6, monkeypatch)
    trained(person, recipe, tmp_path / "parts", 3, monkeypatch)
    stored = (tmp_path / "parts" / "recipe.json").read_text()
    (tmp_path / "parts" / "recipe.json").write_text(stored.replace('"steps": 3', '"steps": 6'))
    parts = trained(person, recipe, tmp_path / "parts", 6, monkeypatch, resume=True)
    for name, tensor in whole.items():
        assert torch.equal(tensor, parts[name]), name


def test_operations_that_know_nothing_of_rows_are_added(person, recipe):
    avatar = recipe.method.build(Subject.of(person), 0)
    optimizer = loop.make_optimizer(avatar, recipe.training)
    table = avatar.field.high_grid.table
    before = table.detach().clone()
    (table[5].sum() * 2).backward()
    optimizer.step()
    assert (table - before)[5].abs().min() > 1e-6
    assert torch.equal(table[6:], before[6:])
    assert table.grad is None


def test_gradients_are_ordinary_ones_with_clipping_and_after_training(person, recipe):
    avatar = recipe.method.build(Subject.of(person), 0)
    loop.make_optimizer(avatar, replace(recipe.training, clip=1.0))
    assert avatar.field.high_grid.row_gradient is None
    loop.make_optimizer(avatar, recipe.training)
    assert avatar.field.high_grid.row_gradient is not None
    avatar.row_gradients(collect=False)
    assert avatar.field.high_grid.row_gradient is None


def visited(rates, gradients, start):
    """Frames' corrections trained by visits, one frame a step."""
    table = torch.nn.Parameter(start.clone())
    groups = [{"params": [table], "lr": rates, "name": "pose", "by_visit": True}]
    optimizer = RowAdam(groups, {}, (0.9, 0.99), 1e-15)
    for frame, gradient in gradients:
        table.grad = torch.zeros_like(table)
        table.grad[frame] = gradient
        optimizer.step()
    return table.detach(), optimizer


def test_a_frame_moves_only_in_steps_that_see_it():
    generator = torch.Generator().manual_seed(0)
    start = torch.zeros(4, 23, 3)
    shown = [(step % 3, torch.randn(23, 3, generator=generator)) for step in range(9)]
    table, optimizer = visited(0.01, shown, start)
    assert not table[3].any()
    before, _ = visited(0.01, shown[:-3], start)
    last, _ = visited(0.01, shown[:-2], start)
    assert torch.equal(before[1:], last[1:])
    assert not torch.equal(before[0], last[0])
    assert optimizer.state_dict()["state"][0]["visits"].tolist() == [3, 3, 3, 0]
    # As if each frame had an optimizer of its own.
    for frame in range(3):
        own = torch.nn.Parameter(torch.zeros(23, 3))
        apart = torch.optim.Adam([own], lr=0.01, betas=(0.9, 0.99), eps=1e-15)
        for which, gradient in shown:
            if which == frame:
                own.grad = gradient
                apart.step()
        torch.testing.assert_close(table[frame], own.detach())


def test_noise_moves_a_frame_less_by_visits_than_by_steps():
    """A frame is seen in one of 64 steps; its gradients are noise around nothing."""
    generator = torch.Generator().manual_seed(1)
    shown = [(step % 64, torch.randn(8, generator=generator)) for step in range(64 * 30)]
    start = torch.zeros(64, 8)
    by_visits, _ = visited(0.001, shown, start)
    table = torch.nn.Parameter(start.clone())
    optimizer = RowAdam([{"params": [table], "lr": 0.001, "name": "pose"}], {}, (0.9, 0.99), 1e-15)
    for frame, gradient in shown:
        table.grad = torch.zeros_like(table)
        table.grad[frame] = gradient
        optimizer.step()
    assert by_visits.std() < 0.2 * table.detach().std()


def test_quick_and_vid2avatar_ask_for_visits_of_poses_where_the_recipe_does(person):
    for name in ("quick", "vid2avatar"):
        for averages in ("steps", "visits"):
            method = CASES[name].method
            avatar = replace(method, pose=replace(method.pose, averages=averages)).build(Subject.of(person), 0)
            asked = {group.name for group in avatar.parameter_groups() if group.by_visit}
            assert asked == ({"pose"} if averages == "visits" else set())
