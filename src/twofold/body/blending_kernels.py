"""Compiled loops over the few skinning weights of each vertex that are not zero, for CPUs; `blending` calls them."""

# pyright: reportMissingParameterType=false

import numpy as np

from twofold.kernels.parallel import compiled


@compiled
def compress(weights, start, joint, value):  # noqa: ANN001, ANN201
    """Lists what is not zero in weights[V J]: of vertex v the entries start[v] to start[v + 1] of joint and value.

    Returns:
        how many there are.
    """
    count = 0
    for v in range(weights.shape[0]):
        start[v] = count
        for j in range(weights.shape[1]):
            if weights[v, j] != 0:
                joint[count], value[count] = j, weights[v, j]
                count += 1
    start[weights.shape[0]] = count
    return count


@compiled
def blend(start, joint, value, transforms, out):  # noqa: ANN001, ANN201
    """out[V 3 4] = weighted sums of the upper rows of transforms [J 4 4]; weights as `compress` lists them."""
    for v in range(out.shape[0]):
        for r in range(3):
            for c in range(4):
                out[v, r, c] = 0
        for n in range(start[v], start[v + 1]):
            j, weight = joint[n], value[n]
            for r in range(3):
                for c in range(4):
                    out[v, r, c] += weight * transforms[j, r, c]


@compiled
def blend_backward(start, joint, value, by_blended, out):  # noqa: ANN001, ANN201
    """out[J 4 4] = cotangent of the transforms from that of their sums [V 3 4], summed in double in fixed order."""
    total = np.zeros(out.shape)
    for v in range(by_blended.shape[0]):
        for n in range(start[v], start[v + 1]):
            j, weight = joint[n], value[n]
            for r in range(3):
                for c in range(4):
                    total[j, r, c] += weight * by_blended[v, r, c]
    out[:] = total


@compiled
def skin(points, start, joint, value, transforms, out):  # noqa: ANN001, ANN201
    r"""out[V 3] = `skin`, metres: each point [V 3] moved by the weighted sum of the transforms [J 4 4].

    \[ y = \sum_j w_j (R_j x + t_j) \]
    """
    for v in range(points.shape[0]):
        x, y, z = points[v, 0], points[v, 1], points[v, 2]
        a, b, c = np.float32(0), np.float32(0), np.float32(0)
        for n in range(start[v], start[v + 1]):
            t, weight = transforms[joint[n]], value[n]
            a += weight * (t[0, 0] * x + t[0, 1] * y + t[0, 2] * z + t[0, 3])
            b += weight * (t[1, 0] * x + t[1, 1] * y + t[1, 2] * z + t[1, 3])
            c += weight * (t[2, 0] * x + t[2, 1] * y + t[2, 2] * z + t[2, 3])
        out[v, 0], out[v, 1], out[v, 2] = a, b, c


@compiled
def skin_backward(points, start, joint, value, transforms, given, by_points, by_transforms):  # noqa: ANN001, ANN201
    r"""Cotangents of points [V 3] and transforms [J 4 4] from that of the skinned points, g [V 3].

    \[ \bar x = \sum_j w_j R_j^\top g, \qquad \bar R_j = \sum_v w_{vj} \, g_v x_v^\top, \qquad
    \bar t_j = \sum_v w_{vj} \, g_v \]
    """
    total = np.zeros(by_transforms.shape)
    for v in range(points.shape[0]):
        for c in range(3):
            by_points[v, c] = 0
        for n in range(start[v], start[v + 1]):
            j, weight = joint[n], value[n]
            for r in range(3):
                pull = weight * given[v, r]
                for c in range(3):
                    by_points[v, c] += pull * transforms[j, r, c]
                    total[j, r, c] += pull * points[v, c]
                total[j, r, 3] += pull
    by_transforms[:] = total
