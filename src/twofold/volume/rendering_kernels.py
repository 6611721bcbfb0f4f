"""Compiled weights of samples along rays and their reverse pass, for CPUs; `rendering` has the twin in PyTorch."""

# pyright: reportMissingParameterType=false

import numpy as np

from twofold.kernels.parallel import compiled


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
def weights_backward(optical, ray_index, weight, by_weight, out):  # noqa: ANN001, ANN201
    """out[S] = cotangent of density times length from that of the weights.

    A sample's weight grows with its own density, and dims all samples behind it.
    """
    before, behind = np.empty(optical.shape[0]), 0.0
    total = 0.0
    for s in range(optical.shape[0]):
        if s > 0 and ray_index[s] != ray_index[s - 1]:
            total = 0.0
        total += optical[s]
        before[s] = total
    for s in range(optical.shape[0] - 1, -1, -1):
        if s + 1 < optical.shape[0] and ray_index[s] != ray_index[s + 1]:
            behind = 0.0
        out[s] = by_weight[s] * np.exp(-before[s]) - behind
        behind += by_weight[s] * weight[s]
