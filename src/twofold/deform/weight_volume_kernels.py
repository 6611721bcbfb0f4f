"""Compiled lookups of bone weights, for CPUs. `weight_volume` holds the same in PyTorch, for GPUs and as a slow twin.

Legend: S points, J bones; `x` [S 3] points; `rows` [J 3 4] from a point to the volume's vertices (z, y and x counted
from 0) for each bone; `volume` [J d h w]; `out` [S J]; `begin`, `end` the part of the points (in `scatter` of the
bones, which own their channels) that a call handles. Vertices outside the volume count as zero.
"""

# pyright: reportMissingParameterType=false

import numpy as np

from twofold.kernels.parallel import compiled


@compiled
def interpolate(x, rows, volume, out, begin, end):  # noqa: ANN001, ANN201
    """out[S, J] = trilinear weight of each bone where that bone takes the point."""
    bones, depth, height, width = volume.shape
    one = np.float32(1)
    for s in range(begin, end):
        px, py, pz = x[s, 0], x[s, 1], x[s, 2]
        for b in range(bones):
            r = rows[b]
            u = r[0, 0] * px + r[0, 1] * py + r[0, 2] * pz + r[0, 3]
            v = r[1, 0] * px + r[1, 1] * py + r[1, 2] * pz + r[1, 3]
            w = r[2, 0] * px + r[2, 1] * py + r[2, 2] * pz + r[2, 3]
            out[s, b] = 0
            if u <= -1 or v <= -1 or w <= -1 or u >= width or v >= height or w >= depth:
                continue
            i, j, k = int(np.floor(u)), int(np.floor(v)), int(np.floor(w))
            u, v, w = np.float32(u - i), np.float32(v - j), np.float32(w - k)
            total = np.float32(0)
            for c in range(2):
                if 0 <= k + c < depth:
                    wc = w if c else one - w
                    for d in range(2):
                        if 0 <= j + d < height:
                            wd = wc * (v if d else one - v)
                            if 0 <= i < width:
                                total += wd * (one - u) * volume[b, k + c, j + d, i]
                            if 0 <= i + 1 < width:
                                total += wd * u * volume[b, k + c, j + d, i + 1]
            out[s, b] = total


@compiled
def scatter(x, rows, volume, gradient, by_volume, by_rows, by_x, begin, end):  # noqa: ANN001, ANN201
    """Adds the derivative of <gradient, interpolate(...)> by the volume, the rows and the points."""
    _, depth, height, width = volume.shape
    one = np.float32(1)
    for b in range(begin, end):
        r = rows[b]
        for s in range(x.shape[0]):
            g = gradient[s, b]
            if g == 0:
                continue
            px, py, pz = x[s, 0], x[s, 1], x[s, 2]
            u = r[0, 0] * px + r[0, 1] * py + r[0, 2] * pz + r[0, 3]
            v = r[1, 0] * px + r[1, 1] * py + r[1, 2] * pz + r[1, 3]
            w = r[2, 0] * px + r[2, 1] * py + r[2, 2] * pz + r[2, 3]
            if u <= -1 or v <= -1 or w <= -1 or u >= width or v >= height or w >= depth:
                continue
            i, j, k = int(np.floor(u)), int(np.floor(v)), int(np.floor(w))
            u, v, w = np.float32(u - i), np.float32(v - j), np.float32(w - k)
            du, dv, dw = np.float32(0), np.float32(0), np.float32(0)
            for c in range(2):
                if 0 <= k + c < depth:
                    wc, dc = (w, one) if c else (one - w, -one)
                    for d in range(2):
                        if 0 <= j + d < height:
                            wd, dd = (v, one) if d else (one - v, -one)
                            for e in range(2):
                                if 0 <= i + e < width:
                                    we, de = (u, one) if e else (one - u, -one)
                                    by_volume[b, k + c, j + d, i + e] += g * wc * wd * we
                                    value = g * volume[b, k + c, j + d, i + e]
                                    du += value * wc * wd * de
                                    dv += value * wc * dd * we
                                    dw += value * dc * wd * we
            for axis in range(3):
                slope = du if axis == 0 else (dv if axis == 1 else dw)
                by_rows[b, axis, 0] += slope * px
                by_rows[b, axis, 1] += slope * py
                by_rows[b, axis, 2] += slope * pz
                by_rows[b, axis, 3] += slope
                by_x[s, 0] += slope * r[axis, 0]
                by_x[s, 1] += slope * r[axis, 1]
                by_x[s, 2] += slope * r[axis, 2]
