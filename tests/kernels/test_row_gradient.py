"""Adam row by row against PyTorch's."""

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from twofold.kernels.row_gradient import BEFORE, NEVER, NOW, RowGradient, adam_rows

BETAS, EPSILON = (0.9, 0.99), 1e-15


def gradients(rows, steps, seed):
    """Gradients of which each step touches other rows, and the last row none."""
    generator = torch.Generator().manual_seed(seed)
    values = torch.randn(steps, rows, 3, generator=generator)
    values[torch.rand(steps, rows, generator=generator) < 0.6] = 0
    values[:, -1] = 0
    return values


@given(st.integers(2, 40), st.integers(1, 12), st.integers(0, 1000))
def test_rows_make_the_steps_of_adam(rows, steps, seed):
    start = torch.randn(rows, 3, generator=torch.Generator().manual_seed(seed))
    whole = torch.nn.Parameter(start.clone())
    optimizer = torch.optim.Adam([whole], lr=0.02, betas=BETAS, eps=EPSILON, fused=True)
    table, first, second = start.clone(), torch.zeros_like(start), torch.zeros_like(start)
    gradient = RowGradient.of(table)
    for number, values in enumerate(gradients(rows, steps, seed), 1):
        whole.grad = values.clone()
        optimizer.step()
        # In two parts, as two terms of a loss come.
        gradient.add(values * 0.25)
        gradient.add(values * 0.75)
        adam_rows(table, first, second, gradient, 0.02, number, BETAS, EPSILON)
        assert not gradient.values.any()
    torch.testing.assert_close(table, whole.detach(), rtol=1e-5, atol=1e-6)
    assert torch.equal(table[-1], start[-1])


def test_marks_follow_the_steps():
    table = torch.zeros(3, 2)
    gradient, moments = RowGradient.of(table), (torch.zeros(3, 2), torch.zeros(3, 2))
    gradient.add(torch.tensor([[0.0, 1.0], [0.0, 0.0], [0.0, 0.0]]))
    assert gradient.marks.tolist() == [NOW, NEVER, NEVER]
    adam_rows(table, *moments, gradient, 0.1, 1, BETAS, EPSILON)
    assert gradient.marks.tolist() == [BEFORE, NEVER, NEVER]
    gradient.add(torch.tensor([[0.0, 0.0], [2.0, 0.0], [0.0, 0.0]]))
    assert gradient.marks.tolist() == [BEFORE, NOW, NEVER]
    again = RowGradient.of(table)
    again.know(moments[1])
    assert again.marks.tolist() == [BEFORE, NEVER, NEVER]


@pytest.mark.parametrize("threads", [1, 2])
def test_a_large_table_is_shared_by_threads(threads):
    before = torch.get_num_threads()
    torch.set_num_threads(threads)
    try:
        table = torch.zeros(200_000, 4)
        gradient = RowGradient.of(table)
        gradient.add(torch.ones_like(table))
        adam_rows(table, torch.zeros_like(table), torch.zeros_like(table), gradient, 0.1, 1, BETAS, EPSILON)
    finally:
        torch.set_num_threads(before)
    torch.testing.assert_close(table, torch.full_like(table, -0.1))
