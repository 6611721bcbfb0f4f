"""The compiled test for mis-warped samples, for CPUs; `pruning` holds its twin in PyTorch, for GPUs and for tests."""

# pyright: reportMissingParameterType=false

import numpy as np

from twofold.kernels.parallel import compiled
from twofold.sampling.walk_kernels import is_closer


@compiled
def miswarped(x_posed, x_canonical, first, posed, canonical, slack, out, begin, end):  # noqa: ANN001, ANN201
    """out[S] = whether the canonical point is closer to the canonical body than the posed one, `slack` granted.

    `first` [S] is each sample's nearest vertex, `posed` [V 3] the posed vertices; `canonical` is a shell's arrays.
    """
    low, voxel, row, nearest, vertices = canonical
    for s in range(begin, end):
        total = np.float32(0)
        for i in range(3):
            difference = x_posed[s, i] - posed[first[s], i]
            total += difference * difference
        away = np.sqrt(total) - slack
        x, y, z = x_canonical[s, 0], x_canonical[s, 1], x_canonical[s, 2]
        out[s] = away > 0 and is_closer(x, y, z, away * away, low, voxel, row, nearest, vertices)
