"""Compiled normals from gradients, for CPUs; `output` has the twin in PyTorch."""

# pyright: reportMissingParameterType=false

import numpy as np

from twofold.kernels.parallel import compiled


@compiled
def turned(turn, gradient, least, out, begin, end):  # noqa: ANN001, ANN201
    """out[S 3] = gradients [S 3] turned by `turn` [S 3 3], at unit length or divided by `least`, for begin..end."""
    for s in range(begin, end):
        a, b, c = gradient[s, 0], gradient[s, 1], gradient[s, 2]
        x = turn[s, 0, 0] * a + turn[s, 0, 1] * b + turn[s, 0, 2] * c
        y = turn[s, 1, 0] * a + turn[s, 1, 1] * b + turn[s, 1, 2] * c
        z = turn[s, 2, 0] * a + turn[s, 2, 1] * b + turn[s, 2, 2] * c
        size = np.float32(1) / max(np.sqrt(x * x + y * y + z * z), least)
        out[s, 0], out[s, 1], out[s, 2] = x * size, y * size, z * size
