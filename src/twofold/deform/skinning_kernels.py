"""Compiled loops of inverse skinning, for CPUs; `skinning` holds the same in PyTorch, which has gradients."""

# pyright: reportMissingParameterType=false

import numpy as np

from twofold.kernels.parallel import compiled


@compiled
def smooth_weights(squared, out, begin, end):  # noqa: ANN001, ANN201
    """out[S K] = `smooth_neighbour_weights`."""
    one, little = np.float32(1), np.float32(1e-6)
    for s in range(begin, end):
        farthest = np.float32(1e-12)
        for k in range(squared.shape[1]):
            farthest = max(farthest, squared[s, k])
        total = np.float32(0)
        for k in range(squared.shape[1]):
            part = one - squared[s, k] / farthest
            out[s, k] = part * part + little
            total += out[s, k]
        for k in range(squared.shape[1]):
            out[s, k] /= total


@compiled
def map_points(x, nearest, weights, forward, x_canonical, inverse, begin, end):  # noqa: ANN001, ANN201
    """x_canonical[S 3], inverse[S 3 4] = `map_to_canonical` of points with the transforms `forward` [V 3 4]."""
    for s in range(begin, end):
        mixed = np.zeros((3, 4), np.float32)
        for k in range(nearest.shape[1]):
            v, weight = nearest[s, k], weights[s, k]
            for i in range(3):
                for j in range(4):
                    mixed[i, j] += weight * forward[v, i, j]
        a, b, c = mixed[0], mixed[1], mixed[2]
        out = inverse[s]
        for i in range(3):
            j, k = (i + 1) % 3, (i + 2) % 3
            out[i, 0] = b[j] * c[k] - b[k] * c[j]
            out[i, 1] = c[j] * a[k] - c[k] * a[j]
            out[i, 2] = a[j] * b[k] - a[k] * b[j]
        determinant = a[0] * out[0, 0] + a[1] * out[1, 0] + a[2] * out[2, 0]
        for i in range(3):
            for j in range(3):
                out[i, j] /= determinant
            out[i, 3] = -(out[i, 0] * a[3] + out[i, 1] * b[3] + out[i, 2] * c[3])
            x_canonical[s, i] = out[i, 0] * x[s, 0] + out[i, 1] * x[s, 1] + out[i, 2] * x[s, 2] + out[i, 3]
