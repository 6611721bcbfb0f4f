"""Compiled compositing of samples along rays and its reverse pass, for CPUs; `rendering` has the twin in PyTorch."""

# pyright: reportMissingParameterType=false

import numpy as np

from twofold.kernels.parallel import compiled

_ONE, _HALF = np.float32(1), np.float32(0.5)


@compiled
def weights(optical, ray_index, out):  # noqa: ANN001, ANN201
    """out[S] = what each sample adds to its ray, from density times length [S]."""
    before = 0.0
    for s in range(optical.shape[0]):
        if s > 0 and ray_index[s] != ray_index[s - 1]:
            before = 0.0
        out[s] = np.exp(-before) * -np.expm1(-optical[s])
        before += optical[s]


@compiled
def surface(sdf, beta, color, normal, depth, delta, ray_index, weight, optical, out):  # noqa: ANN001, ANN201
    """weight[S], optical[S], out[R 8] = `composite_surface`; `out` is zero before."""
    before, ray = 0.0, -1
    for s in range(sdf.shape[0]):
        if ray_index[s] != ray:
            before, ray = 0.0, ray_index[s]
        tail = _HALF * np.exp(-abs(sdf[s]) / beta)
        here = (tail if sdf[s] > 0 else _ONE - tail) / beta * delta[s]
        w = np.float32(np.exp(-before) * -np.expm1(-here))
        optical[s], weight[s] = here, w
        before += here
        row = out[ray]
        row[3] += w
        row[4] += w * depth[s]
        for c in range(3):
            row[c] += w * color[s, c]
            row[5 + c] += w * normal[s, c]


@compiled
def surface_backward(  # noqa: ANN201
    sdf, beta, color, normal, depth, delta, ray_index, weight, optical, by_out, by_sdf, by_color  # noqa: ANN001
):  # fmt: skip
    """by_sdf[S], by_color[S 3] = cotangents from `by_out` [R 8]; returns that of `beta`.

    The density's slope by the distance is -t / beta^2 on both sides, with t = exp(-|s| / beta) / 2.
    """
    count = sdf.shape[0]
    before, total, behind, by_beta = np.empty(count), 0.0, 0.0, 0.0
    for s in range(count):
        if s > 0 and ray_index[s] != ray_index[s - 1]:
            total = 0.0
        total += optical[s]
        before[s] = total
    for s in range(count - 1, -1, -1):
        if s + 1 < count and ray_index[s] != ray_index[s + 1]:
            behind = 0.0
        row = by_out[ray_index[s]]
        by_weight = row[3] + row[4] * depth[s]
        for c in range(3):
            by_color[s, c] = weight[s] * row[c]
            by_weight += row[c] * color[s, c] + row[5 + c] * normal[s, c]
        by_density = (by_weight * np.exp(-before[s]) - behind) * delta[s]
        behind += by_weight * weight[s]
        far = abs(sdf[s]) / beta
        tail = _HALF * np.exp(-far)
        by_sdf[s] = -by_density * tail / (beta * beta)
        slope = (far - _ONE) * tail if sdf[s] > 0 else tail - _ONE - far * tail
        by_beta += by_density * slope / (beta * beta)
    return by_beta
