"""The compiled test for mis-warped samples, for CPUs; `pruning` holds its twin in PyTorch, for GPUs and for tests."""

# pyright: reportMissingParameterType=false

import numpy as np

from twofold.kernels.parallel import compiled


@compiled
def _nearest_listed(x, y, z, listed, vertices, found, squares):  # noqa: ANN001, ANN202
    """The nearest of the listed vertices, as many as `found` holds, and their squared distances, nearest first."""
    k = found.shape[0]
    squares[:] = np.float32(np.inf)
    for c in range(listed.shape[0]):
        v = listed[c]
        dx, dy, dz = x - vertices[v, 0], y - vertices[v, 1], z - vertices[v, 2]
        square = dx * dx + dy * dy + dz * dz
        if square < squares[k - 1]:
            place = k - 1
            while place > 0 and squares[place - 1] > square:
                squares[place], found[place] = squares[place - 1], found[place - 1]
                place -= 1
            squares[place], found[place] = square, v


@compiled
def miswarped(x_posed, x_canonical, first, posed, low, voxel, row, nearest, vertices, slack, out, begin, end):  # noqa: ANN001, ANN201
    """out[S] = whether the canonical point is closer to the canonical body than the posed one, `slack` granted.

    `first` [S] is each sample's nearest vertex, `posed` [V 3] the posed vertices; the rest is the canonical shell.
    """
    inverse = np.float32(1 / voxel)
    found, squares = np.empty(1, np.int64), np.empty(1, np.float32)
    for s in range(begin, end):
        out[s] = False
        total = np.float32(0)
        for i in range(3):
            difference = x_posed[s, i] - posed[first[s], i]
            total += difference * difference
        away = np.sqrt(total)
        if away <= slack:
            continue
        x, y, z = x_canonical[s, 0], x_canonical[s, 1], x_canonical[s, 2]
        a = int(np.floor((x - low[0]) * inverse))
        b = int(np.floor((y - low[1]) * inverse))
        c = int(np.floor((z - low[2]) * inverse))
        if a < 0 or b < 0 or c < 0 or a >= row.shape[0] or b >= row.shape[1] or c >= row.shape[2] or row[a, b, c] < 0:
            continue
        _nearest_listed(x, y, z, nearest[row[a, b, c]], vertices, found, squares)
        out[s] = np.sqrt(squares[0]) < away - slack
