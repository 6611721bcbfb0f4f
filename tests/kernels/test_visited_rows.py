"""Rows with visits of their own: the compiled loop against the same in PyTorch, and the optimizer with either."""

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from twofold.kernels.visited_rows import visited_rows
from twofold.training import row_adam
from twofold.training.row_adam import POOLED_VISITS, RowAdam, visited_rows_in_torch

SHAPES = [(10,), (1,), (7, 3), (5, 1), (5, 1, 3), (6, 23, 3), (4, 2, 3, 2)]
RATE = 0.01


def begin(shape, shrinks):
    """A table, both means, visits and sums, before the first step."""
    table = torch.randn(shape, generator=torch.Generator().manual_seed(4))
    sums = torch.zeros(2, *shape[1:-1]) if shrinks else None
    return [table, torch.zeros(shape), torch.zeros(shape), torch.zeros(shape[0]), sums]


def step(how, state, gradient, shrinkage=1.5, betas=(0.9, 0.99), epsilon=1e-15, pooled=POOLED_VISITS):
    table, first, second, visits, sums = state
    how(table, first, second, gradient, visits, sums, RATE, betas, epsilon, shrinkage, pooled)


def assert_same(state, other, start):
    (table, *means, visits, sums), (table2, *means2, visits2, sums2) = state, other
    assert torch.equal(visits, visits2)
    torch.testing.assert_close(table - start, table2 - start, rtol=1e-5, atol=1e-6, equal_nan=True)
    torch.testing.assert_close(means, means2, rtol=1e-5, atol=1e-7, equal_nan=True)
    if sums is None:
        assert sums2 is None
    else:
        torch.testing.assert_close(sums, sums2, rtol=1e-5, atol=1e-5, equal_nan=True)


def gradients(shape, steps, seed, seen, mean=1.0):
    """Gradients of which each step sees other rows, some with numbers and whole entries without one."""
    generator = torch.Generator().manual_seed(seed)
    values = mean + torch.randn(steps, *shape, generator=generator)
    values[torch.rand(values.shape, generator=generator) < 0.1] = 0
    values[torch.rand(values.shape[:-1], generator=generator) < 0.1] = 0
    values[torch.rand(values.shape[:2], generator=generator) >= seen] = 0
    return values


@given(
    st.sampled_from(SHAPES),
    st.integers(1, 40),
    st.sampled_from([0.05, 0.3, 1.0]),
    st.sampled_from([None, 0.5, 1.5, 4.0]),
    st.sampled_from([(0.9, 0.99), (0.5, 0.9)]),
    st.sampled_from([0.2, 3.0, POOLED_VISITS]),
    st.integers(0, 1000),
)
def test_the_loop_makes_the_steps_of_pytorch(shape, steps, seen, shrinkage, betas, pooled, seed):
    mine, other = (begin(shape, shrinkage is not None) for _ in range(2))
    start = mine[0].clone()
    for values in gradients(shape, steps, seed, seen):
        kept = values.clone()
        for how, state in ((visited_rows, mine), (visited_rows_in_torch, other)):
            step(how, state, values, shrinkage or 0.0, betas, pooled=pooled)
        assert torch.equal(values, kept)
        assert_same(mine, other, start)


def test_the_examples_shrink_and_move():
    """Shares of signal below and above what stops a step: else shrinkage could be anything above."""
    states = [begin((6, 23, 3), True) for _ in range(2)]
    for values in gradients((6, 23, 3), 60, 0, 0.3, mean=0.3):
        for how, state in zip((visited_rows, visited_rows_in_torch), states, strict=True):
            step(how, state, values)
    share = states[0][4][0] / (states[0][4][1] + 1)
    stopped = 1.5 / (1 + share * 18) >= 1
    assert stopped.any()
    assert not stopped.all()
    assert_same(*states, begin((6, 23, 3), True)[0])


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("shrinks", [False, True])
def test_without_a_gradient_nothing_changes(shape, shrinks):
    state = begin(shape, shrinks)
    for values in gradients(shape, 3, 1, 1.0):
        step(visited_rows, state, values)
    before = [None if tensor is None else tensor.clone() for tensor in state]
    step(visited_rows, state, torch.zeros(shape))
    step(visited_rows, state, -torch.zeros(shape))
    for tensor, kept in zip(state, before, strict=True):
        assert tensor is kept is None or torch.equal(tensor, kept)


