"""Small dense layers over a tile of samples, in vectors; `fused_kernels` makes the field of them.

Legend: T samples of a tile, of which the first `count` are real; an array [T n] holds a row of numbers for each.
"""

# pyright: reportMissingParameterType=false

from typing import Any, NamedTuple

import numpy as np

from twofold.kernels.lanes import (
    LANES,
    apart,
    exponential,
    load,
    minus,
    plus,
    scaled,
    spread,
    store,
    times_plus,
    where_positive,
)
from twofold.kernels.parallel import compiled_part

PLAIN, RECTIFY, MASK = np.int64(0), np.int64(1), np.int64(2)
"""What `multiply` does in the end: nothing, set negative results to zero, or those whose mask is not positive."""
FRESH, MORE = np.bool_(True), np.bool_(False)
"""Whether it starts with the bias, or adds to what is there."""
START = np.int64(0)
"""The first row or column. Numba compiles a function anew for each plain constant that it is called with."""
_BLOCK = 4
"""Samples whose sums are in registers together; tiles are multiples of it."""


class Net(NamedTuple):
    """A net's matrices, transposed for the way up and as they are for the way down, and its biases.

    Columns are padded with zeros to full vectors. `zeros` is a bias of nothing.
    """

    up1: Any
    up2: Any
    up3: Any
    bias1: Any
    bias2: Any
    bias3: Any
    down1: Any
    down2: Any
    down3: Any
    zeros: Any


@compiled_part
def padded(columns):  # noqa: ANN001, ANN201
    """As many columns as fill whole vectors."""
    return (columns + LANES - 1) // LANES * LANES


@compiled_part
def _padded_matrix(matrix):  # noqa: ANN001, ANN202
    out = np.zeros((matrix.shape[0], padded(matrix.shape[1])), np.float32)
    out[:, : matrix.shape[1]] = matrix
    return out


@compiled_part
def ready(net):  # noqa: ANN001, ANN201
    """Weight and bias of three layers as `Net`."""
    apart()
    bias1, bias2, bias3 = net[1].reshape(1, -1), net[3].reshape(1, -1), net[5].reshape(1, -1)
    widest = padded(max(net[0].shape[1], net[2].shape[1], net[4].shape[0]))
    return Net(
        _padded_matrix(net[0].T), _padded_matrix(net[2].T), _padded_matrix(net[4].T),
        _padded_matrix(bias1), _padded_matrix(bias2), _padded_matrix(bias3),
        _padded_matrix(net[0]), _padded_matrix(net[2]), _padded_matrix(net[4]),
        np.zeros((1, widest), np.float32),
    )  # fmt: skip


@compiled_part
def multiply(x, at, columns, matrix, row, bias, fresh, finish, mask, out, count):  # noqa: ANN001, ANN201
    """out[T n] = x[:, at : at + columns] times the rows of a matrix from `row` on, plus the bias or what is there.

    Rows beyond `count`, up to a block, come out as something finite.
    """
    apart()
    wide = out.shape[1] // (2 * LANES) * (2 * LANES)
    for o in range(0, wide, 2 * LANES):
        p = o + LANES
        for s in range(0, count, _BLOCK):
            if fresh:
                a0, b0 = load(bias, 0, o), load(bias, 0, p)
                a1, a2, a3, b1, b2, b3 = a0, a0, a0, b0, b0, b0
            else:
                a0, b0 = load(out, s, o), load(out, s, p)
                a1, b1 = load(out, s + 1, o), load(out, s + 1, p)
                a2, b2 = load(out, s + 2, o), load(out, s + 2, p)
                a3, b3 = load(out, s + 3, o), load(out, s + 3, p)
            for i in range(columns):
                v, w = load(matrix, row + i, o), load(matrix, row + i, p)
                x0, x1 = spread(x, s, at + i), spread(x, s + 1, at + i)
                x2, x3 = spread(x, s + 2, at + i), spread(x, s + 3, at + i)
                a0, b0 = times_plus(x0, v, a0), times_plus(x0, w, b0)
                a1, b1 = times_plus(x1, v, a1), times_plus(x1, w, b1)
                a2, b2 = times_plus(x2, v, a2), times_plus(x2, w, b2)
                a3, b3 = times_plus(x3, v, a3), times_plus(x3, w, b3)
            _finish(finish, mask, out, s, o, a0, a1, a2, a3)
            _finish(finish, mask, out, s, p, b0, b1, b2, b3)
    if wide < out.shape[1]:
        o = wide
        for s in range(0, count, _BLOCK):
            if fresh:
                a0 = load(bias, 0, o)
                a1, a2, a3 = a0, a0, a0
            else:
                a0, a1 = load(out, s, o), load(out, s + 1, o)
                a2, a3 = load(out, s + 2, o), load(out, s + 3, o)
            for i in range(columns):
                v = load(matrix, row + i, o)
                a0, a1 = times_plus(spread(x, s, at + i), v, a0), times_plus(spread(x, s + 1, at + i), v, a1)
                a2, a3 = times_plus(spread(x, s + 2, at + i), v, a2), times_plus(spread(x, s + 3, at + i), v, a3)
            _finish(finish, mask, out, s, o, a0, a1, a2, a3)


