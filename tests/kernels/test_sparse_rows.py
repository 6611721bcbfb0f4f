"""Weighted sums of rows against a plain loop, and their gradients against autograd's own."""

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from twofold.kernels.sparse_rows import scatter_rows, weighted_rows


def random_case(seed, samples=7, neighbours=3, rows=5, channels=4, dtype=torch.float64, device="cpu"):
    """Rows repeat within a sample and some rows are never asked for."""
    generator = torch.Generator().manual_seed(seed)
    table = torch.randn(rows, channels, generator=generator, dtype=dtype)
    index = torch.randint(max(rows - 1, 1), (samples, neighbours), generator=generator)
    weights = torch.randn(samples, neighbours, generator=generator, dtype=dtype)
    return table.to(device), index.to(device), weights.to(device)


def plain_loop(table, index, weights):
    out = torch.zeros(len(index), table.shape[1], dtype=table.dtype)
    for s in range(index.shape[0]):
        for k in range(index.shape[1]):
            out[s] += weights[s, k] * table[index[s, k]]
    return out


def plain_transpose(values, index, weights, rows):
    out = torch.zeros(rows, values.shape[1], dtype=values.dtype)
    for s in range(index.shape[0]):
        for k in range(index.shape[1]):
            out[index[s, k]] += weights[s, k] * values[s]
    return out


@given(seed=st.integers(0, 9999), samples=st.integers(0, 6), neighbours=st.integers(1, 4), rows=st.integers(1, 6))
def test_sums_and_their_transpose_are_plain_loops(seed, samples, neighbours, rows):
    table, index, weights = random_case(seed, samples, neighbours, rows)
    out = weighted_rows(table, index, weights)
    torch.testing.assert_close(out, plain_loop(table, index, weights))
    values = torch.sin(out)
    back = scatter_rows(values, index, weights, rows)
    torch.testing.assert_close(back, plain_transpose(values, index, weights, rows))


@pytest.mark.parametrize("neighbours", [1, 3])
def test_gradient_by_the_table_is_autograds(neighbours, device):
    table, index, weights = random_case(3, neighbours=neighbours, device=device)
    slopes = torch.cos(torch.arange(28.0, dtype=torch.float64, device=device)).view(7, 4)
    results = []
    for form in (weighted_rows, lambda t, i, w: (w[..., None] * t[i]).sum(1)):
        leaf = table.clone().requires_grad_()
        out = form(leaf, index, weights)
        (gradient,) = torch.autograd.grad((slopes * out).sum(), leaf)
        results.append((out.detach(), gradient))
    torch.testing.assert_close(results[0], results[1])
    assert (results[0][1][-1] == 0).all(), "a row that nobody asked for gets no gradient"


def test_gradient_passes_gradcheck():
    table, index, weights = random_case(4)
    assert torch.autograd.gradcheck(lambda t: weighted_rows(t, index, weights), table.requires_grad_())


def test_weights_are_constants():
    table, index, weights = random_case(5)
    assert not weighted_rows(table, index, weights.requires_grad_()).requires_grad
    weighted_rows(table.requires_grad_(), index, weights).sum().backward()
    assert weights.grad is None


def test_a_gradient_that_is_no_contiguous_block_is_summed_alike():
    _, index, weights = random_case(6)
    values = torch.randn(4, 7, dtype=torch.float64).T
    expected = plain_transpose(values, index, weights, 5)
    torch.testing.assert_close(scatter_rows(values, index, weights, 5), expected)


def test_a_repeated_run_repeats_to_the_bit():
    _, index, weights = random_case(7, samples=3000, dtype=torch.float32)
    values = torch.randn(3000, 4)
    first = scatter_rows(values, index, weights, 5)
    assert all(torch.equal(first, scatter_rows(values, index, weights, 5)) for _ in range(3))
