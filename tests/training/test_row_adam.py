"""Training with gradients of tables added up in rows against ordinary ones."""

from dataclasses import replace

import pytest
import torch
from small_recipes import CASES

from twofold.methods.subject import Subject
from twofold.training import loop
from twofold.training.row_adam import RowAdam, few_visits, noise_share


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


def visited(rates, gradients, start, shrinkage=0.0):
    """Frames' corrections trained by visits, one frame a step."""
    table = torch.nn.Parameter(start.clone())
    groups = [{"params": [table], "lr": rates, "name": "pose", "by_visit": True, "shrinkage": shrinkage}]
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
            pose = replace(method.pose, averages=averages, shrinkage=0.0)
            avatar = replace(method, pose=pose).build(Subject.of(person), 0)
            asked = {group.name for group in avatar.parameter_groups() if group.by_visit}
            assert asked == ({"pose"} if averages == "visits" else set())


def test_shrinkage_without_averages_of_visits_is_refused():
    with pytest.raises(ValueError, match="averages=visits; set shrinkage to 0 with other averages"):
        replace(CASES["quick"].method.pose, averages="steps", shrinkage=1.0)


def noise(generator, rows, mean):
    """Gradients of frames in turn: equal means with noise of unit size."""
    return [(step % rows, mean + torch.randn(23, 3, generator=generator)) for step in range(rows * 30)]


def share_of_signal(optimizer):
    sums = optimizer.state_dict()["state"][0]["signal_sums"]
    assert sums.shape == (2, 23)
    return sums[0] / sums[1]


@pytest.mark.parametrize(("mean", "share"), [(0.0, 0.0), (1.0, 0.5), (2.0, 0.8)])
@pytest.mark.parametrize(("rows", "visits"), [(16, 30), (300, 3)])
def test_share_of_signal_is_that_of_the_gradients_after_many_visits_and_after_three(mean, share, rows, visits):
    generator = torch.Generator().manual_seed(2)
    shown = [(step % rows, mean + torch.randn(23, 3, generator=generator)) for step in range(rows * visits)]
    _, optimizer = visited(0.001, shown, torch.zeros(rows, 23, 3), shrinkage=1.0)
    # Of three visits the mean square is known to a third only, which biases their ratio.
    assert share_of_signal(optimizer).mean() == pytest.approx(share, abs=0.12 if visits == 3 else 0.08)


def test_joints_without_a_gradient_in_most_frames_have_the_same_share():
    generator = torch.Generator().manual_seed(5)
    shown = [(step % 16, 1.0 + torch.randn(23, 3, generator=generator)) for step in range(16 * 30)]
    for frame, gradient in shown:
        if frame % 4:
            gradient[7] = 0.0
    _, optimizer = visited(0.001, shown, torch.zeros(16, 23, 3), shrinkage=1.0)
    assert share_of_signal(optimizer)[7] == pytest.approx(0.5, abs=0.12)


@pytest.mark.parametrize("visits", [1, 2, 5, 40])
def test_noise_share_is_that_of_weights_written_out(visits):
    """The variance of Adam's mean by its weights one by one, in double precision."""
    weights = torch.tensor([0.9 ** (visits - 1 - i) for i in range(visits)], dtype=torch.float64)
    weights = weights / weights.sum()
    found = noise_share(torch.tensor([float(visits)], dtype=torch.float64), 0.9)
    torch.testing.assert_close(found[0], weights.square().sum())


def test_frames_seen_three_times_still_move_where_visits_agree():
    """A long clip: many frames, few visits each."""
    generator = torch.Generator().manual_seed(6)
    moved = {}
    for mean in (0.0, 2.0):
        shown = [(step % 600, mean + torch.randn(23, 3, generator=generator)) for step in range(600 * 3)]
        full, shrunk = (visited(0.001, shown, torch.zeros(600, 23, 3), c)[0].square().mean().sqrt() for c in (0.0, 1.5))
        moved[mean] = float(shrunk / full)
    assert moved[2.0] > 0.1
    assert moved[0.0] < 0.05


def test_a_body_without_shapes_has_nothing_to_shrink():
    """As captures whose body was fitted elsewhere have it."""
    empty, table = torch.nn.Parameter(torch.zeros(0)), torch.nn.Parameter(torch.zeros(4, 23, 3))
    group = {"params": [empty, table], "lr": 0.001, "name": "pose", "by_visit": True, "shrinkage": 1.5}
    optimizer = RowAdam([group], {}, (0.9, 0.99), 1e-15)
    for _ in range(4):
        empty.grad, table.grad = torch.zeros(0), torch.ones(4, 23, 3)
        optimizer.step()
    assert table.detach().any()