@compiled_part
def _finish(finish, mask, out, s, o, a0, a1, a2, a3):  # noqa: ANN001, ANN202
    if finish == RECTIFY:
        a0, a1, a2, a3 = where_positive(a0, a0), where_positive(a1, a1), where_positive(a2, a2), where_positive(a3, a3)
    elif finish == MASK:
        a0, a1 = where_positive(load(mask, s, o), a0), where_positive(load(mask, s + 1, o), a1)
        a2, a3 = where_positive(load(mask, s + 2, o), a2), where_positive(load(mask, s + 3, o), a3)
    store(out, s, o, a0)
    store(out, s + 1, o, a1)
    store(out, s + 2, o, a2)
    store(out, s + 3, o, a3)


@compiled_part
def add_products(x, at, columns, u, total, row, count):  # noqa: ANN001, ANN201
    """total[row + i, :] += sum over the samples of x[s, at + i] u[s, :]: a matrix's gradient, transposed."""
    apart()
    wide, quads = u.shape[1] // (2 * LANES) * (2 * LANES), columns // _BLOCK * _BLOCK
    for o in range(0, wide, 2 * LANES):
        p = o + LANES
        for i in range(row, row + quads, _BLOCK):
            a0, a1, a2, a3 = load(total, i, o), load(total, i + 1, o), load(total, i + 2, o), load(total, i + 3, o)
            b0, b1, b2, b3 = load(total, i, p), load(total, i + 1, p), load(total, i + 2, p), load(total, i + 3, p)
            c = at + i - row
            for s in range(count):
                v, w = load(u, s, o), load(u, s, p)
                x0, x1, x2, x3 = spread(x, s, c), spread(x, s, c + 1), spread(x, s, c + 2), spread(x, s, c + 3)
                a0, b0 = times_plus(x0, v, a0), times_plus(x0, w, b0)
                a1, b1 = times_plus(x1, v, a1), times_plus(x1, w, b1)
                a2, b2 = times_plus(x2, v, a2), times_plus(x2, w, b2)
                a3, b3 = times_plus(x3, v, a3), times_plus(x3, w, b3)
            _finish(PLAIN, total, total, i, o, a0, a1, a2, a3)
            _finish(PLAIN, total, total, i, p, b0, b1, b2, b3)
    # What no block of four by two holds.
    for o in range(0, u.shape[1], LANES):
        for i in range(quads if o < wide else 0, columns):
            a0 = load(total, row + i, o)
            for s in range(count):
                a0 = times_plus(spread(x, s, at + i), load(u, s, o), a0)
            store(total, row + i, o, a0)


@compiled_part
def add_rows(u, total, count):  # noqa: ANN001, ANN201
    """total[0, :] += sum over the samples of u[s, :]."""
    for o in range(0, u.shape[1], LANES):
        a0 = load(total, 0, o)
        a1 = minus(a0, a0)
        a2, a3, s = a1, a1, 0
        while s + _BLOCK <= count:
            a0, a1 = plus(load(u, s, o), a0), plus(load(u, s + 1, o), a1)
            a2, a3 = plus(load(u, s + 2, o), a2), plus(load(u, s + 3, o), a3)
            s += _BLOCK
        while s < count:
            a0 = plus(load(u, s, o), a0)
            s += 1
        store(total, 0, o, plus(plus(a0, a1), plus(a2, a3)))


@compiled_part
def add_scaled(factor, x, s, at, out, to, columns, fresh):  # noqa: ANN001, ANN201
    """out[s, to : to + columns] = factor x[s, at : at + columns], plus what is there unless `fresh`."""
    c = 0
    while c + LANES <= columns:
        value = scaled(factor, load(x, s, at + c))
        store(out, s, to + c, value if fresh else plus(value, load(out, s, to + c)))
        c += LANES
    while c < columns:
        out[s, to + c] = factor * x[s, at + c] + (np.float32(0) if fresh else out[s, to + c])
        c += 1


