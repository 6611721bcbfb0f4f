"""Compiled loops of the feature grids, for CPUs. `grids` holds the same in PyTorch, for GPUs and as their slow twin.

Legend: S points, L levels, C features; `x` [S 3] points; `table` [N C] features of all levels; `rows` the table row of
every lattice node, all levels one after the other; `place` [L 4] lower corner and inverse spacing; `shape` [L 4] nodes
along each axis and where the level begins in `rows`; `begin`, `end` the part of the points (of the levels, in the
scatters, which own their rows) that a call handles.
"""

# pyright: reportMissingParameterType=false

import numpy as np

from twofold.kernels.parallel import compiled, compiled_part


@compiled_part
def cell(x, place, shape):  # noqa: ANN001, ANN201
    """Lower node of the cell and position in it; points outside are moved to the border."""
    u = min(max((x[0] - place[0]) * place[3], np.float32(0)), shape[0] - np.float32(1.001))
    v = min(max((x[1] - place[1]) * place[3], np.float32(0)), shape[1] - np.float32(1.001))
    w = min(max((x[2] - place[2]) * place[3], np.float32(0)), shape[2] - np.float32(1.001))
    i, j, k = int(u), int(v), int(w)
    base = shape[3] + (i * shape[1] + j) * shape[2] + k
    return base, np.float32(u - i), np.float32(v - j), np.float32(w - k)


@compiled
def interpolate(x, table, rows, place, shape, out, begin, end):  # noqa: ANN001, ANN201
    """out[S, L*C] = trilinear features."""
    channels = table.shape[1]
    one = np.float32(1)
    for s in range(begin, end):
        for level in range(place.shape[0]):
            base, u, v, w = cell(x[s], place[level], shape[level])
            stride_i, stride_j = shape[level, 1] * shape[level, 2], shape[level, 2]
            at = level * channels
            for c in range(channels):
                out[s, at + c] = 0
            for a in range(2):
                wa = u if a else one - u
                for b in range(2):
                    wb = wa * (v if b else one - v)
                    for d in range(2):
                        weight = wb * (w if d else one - w)
                        row = rows[base + a * stride_i + b * stride_j + d]
                        for c in range(channels):
                            out[s, at + c] += weight * table[row, c]


@compiled
def scatter(x, gradient, rows, place, shape, by_table, begin, end):  # noqa: ANN001, ANN201
    """by_table[N, C] += transpose of `interpolate`; levels own their rows, so they run side by side."""
    channels = by_table.shape[1]
    one = np.float32(1)
    for level in range(begin, end):
        stride_i, stride_j = shape[level, 1] * shape[level, 2], shape[level, 2]
        at = level * channels
        for s in range(x.shape[0]):
            base, u, v, w = cell(x[s], place[level], shape[level])
            for a in range(2):
                wa = u if a else one - u
                for b in range(2):
                    wb = wa * (v if b else one - v)
                    for d in range(2):
                        weight = wb * (w if d else one - w)
                        row = rows[base + a * stride_i + b * stride_j + d]
                        for c in range(channels):
                            by_table[row, c] += weight * gradient[s, at + c]


@compiled
def pull(x, table, cotangent, rows, place, shape, out, begin, end):  # noqa: ANN001, ANN201
    """out[S, 3] = J^T cotangent, J the derivative of `interpolate` by x."""
    channels = table.shape[1]
    one = np.float32(1)
    for s in range(begin, end):
        gx, gy, gz = np.float32(0), np.float32(0), np.float32(0)
        for level in range(place.shape[0]):
            base, u, v, w = cell(x[s], place[level], shape[level])
            stride_i, stride_j = shape[level, 1] * shape[level, 2], shape[level, 2]
            at = level * channels
            scale = place[level, 3]
            for a in range(2):
                wa, da = (u, scale) if a else (one - u, -scale)
                for b in range(2):
                    wb, db = (v, scale) if b else (one - v, -scale)
                    for d in range(2):
                        wd, dd = (w, scale) if d else (one - w, -scale)
                        row = rows[base + a * stride_i + b * stride_j + d]
                        along = np.float32(0)
                        for c in range(channels):
                            along += table[row, c] * cotangent[s, at + c]
                        gx += along * da * wb * wd
                        gy += along * wa * db * wd
                        gz += along * wa * wb * dd
        out[s, 0], out[s, 1], out[s, 2] = gx, gy, gz


@compiled
def pull_scatter(x, cotangent, gradient, rows, place, shape, by_table, begin, end):  # noqa: ANN001, ANN201
    """by_table[N, C] += derivative of <gradient, pull(...)> by the table."""
    channels = by_table.shape[1]
    one = np.float32(1)
    for level in range(begin, end):
        stride_i, stride_j = shape[level, 1] * shape[level, 2], shape[level, 2]
        at = level * channels
        scale = place[level, 3]
        for s in range(x.shape[0]):
            base, u, v, w = cell(x[s], place[level], shape[level])
            for a in range(2):
                wa, da = (u, scale) if a else (one - u, -scale)
                for b in range(2):
                    wb, db = (v, scale) if b else (one - v, -scale)
                    for d in range(2):
                        wd, dd = (w, scale) if d else (one - w, -scale)
                        slope = gradient[s, 0] * da * wb * wd + gradient[s, 1] * wa * db * wd
                        slope += gradient[s, 2] * wa * wb * dd
                        row = rows[base + a * stride_i + b * stride_j + d]
                        for c in range(channels):
                            by_table[row, c] += slope * cotangent[s, at + c]


@compiled
def push(x, table, gradient, rows, place, shape, out, begin, end):  # noqa: ANN001, ANN201
    """out[S, L*C] = J gradient: the derivative of <gradient, pull(...)> by the cotangent."""
    channels = table.shape[1]
    one = np.float32(1)
    for s in range(begin, end):
        for level in range(place.shape[0]):
            base, u, v, w = cell(x[s], place[level], shape[level])
            stride_i, stride_j = shape[level, 1] * shape[level, 2], shape[level, 2]
            at = level * channels
            scale = place[level, 3]
            for c in range(channels):
                out[s, at + c] = 0
            for a in range(2):
                wa, da = (u, scale) if a else (one - u, -scale)
                for b in range(2):
                    wb, db = (v, scale) if b else (one - v, -scale)
                    for d in range(2):
                        wd, dd = (w, scale) if d else (one - w, -scale)
                        slope = gradient[s, 0] * da * wb * wd + gradient[s, 1] * wa * db * wd
                        slope += gradient[s, 2] * wa * wb * dd
                        row = rows[base + a * stride_i + b * stride_j + d]
                        for c in range(channels):
                            out[s, at + c] += slope * table[row, c]