def test_shape_numbers_shrink_together():
    generator = torch.Generator().manual_seed(7)
    moved = {}
    for mean in (0.0, 2.0):
        for shrinkage in (0.0, 1.5):
            table = torch.nn.Parameter(torch.zeros(10))
            group = {"params": [table], "lr": 0.001, "name": "pose", "by_visit": True, "shrinkage": shrinkage}
            optimizer = RowAdam([group], {}, (0.9, 0.99), 1e-15)
            for _ in range(300):
                table.grad = mean + torch.randn(10, generator=generator)
                optimizer.step()
            moved[mean, shrinkage] = table.detach().square().mean().sqrt()
    assert moved[0.0, 1.5] < 0.6 * moved[0.0, 0.0]
    assert moved[2.0, 1.5] > 0.7 * moved[2.0, 0.0]


def test_shrinkage_stops_noise_and_keeps_most_of_a_signal():
    start = torch.zeros(16, 23, 3)
    moved = {}
    for mean in (0.0, 1.0):
        for shrinkage in (0.0, 1.5):
            shown = noise(torch.Generator().manual_seed(3), 16, mean)
            moved[mean, shrinkage] = visited(0.001, shown, start, shrinkage)[0].square().mean().sqrt()
    assert moved[0.0, 1.5] < 0.1 * moved[0.0, 0.0]
    assert moved[1.0, 1.5] > 0.5 * moved[1.0, 0.0]


def test_each_joint_shrinks_by_its_own_noise():
    shown = noise(torch.Generator().manual_seed(4), 16, 0.0)
    for _, gradient in shown:
        gradient[5] += 1.0
    table, _ = visited(0.001, shown, torch.zeros(16, 23, 3), 1.5)
    size = table.square().mean((0, 2)).sqrt()
    assert size[5] > 10 * size[[joint for joint in range(23) if joint != 5]].max()


def test_resumed_shrinkage_repeats_the_steps(person, recipe, tmp_path, monkeypatch):
    pose = replace(recipe.method.pose, averages="visits", shrinkage=0.5, refine_from=0)
    recipe = replace(recipe, method=replace(recipe.method, pose=pose))
    whole = trained(person, recipe, tmp_path / "whole", 12, monkeypatch)
    trained(person, recipe, tmp_path / "parts", 9, monkeypatch)
    stored = (tmp_path / "parts" / "recipe.json").read_text()
    (tmp_path / "parts" / "recipe.json").write_text(stored.replace('"steps": 9', '"steps": 12'))
    parts = trained(person, recipe, tmp_path / "parts", 12, monkeypatch, resume=True)
    assert whole["refinement.body"].any()
    assert torch.equal(whole["refinement.body"], parts["refinement.body"])


def test_a_training_that_sees_poses_seldom_says_so(person, recipe, tmp_path):
    """`person` has frames of one camera; steps see one image."""
    times = len({frame.frame_index for frame in person.train})
    pose = replace(recipe.method.pose, averages="visits", shrinkage=1.5)
    method = replace(recipe.method, pose=pose)
    avatar = method.build(Subject.of(person), 0)

    def said(steps, avatar=avatar, images=1):
        training = replace(recipe.training, steps=steps, images_per_step=images)
        return few_visits(avatar.parameter_groups(), training, times)

    assert said(6 * times) is None
    assert said(2 * times, images=3) is None
    note = said(2 * times)
    assert f"seen 2 times in {2 * times} steps" in note
    assert f"--steps {10 * times} " in note
    assert f"--steps {5 * times} " in said(times, images=2)
    fixed = replace(method, pose=replace(pose, refine=())).build(Subject.of(person), 0)
    assert said(times, fixed) is None
    assert said(times, replace(method, pose=replace(pose, shrinkage=0.0)).build(Subject.of(person), 0)) is None
    spoken = []
    short = replace(recipe, method=method, training=replace(recipe.training, steps=2))
    loop.train(person, short, tmp_path / "run", torch.device("cpu"), say=spoken.append)
    assert few_visits(avatar.parameter_groups(), short.training, times) in spoken
