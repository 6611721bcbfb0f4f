"""Training with gradients of tables added up in rows against ordinary ones."""

from dataclasses import replace

import pytest
import torch
from small_recipes import CASES

from twofold.methods.subject import Subject
from twofold.training import loop


def trained(person, recipe, folder, steps, monkeypatch, rows=True, resume=False):
    with monkeypatch.context() as patch:
        if not rows:
            make = loop.make_optimizer
            patch.setattr(loop, "make_optimizer", lambda avatar, config, alone: make(avatar, config, alone=False))
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
