"""Distances tabulated while training find the samples that the field itself would find."""

from dataclasses import replace

import pytest
import torch
from small_recipes import CASES

from twofold.geometry.cameras import pixel_grid, pixel_rays
from twofold.methods.base import Mode
from twofold.methods.subject import Subject
from twofold.sampling.placement import FieldQuery
from twofold.sampling.training_grid import VOXEL, TrainingGrid
from twofold.training.loop import train
from twofold.training.run import load, read_checkpoint

BODY = torch.tensor([[0.0, 0.0, 0.0], [0.3, 0.0, 0.0]])
CPU = torch.device("cpu")


def plane(at):
    """The distance to a plane, metres."""
    return lambda x: x[:, 0] - at


def test_two_tables_give_the_error_to_expect():
    table = TrainingGrid(BODY, 0.09, 50)
    assert table.grid() is None
    table.refresh(plane(0.1))
    assert table.grid() is None  # Of a single one nothing is known of its error.
    table.refresh(plane(0.104))
    grid = table.grid()
    assert grid.error == pytest.approx(0.004, abs=1e-4)
    x = torch.rand(100, 3, generator=torch.Generator().manual_seed(0)) * 0.06
    torch.testing.assert_close(grid.interpolate(x), plane(0.104)(x), atol=1e-4, rtol=0)
    assert grid.interpolate(torch.tensor([[0.0, 0.5, 0.0]])).isnan().all()
    table.refresh(plane(0.104))
    assert table.grid().error == pytest.approx(0, abs=1e-4)


def test_the_error_is_that_of_nodes_near_the_surface():
    table = TrainingGrid(BODY, 0.09, 50)
    table.refresh(plane(0.1))
    # Far from the surface the field may change as it likes.
    table.refresh(lambda x: torch.where((x[:, 0] - 0.1).abs() < 2 * VOXEL, plane(0.101)(x), plane(-5)(x)))
    assert float(table.error) == pytest.approx(0.001, abs=1e-4)


def test_tables_that_disagree_rule_nothing_out():
    table = TrainingGrid(BODY, 0.09, 50)
    for at in (0.1, 0.2):
        table.refresh(plane(at))
    assert table.grid() is None
    assert all(tensor.isfinite().all() for tensor in table.state_dict().values())


def test_a_field_without_a_surface_rules_nothing_out():
    table = TrainingGrid(BODY, 0.09, 50)
    for _ in range(2):
        table.refresh(lambda x: 1 + x[:, 0])
    assert table.grid() is None


def test_it_is_due_every_so_many_steps():
    table = TrainingGrid(BODY, 0.09, 3)
    assert [step for step in range(10) if table.is_due(step)] == [3, 6, 9]


def test_a_stored_table_is_the_same_again_and_one_of_another_grid_is_given_up():
    table, other = TrainingGrid(BODY, 0.09, 50), TrainingGrid(BODY, 0.09, 50)
    for at in (0.1, 0.101):
        table.refresh(plane(at))
    assert other.grid() is None
    other.load_state_dict(table.state_dict())
    assert torch.equal(other.grid().values, table.grid().values)
    assert other.grid().error == table.grid().error
    wider = TrainingGrid(2 * BODY, 0.09, 50)
    state = {f"grid.{name}": tensor for name, tensor in table.state_dict().items()}
    wider.take_on(state, "grid.")
    wider.load_state_dict({name.removeprefix("grid."): tensor for name, tensor in state.items()})
    assert wider.grid() is None


@pytest.fixture(scope="module")
def recipe():
    """Steps after which the two tables agree, so that the last ones use them."""
    small = CASES["quick"]
    sampler = replace(small.method.sampler, training_grid_every=20)
    training = replace(small.training, steps=90, preview_every=0, checkpoint_every=65)
    return replace(small, method=replace(small.method, sampler=sampler), training=training)


@pytest.fixture(scope="module")
def avatar(person, recipe, tmp_path_factory):
    """A small avatar trained so."""
    return train(person, recipe, tmp_path_factory.mktemp("grid") / "run", CPU)


def test_training_finds_nearly_the_samples_that_queries_find(avatar, person):
    frame = person.train[1]
    grid = avatar.training_grid.grid()
    assert grid.error < 0.01
    mode = Mode(90)
    with torch.no_grad():
        posed = avatar.pose(frame.pose, frame.translation, frame.frame_index, mode)
        rays = pixel_rays(frame.camera, pixel_grid(frame.camera).flatten(0, 1))
        query = FieldQuery(avatar.field.sdf_at(posed.own.condition), avatar.beta)
        exact, found = (
            avatar._sampler.place(rays, posed.own.surface, each, True, torch.Generator().manual_seed(0))
            for each in (query, replace(query, recent_grid=grid))
        )
    keys = [
        set(zip(placed.samples.ray_index.tolist(), placed.samples.depth.tolist(), strict=True))
        for placed in (exact, found)
    ]
    assert len(keys[0]) > 500
    assert len(keys[0] - keys[1]) <= 0.03 * len(keys[0])
    assert len(keys[1] - keys[0]) <= 0.05 * len(keys[0])


def test_fewer_samples_are_queried(avatar, person, monkeypatch):
    frame, counts = person.train[1], []
    sdf_at = avatar.field.sdf_at

    def counting(pose):
        distance = sdf_at(pose)
        return lambda x: counts.append(len(x)) or distance(x)

    monkeypatch.setattr(avatar.field, "sdf_at", counting)
    rays = pixel_rays(frame.camera, pixel_grid(frame.camera).flatten(0, 1))
    asked = []
    for known in (True, False):
        counts.clear()
        if not known:
            monkeypatch.setattr(avatar.training_grid, "grid", lambda: None)
        posed = avatar.pose(frame.pose, frame.translation, frame.frame_index, Mode(90))
        with torch.no_grad():
            avatar.place(rays, posed, Mode(90), torch.Generator().manual_seed(0))
        asked.append(sum(counts))
    assert 0 < asked[0] < 0.8 * asked[1]


def test_a_resumed_run_repeats_the_steps_that_used_the_table(avatar, person, recipe, tmp_path):
    class Stop(Exception):
        """Stands for whatever ends a run between two checkpoints."""

    def on_step(progress):
        if progress.step == 70:
            raise Stop

    with pytest.raises(Stop):
        train(person, recipe, tmp_path / "cut", CPU, progress=on_step)
    resumed = train(person, recipe, tmp_path / "cut", CPU, resume=True)
    for name, tensor in avatar.state_dict().items():
        assert torch.equal(tensor, resumed.state_dict()[name]), name


def test_it_is_stored_with_the_run(avatar, person, recipe, tmp_path):
    train(person, replace(recipe, training=replace(recipe.training, steps=41)), tmp_path / "run", CPU)
    stored = read_checkpoint(tmp_path / "run")[0]
    again, _ = load(tmp_path / "run")
    assert torch.equal(stored["avatar.training_grid.values"], again.training_grid.values)


def test_no_table_is_made_where_none_is_asked_for(person, recipe):
    method = replace(recipe.method, sampler=replace(recipe.method.sampler, training_grid_every=0))
    assert method.build(Subject.of(person)).training_grid is None
    with pytest.raises(ValueError, match="training_grid_every"):
        replace(recipe.method.sampler, training_grid_every=-1)
