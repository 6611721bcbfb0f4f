"""Lookups in feature grids over a tile of samples, in vectors; `fused_kernels` makes the field of them.

Legend: T samples of a tile, of which the first `count` are real. A grid is (table, rows, place, shape) as in
`grid_kernels`, its number of features C a multiple of four; L levels.
"""

# pyright: reportMissingParameterType=false

import numpy as np

from twofold.field.grid_kernels import cell
from twofold.kernels.lanes import (
    QUAD,
    apart,
    between,
    load4,
    minus,
    scaled,
    scaled_plus,
    store4,
    sum_of_products,
)
from twofold.kernels.parallel import compiled, compiled_part
from twofold.kernels.row_gradient import NOW


@compiled_part
def _corner_rows(rows, base, far_i, far_j):  # noqa: ANN001, ANN202
    """Table rows of a cell's eight corners, the last axis first."""
    return (
        rows[base], rows[base + 1], rows[base + far_j], rows[base + far_j + 1],
        rows[base + far_i], rows[base + far_i + 1], rows[base + far_i + far_j], rows[base + far_i + far_j + 1],
    )  # fmt: skip


@compiled_part
def lookup(x, count, grid, out):  # noqa: ANN001, ANN201
    """out[T LC] = trilinear features."""
    apart()
    table, rows, place, shape = grid
    for s in range(count):
        for level in range(place.shape[0]):
            base, u, v, w = cell(x[s], place[level], shape[level])
            far_i, far_j = shape[level, 1] * shape[level, 2], shape[level, 2]
            r0, r1, r2, r3, r4, r5, r6, r7 = _corner_rows(rows, base, far_i, far_j)
            for c in range(0, table.shape[1], QUAD):
                low = between(
                    v,
                    between(w, load4(table, r0, c), load4(table, r1, c)),
                    between(w, load4(table, r2, c), load4(table, r3, c)),
                )
                high = between(
                    v,
                    between(w, load4(table, r4, c), load4(table, r5, c)),
                    between(w, load4(table, r6, c), load4(table, r7, c)),
                )
                store4(out, s, level * table.shape[1] + c, between(u, low, high))


@compiled_part
def lookup_with_slopes(x, count, grid, out, slopes):  # noqa: ANN001, ANN201
    """`lookup`, and slopes[3 T LC] = derivatives of the features by x, y and z."""
    apart()
    table, rows, place, shape = grid
    for s in range(count):
        for level in range(place.shape[0]):
            base, u, v, w = cell(x[s], place[level], shape[level])
            far_i, far_j = shape[level, 1] * shape[level, 2], shape[level, 2]
            r0, r1, r2, r3, r4, r5, r6, r7 = _corner_rows(rows, base, far_i, far_j)
            scale = place[level, 3]
            for c in range(0, table.shape[1], QUAD):
                t0, t2, t4, t6 = load4(table, r0, c), load4(table, r2, c), load4(table, r4, c), load4(table, r6, c)
                d0, d2 = minus(load4(table, r1, c), t0), minus(load4(table, r3, c), t2)
                d4, d6 = minus(load4(table, r5, c), t4), minus(load4(table, r7, c), t6)
                a0, a2, a4, a6 = (
                    scaled_plus(w, d0, t0),
                    scaled_plus(w, d2, t2),
                    scaled_plus(w, d4, t4),
                    scaled_plus(w, d6, t6),
                )
                v0, v4 = minus(a2, a0), minus(a6, a4)
                e0, e4 = scaled_plus(v, v0, a0), scaled_plus(v, v4, a4)
                at = level * table.shape[1] + c
                store4(out, s, at, between(u, e0, e4))
                store4(slopes[0], s, at, scaled(scale, minus(e4, e0)))
                store4(slopes[1], s, at, scaled(scale, between(u, v0, v4)))
                store4(slopes[2], s, at, scaled(scale, between(u, between(v, d0, d2), between(v, d4, d6))))


