"""The grid that follows a field while it is trained."""

import pytest
import torch
from little_body import ball
from small_recipes import CASES

from twofold.geometry.cameras import pixel_grid, pixel_rays
from twofold.methods.base import Mode
from twofold.methods.subject import Subject
from twofold.sampling import training_grid
from twofold.sampling.training_grid import TrainingGrid, add_residuals

POINTS = torch.from_numpy(ball()[0])
CENTER, RADIUS = POINTS.mean(0), float((POINTS - POINTS.mean(0)).norm(dim=1).mean())


def sphere(x, grown=0.0):
    return (x - CENTER).norm(dim=-1) - RADIUS - grown


def near(count, generator):
    return POINTS[torch.randint(len(POINTS), (count,), generator=generator)] + 0.01 * torch.randn(
        count, 3, generator=generator
    )


@pytest.fixture
def grid():
    grid = TrainingGrid(POINTS, 0.02, 0.06)
    grid.refresh(sphere)
    return grid


def test_before_the_first_query_there_is_no_grid():
    grid = TrainingGrid(POINTS, 0.02, 0.06)
    assert grid.grid is None
    grid.record(POINTS, torch.zeros(len(POINTS)))
    assert grid.grid is None


def test_its_distances_are_the_fields_and_its_error_covers_most_differences(grid, generator):
    x = near(5000, generator)
    off = (grid.grid.interpolate(x) - sphere(x)).abs()
    assert 0 < grid.grid.error < 0.005
    assert (off < grid.grid.error).float().mean() > 0.9


def test_it_follows_a_field_that_moves(grid, generator):
    """A surface that moves by a centimetre: wherever the field is asked the grid learns it, and so does its error."""
    before = grid.grid.error
    errors = []
    for step in range(60):
        x = near(400, generator)
        grid.record(x, sphere(x, grown=0.01 * min(step / 30, 1)))
        grid.settle()
        errors.append(grid.grid.error)
    x = near(2000, generator)
    assert (grid.grid.interpolate(x) - sphere(x, grown=0.01)).abs().mean() < 0.0015
    assert max(errors) > 1.2 * before
    assert errors[-1] < max(errors)


def test_a_recorded_distance_corrects_it(grid):
    x = POINTS[:50] + 0.003
    recorded = grid.recording(lambda x: sphere(x, grown=0.005))
    torch.testing.assert_close(recorded(x), sphere(x, grown=0.005))
    grid.settle()
    assert (grid.grid.interpolate(x) - sphere(x, grown=0.005)).abs().mean() < 0.003


def test_residuals_are_those_of_the_twin_in_torch(grid, generator):
    x = torch.cat([near(300, generator), torch.tensor([[9.0, 9.0, 9.0]])])
    sdf = sphere(x, grown=0.004)
    ours, twin = add_residuals(grid.grid, x, sdf), add_residuals(grid.grid, x.double(), sdf)
    assert ours[2][1] == 300
    for one, other in zip(ours, twin, strict=True):
        torch.testing.assert_close(one, other, atol=1e-6, rtol=1e-4)
    once = [tensor.clone() for tensor in ours]
    again = add_residuals(grid.grid, x, sdf, ours)
    for one, other in zip(again, once, strict=True):
        torch.testing.assert_close(one, 2 * other)


def test_it_follows_a_field_of_double_precision():
    grid = TrainingGrid(POINTS, 0.02, 0.06).double()
    grid.refresh(sphere)
    x = POINTS[:50].double() + 0.003
    grid.record(x, sphere(x, grown=0.005))
    grid.settle()
    assert (grid.grid.interpolate(x) - sphere(x, grown=0.005)).abs().mean() < 0.003


def test_points_beyond_the_grid_change_nothing(grid):
    before = grid.values.clone(), grid.error.clone()
    grid.record(torch.full((3, 3), 9.0), torch.zeros(3))
    grid.settle()
    assert torch.equal(grid.values, before[0])
    assert torch.equal(grid.error, before[1])


def test_a_process_whose_rays_all_miss_takes_part_in_the_sums_of_the_others(grid, monkeypatch):
    summed = []
    monkeypatch.setattr(training_grid, "summed_over_processes", lambda tensor: summed.append(tensor.shape) or tensor)
    before = grid.values.clone()
    grid.settle()
    assert summed == [grid.values.shape, grid.values.shape, (2,)]
    assert torch.equal(grid.values, before)


def test_it_is_queried_more_often_at_the_beginning(grid):
    assert [step for step in range(601) if grid.is_due(step)] == [0, 1, 2, 4, 8, 16, 32, 64, 128, 200, 400, 600]


def test_its_state_is_that_of_the_avatar_and_old_states_begin_without(person):
    avatar = CASES["quick"].method.build(Subject.of(person))
    avatar.before_step(Mode(0))
    assert avatar.search.grid is not None
    state = avatar.state_dict()
    assert torch.equal(state["search.values"], avatar.search.values)
    other = CASES["quick"].method.build(Subject.of(person), seed=1)
    old = {name: t for name, t in state.items() if not name.startswith("search.")}
    other.load_stored(old)
    other.load_state_dict(old)
    assert other.search.grid is None
    other.load_state_dict(state)
    assert other.search.grid.error == avatar.search.grid.error
    assert all(t.isfinite().all() for t in state.values() if t.is_floating_point())


def test_evaluation_does_not_use_it(person, monkeypatch):
    avatar = CASES["quick"].method.build(Subject.of(person))
    avatar.before_step(Mode(0))
    monkeypatch.setattr(avatar.search, "recording", lambda distance: pytest.fail("asked"))
    frame = person.train[0]
    rays = pixel_rays(frame.camera, pixel_grid(frame.camera).flatten(0, 1)[:50])
    with torch.no_grad():
        avatar.render(rays, avatar.pose(frame.pose, frame.translation), torch.zeros(3))