@compiled_part
def take_active(mask, s, at, x, begin, out, columns):  # noqa: ANN001, ANN201
    """out[s, at : at + columns] = x[s, begin : begin + columns] where the mask, from `at` on, is positive, or zero."""
    c = 0
    while c + LANES <= columns:
        store(out, s, at + c, where_positive(load(mask, s, at + c), load(x, s, begin + c)))
        c += LANES
    while c < columns:
        out[s, at + c] = x[s, begin + c] if mask[s, at + c] > 0 else np.float32(0)
        c += 1


@compiled_part
def exponentials(x, sign):  # noqa: ANN001, ANN201
    """x[n T] = e to the power of x times a sign."""
    apart()
    for row in range(x.shape[0]):
        for s in range(0, x.shape[1], LANES):
            store(x, row, s, exponential(scaled(sign, load(x, row, s))))


@compiled_part
def upper_layers(net, tape, out, count):  # noqa: ANN001, ANN201
    """Second hidden layer and answer, from the first hidden layer on the tape."""
    apart()
    width, second = net.up2.shape[0], net.up3.shape[0]
    multiply(tape[0], START, width, net.up2, START, net.bias2, FRESH, RECTIFY, tape[1], tape[1], count)
    multiply(tape[1], START, second, net.up3, START, net.bias3, FRESH, PLAIN, out, out, count)


@compiled_part
def pull_down(u, columns, net, tape, hidden, by_x, count):  # noqa: ANN001, ANN201
    """by_x = J^T u for cotangents of the answer's first columns; those of the hidden layers stay in `hidden`."""
    apart()
    multiply(u, START, columns, net.down3, START, net.zeros, FRESH, MASK, tape[1], hidden[1], count)
    pull_lower(net, tape, hidden, by_x, count)


@compiled_part
def pull_first(factor, net, tape, hidden, by_x, count):  # noqa: ANN001, ANN201
    """`pull_down` of the answer's first number alone, times a factor."""
    apart()
    for o in range(0, net.down3.shape[1], LANES):
        head = scaled(factor, load(net.down3, 0, o))
        for s in range(padded(count)):
            store(hidden[1], s, o, where_positive(load(tape[1], s, o), head))
    pull_lower(net, tape, hidden, by_x, count)


@compiled_part
def pull_lower(net, tape, hidden, by_x, count):  # noqa: ANN001, ANN201
    """The rest of `pull_down` below the second hidden layer."""
    apart()
    multiply(hidden[1], START, net.down2.shape[0], net.down2, START, net.zeros, FRESH, MASK, tape[0], hidden[0], count)
    multiply(hidden[0], START, net.down1.shape[0], net.down1, START, net.zeros, FRESH, PLAIN, by_x, by_x, count)


@compiled_part
def zeros_like(net):  # noqa: ANN001, ANN201
    """Room for sums of gradients by the transposed matrices and the biases."""
    return (
        np.zeros_like(net.up1), np.zeros_like(net.up2), np.zeros_like(net.up3),
        np.zeros_like(net.bias1), np.zeros_like(net.bias2), np.zeros_like(net.bias3),
    )  # fmt: skip


@compiled_part
def add_upper_gradients(u, tape, hidden, total, count):  # noqa: ANN001, ANN201
    """Adds the gradients by all but the first matrix, after `pull_down`."""
    apart()
    add_products(tape[0], START, total[1].shape[0], hidden[1], total[1], START, count)
    add_products(tape[1], START, total[2].shape[0], u, total[2], START, count)
    add_rows(hidden[0], total[3], count)
    add_rows(hidden[1], total[4], count)
    add_rows(u, total[5], count)


@compiled_part
def unpadded(total, by_net):  # noqa: ANN001, ANN201
    """Gradients as the layers have them, from transposed and padded ones."""
    apart()
    by_net[0][:] = total[0].T[: by_net[0].shape[0]]
    by_net[2][:] = total[1].T[: by_net[2].shape[0]]
    by_net[4][:] = total[2].T[: by_net[4].shape[0]]
    by_net[1][:] = total[3][0, : by_net[1].shape[0]]
    by_net[3][:] = total[4][0, : by_net[3].shape[0]]
    by_net[5][:] = total[5][0, : by_net[5].shape[0]]