@compiled_part
def lookup_prior(x, count, grid, out, slopes):  # noqa: ANN001, ANN201
    """out[T P] = trilinear numbers of a grid of one level, slopes[T 3] = derivatives of the first of them."""
    apart()
    table, rows, place, shape = grid
    far_i, far_j, scale = shape[0, 1] * shape[0, 2], shape[0, 2], place[0, 3]
    for s in range(count):
        base, u, v, w = cell(x[s], place[0], shape[0])
        r0, r1, r2, r3, r4, r5, r6, r7 = _corner_rows(rows, base, far_i, far_j)
        for c in range(table.shape[1]):
            t0, t2, t4, t6 = table[r0, c], table[r2, c], table[r4, c], table[r6, c]
            d0, d2, d4, d6 = table[r1, c] - t0, table[r3, c] - t2, table[r5, c] - t4, table[r7, c] - t6
            a0, a2, a4, a6 = t0 + w * d0, t2 + w * d2, t4 + w * d4, t6 + w * d6
            v0, v4 = a2 - a0, a6 - a4
            e0, e4 = a0 + v * v0, a4 + v * v4
            out[s, c] = e0 + u * (e4 - e0)
            if c == 0:
                w0, w4 = d0 + v * (d2 - d0), d4 + v * (d6 - d4)
                slopes[s, 0] = scale * (e4 - e0)
                slopes[s, 1] = scale * (v0 + u * (v4 - v0))
                slopes[s, 2] = scale * (w0 + u * (w4 - w0))


@compiled_part
def pulled(slopes, u, s, axis, columns):  # noqa: ANN001, ANN201
    """One number of J^T u at a sample, with the derivatives `slopes` of the features."""
    total = np.float32(0)
    for c in range(0, columns, QUAD):
        total += sum_of_products(load4(slopes[axis], s, c), load4(u, s, c))
    return total


@compiled
def scatter(x, by_features, grid, by_table, marks, first, end):  # noqa: ANN001, ANN201
    """by_table[N C] += transpose of `lookup` for the levels first..end, which own their rows; marks[N] = `NOW` there.

    `marks` may be empty.
    """
    _, rows, place, shape = grid
    one, width, marking = np.float32(1), by_table.shape[1], marks.shape[0] > 0
    for level in range(first, end):
        far_i, far_j = shape[level, 1] * shape[level, 2], shape[level, 2]
        for s in range(x.shape[0]):
            base, u, v, w = cell(x[s], place[level], shape[level])
            for a in range(2):
                wide = u if a else one - u
                for b in range(2):
                    flat = wide * (v if b else one - v)
                    near = base + a * far_i + b * far_j
                    r0, r1 = rows[near], rows[near + 1]
                    if marking:
                        marks[r0] = marks[r1] = NOW
                    for c in range(0, width, QUAD):
                        value = load4(by_features, s, level * width + c)
                        store4(by_table, r0, c, scaled_plus(flat * (one - w), value, load4(by_table, r0, c)))
                        store4(by_table, r1, c, scaled_plus(flat * w, value, load4(by_table, r1, c)))


@compiled
def scatter_slopes(x, by_slopes, direction, grid, by_table, marks, first, end):  # noqa: ANN001, ANN201
    """by_table[N C] += derivative of <direction, J^T by_slopes> by the table, J the derivative of `lookup` by x.

    marks[N] = `NOW` where something is added; `marks` may be empty.
    """
    _, rows, place, shape = grid
    one, width, marking = np.float32(1), by_table.shape[1], marks.shape[0] > 0
    for level in range(first, end):
        far_i, far_j = shape[level, 1] * shape[level, 2], shape[level, 2]
        scale = place[level, 3]
        for s in range(x.shape[0]):
            base, u, v, w = cell(x[s], place[level], shape[level])
            dx, dy, dz = scale * direction[s, 0], scale * direction[s, 1], scale * direction[s, 2]
            for a in range(2):
                wa, da = (u, dx) if a else (one - u, -dx)
                for b in range(2):
                    wb, db = (v, dy) if b else (one - v, -dy)
                    for d in range(2):
                        wd, dd = (w, dz) if d else (one - w, -dz)
                        slope = da * wb * wd + wa * db * wd + wa * wb * dd
                        row = rows[base + a * far_i + b * far_j + d]
                        if marking:
                            marks[row] = NOW
                        for c in range(0, width, QUAD):
                            value = load4(by_slopes, s, level * width + c)
                            store4(by_table, row, c, scaled_plus(slope, value, load4(by_table, row, c)))
