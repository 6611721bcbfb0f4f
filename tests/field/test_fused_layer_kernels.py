"""Layers and lookups over a tile against plain matrix products and the lookups in PyTorch."""

import numpy as np
import pytest
import torch

from twofold.field import fused_layer_kernels as layers
from twofold.field import fused_lookup_kernels as lookups
from twofold.field.grids import build_lattices, interpolate_in_torch, pullback_in_torch
from twofold.kernels.parallel import compiled
from twofold.kernels.row_gradient import NOW

RNG = np.random.default_rng(1)


@compiled
def multiply(x, at, columns, matrix, row, bias, fresh, finish, mask, out, count):
    layers.multiply(x, at, columns, matrix, row, bias, fresh, finish, mask, out, count)


@compiled
def add_products(x, at, columns, u, total, row, count):
    layers.add_products(x, at, columns, u, total, row, count)


@compiled
def hand_on(factor, x, s, at, out, to, columns, fresh):
    layers.add_scaled(factor, x, s, at, out, to, columns, fresh)


@compiled
def take_active(mask, s, at, x, begin, out, columns):
    layers.take_active(mask, s, at, x, begin, out, columns)


@compiled
def look_up(x, grid, out, again, slopes, u, pulled):
    lookups.lookup(x, len(x), grid, out)
    lookups.lookup_with_slopes(x, len(x), grid, again, slopes)
    for s in range(len(x)):
        for axis in range(3):
            pulled[s, axis] = lookups.pulled(slopes, u, s, axis, u.shape[1])


def numbers(*shape):
    return RNG.normal(size=shape).astype(np.float32)


@pytest.mark.parametrize("columns", [16, 32, 48])
@pytest.mark.parametrize("finish", [layers.PLAIN, layers.RECTIFY, layers.MASK])
def test_a_layer_is_a_matrix_product(columns, finish):
    x, matrix, bias, mask = numbers(8, 9), numbers(7, columns), numbers(1, columns), numbers(8, columns)
    before = numbers(8, columns)
    for fresh in (True, False):
        out = before.copy()
        multiply(x, 2, 5, matrix, 1, bias, fresh, finish, mask, out, 7)
        whole = x[:, 2:7] @ matrix[1:6] + (bias if fresh else before)
        kept = {layers.PLAIN: whole, layers.RECTIFY: np.maximum(whole, 0), layers.MASK: np.where(mask > 0, whole, 0)}
        np.testing.assert_allclose(out[:7], kept[finish][:7], rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("columns", [16, 32, 48])
@pytest.mark.parametrize("inputs", [3, 4, 6])
def test_products_are_summed_over_the_samples_that_there_are(columns, inputs):
    x, u, total = numbers(8, 9), numbers(8, columns), numbers(10, columns)
    expected = total.copy()
    expected[2 : 2 + inputs] += x[:7, 1 : 1 + inputs].T @ u[:7]
    add_products(x, 1, inputs, u, total, 2, 7)
    np.testing.assert_allclose(total, expected, rtol=1e-5, atol=1e-5)


def test_columns_are_handed_on_scaled_added_and_masked():
    for columns in (3, 16, 21):
        x, out, mask = numbers(2, 40), numbers(2, 40), numbers(2, 40)
        expected = out.copy()
        expected[1, 4 : 4 + columns] += 0.5 * x[1, 2 : 2 + columns]
        hand_on(np.float32(0.5), x, 1, 2, out, 4, columns, False)
        np.testing.assert_allclose(out, expected, rtol=1e-6)
        expected[0, 4 : 4 + columns] = np.where(mask[0, 4 : 4 + columns] > 0, x[0, 2 : 2 + columns], 0)
        take_active(mask, 0, 4, x, 2, out, columns)
        np.testing.assert_allclose(out, expected, rtol=1e-6)


@pytest.fixture
def grid():
    lattices, _ = build_lattices(numbers(30, 3) * np.float32(0.1), (0.1, 0.04), radius=0.05)
    table = torch.from_numpy(numbers(int(lattices.rows.max()) + 1, 8))
    x = torch.from_numpy(numbers(20, 3)) * 0.1
    return lattices, table, x, (table.numpy(), *(t.numpy() for t in vars(lattices).values()))


def test_lookups_and_slopes_are_those_in_torch(grid):
    lattices, table, x, arrays = grid
    out, again, slopes, u, pulled = (
        numbers(20, 16),
        numbers(20, 16),
        numbers(3, 20, 16),
        numbers(20, 16),
        numbers(20, 3),
    )
    look_up(x.numpy(), arrays, out, again, slopes, u, pulled)
    expected = interpolate_in_torch(table.double(), x.double(), lattices).numpy()
    np.testing.assert_allclose(out, expected, rtol=1e-4, atol=1e-4)
    np.testing.assert_allclose(again, expected, rtol=1e-4, atol=1e-4)
    by_hand = pullback_in_torch(table.double(), x.double(), torch.from_numpy(u).double(), lattices).numpy()
    np.testing.assert_allclose(pulled, by_hand, rtol=1e-3, atol=1e-2)


def test_scattered_cotangents_are_the_transposes(grid):
    lattices, table, x, arrays = grid
    u, direction = numbers(20, 16), numbers(20, 3)
    leaf = table.double().requires_grad_()
    value = (interpolate_in_torch(leaf, x.double(), lattices) * torch.from_numpy(u)).sum()
    slope = (
        pullback_in_torch(leaf, x.double(), torch.from_numpy(u).double(), lattices) * torch.from_numpy(direction)
    ).sum()
    for kernel, given, whole in ((lookups.scatter, (u,), value), (lookups.scatter_slopes, (u, direction), slope)):
        found, marks = np.zeros(table.shape, np.float32), np.zeros(len(table), np.uint8)
        for level in (0, 1):
            kernel(x.numpy(), *given, arrays, found, marks, level, level + 1)
        unmarked = np.zeros_like(found)
        kernel(x.numpy(), *given, arrays, unmarked, marks[:0], 0, 2)
        np.testing.assert_array_equal(unmarked, found)
        assert set(marks) == {0, NOW}
        assert not found[marks == 0].any()
        expected = torch.autograd.grad(whole, leaf, retain_graph=True)[0].numpy()
        np.testing.assert_allclose(found, expected, rtol=1e-3, atol=2e-3)