@pytest.mark.parametrize(
    "arranged",
    [
        lambda values: values.transpose(0, 2).contiguous().transpose(0, 2),
        lambda values: values.repeat(1, 2, 1)[:, ::2],
        lambda values: values[:, :1, :1].expand(values.shape),
        lambda values: values.flip(0),
    ],
)
def test_gradients_lie_in_memory_in_any_order(arranged):
    states = [begin((6, 23, 3), True) for _ in range(2)]
    for values in gradients((6, 23, 3), 4, 2, 0.6):
        step(visited_rows, states[0], arranged(values))
        step(visited_rows_in_torch, states[1], arranged(values).clone(memory_format=torch.contiguous_format))
    assert_same(*states, begin((6, 23, 3), True)[0])


@pytest.mark.parametrize(("betas", "epsilon"), [((0.9, 0.99), 0.0), ((0.0, 0.99), 1e-8), ((0.9, 0.0), 1e-8)])
def test_what_is_no_number_stays_so(betas, epsilon):
    """A division of 0 by 0 and a gradient that is no number give what they give in PyTorch, without an error."""
    states = [begin((6, 2, 3), True) for _ in range(2)]
    shown = gradients((6, 2, 3), 6, 3, 0.6)
    shown[:, :, 1, 2] = 0
    shown[3, 2, 0, 1] = torch.nan
    for values in shown:
        for how, state in zip((visited_rows, visited_rows_in_torch), states, strict=True):
            step(how, state, values, betas=betas, epsilon=epsilon)
    assert states[0][0].isnan().any()
    assert_same(*states, begin((6, 2, 3), True)[0])


def trained(start, shown, shrinkage):
    tables = [torch.nn.Parameter(table.clone()) for table in start]
    group = {"params": tables, "lr": RATE, "name": "pose", "by_visit": True, "shrinkage": shrinkage}
    optimizer = RowAdam([group], {}, (0.9, 0.99), 1e-15)
    for values in shown:
        for table, gradient in zip(tables, values, strict=True):
            table.grad = gradient.clone()
        optimizer.step()
        assert all(table.grad is None for table in tables if table.dim() > 1 or shrinkage)
    return [table.detach() for table in tables], optimizer.state_dict()["state"]


def refused(*_):
    raise AssertionError("the other form was expected")


@pytest.mark.parametrize("shrinkage", [0.0, 1.5])
def test_the_optimizer_keeps_the_same_state_with_both(shrinkage, monkeypatch):
    shapes = [(5, 1, 3), (5, 23, 3), (5, 3), (10,)]
    start = [torch.zeros(shape) for shape in shapes]
    shown = list(zip(*(gradients(shape, 12, 5, 0.4) for shape in shapes), strict=True))
    with monkeypatch.context() as patch:
        patch.setattr(row_adam, "visited_rows_in_torch", refused)
        mine, state = trained(start, shown, shrinkage)
    with monkeypatch.context() as patch:
        patch.setattr(row_adam, "visited_rows", visited_rows_in_torch)
        other, state2 = trained(start, shown, shrinkage)
    torch.testing.assert_close(mine, other, rtol=1e-5, atol=1e-6)
    names = ["step", "exp_avg", "exp_avg_sq", "visits", *(["signal_sums"] if shrinkage else [])]
    for index, shape in enumerate(shapes):
        by_visit = len(shape) > 1 or shrinkage
        assert list(state[index]) == list(state2[index]) == (names if by_visit else names[:3])
        for name, tensor in state[index].items():
            assert tensor.dtype == torch.float32
            torch.testing.assert_close(tensor, state2[index][name], rtol=1e-5, atol=1e-5)
        if shrinkage:
            assert state[index]["signal_sums"].shape == (2, *shape[1:-1])


@pytest.mark.parametrize(
    "start",
    [torch.zeros(5, 23, 3, dtype=torch.float64), torch.zeros(3, 23, 5).transpose(0, 2)],
    ids=["precision", "order"],
)
def test_tables_of_other_precision_or_order_are_left_to_pytorch(start, monkeypatch):
    shown = [(values.to(start.dtype),) for values in gradients((5, 23, 3), 12, 6, 0.4)]
    with monkeypatch.context() as patch:
        patch.setattr(row_adam, "visited_rows", refused)
        (other,), _ = trained([start], shown, 1.5)
    usual = torch.zeros(5, 23, 3)
    (mine,), _ = trained([usual], [(values.float(),) for (values,) in shown], 1.5)
    assert mine.any()
    torch.testing.assert_close(mine, other.float().contiguous(), rtol=1e-4, atol=1e-5)
