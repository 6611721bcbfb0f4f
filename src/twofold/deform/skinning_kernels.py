"""Compiled loops of inverse skinning and its reverse pass, for CPUs; `skinning` holds the same in PyTorch."""

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


@compiled
def transposed_linear(inverse, out):  # noqa: ANN001, ANN201
    """out[S 3 3] = transposed linear parts of transforms [S 3 4]."""
    for s in range(inverse.shape[0]):
        for i in range(3):
            for j in range(3):
                out[s, i, j] = inverse[s, j, i]


@compiled
def map_points_backward(x_canonical, inverse, nearest, weights, by_x, by_transposed, out):  # noqa: ANN001, ANN201
    r"""Adds to out[V 3 4] the cotangent of the vertices' transforms, of samples in their order: `with_pose_gradient`.

    With the blended transform (A | t) of a sample, the gradients g by x_c and G by A^-1,

    \[ \bar t = -A^{-\top} g, \qquad \bar A = \bar t \, x_c^\top - A^{-\top} G A^{-\top}, \qquad
    \bar F_{v_k} \mathrel{+}= \omega_k (\bar A \mid \bar t) \]

    Args:
        x_canonical: x_c [S 3], metres.
        inverse: (A | t)^-1 [S 3 4].
        nearest: v, the K vertices of each sample [S K].
        weights: omega [S K].
        by_x: g [S 3].
        by_transposed: G transposed [S 3 3].
        out: zero, or what these are added to.
    """
    mixed, half = np.empty((3, 4), np.float32), np.empty((3, 3), np.float32)
    for s in range(nearest.shape[0]):
        a, g = inverse[s], by_transposed[s]
        for i in range(3):
            mixed[i, 3] = -(a[0, i] * by_x[s, 0] + a[1, i] * by_x[s, 1] + a[2, i] * by_x[s, 2])
            for k in range(3):
                half[i, k] = a[0, i] * g[k, 0] + a[1, i] * g[k, 1] + a[2, i] * g[k, 2]
        for i in range(3):
            for j in range(3):
                turned = half[i, 0] * a[j, 0] + half[i, 1] * a[j, 1] + half[i, 2] * a[j, 2]
                mixed[i, j] = mixed[i, 3] * x_canonical[s, j] - turned
        for k in range(nearest.shape[1]):
            vertex, weight = nearest[s, k], weights[s, k]
            for i in range(3):
                for j in range(4):
                    out[vertex, i, j] += weight * mixed[i, j]
