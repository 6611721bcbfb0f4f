"""Fourier features: how high a frequency a branch is able to see."""

import math

import torch
from jaxtyping import Float
from torch import Tensor


def encoding_size(octaves: int) -> int:
    """Columns that `fourier_encoding` gives for points of space.

    >>> encoding_size(5), encoding_size(10)
    (33, 63)
    """
    return 3 * (1 + 2 * octaves)


def fourier_encoding(x: Float[Tensor, "S 3"], octaves: int, include_pi: bool) -> Float[Tensor, "S C"]:
    """The point beside its sines and cosines at doubling frequencies (Eqs. 2, 4).

    >>> fourier_encoding(torch.tensor([[0.0, 0.5, 1.0]]), octaves=1, include_pi=True).round(decimals=3).abs()
    tensor([[0.0000, 0.5000, 1.0000, 0.0000, 1.0000, 0.0000, 1.0000, 0.0000, 1.0000]])

    Args:
        x: points, metres.
        octaves: number of frequencies, L_ind or L_d in the paper; 0 gives the point alone.
        include_pi: frequencies 2^k pi radians per metre, as printed; otherwise 2^k, as the authors' program has it.

    Returns:
        (x, sin f_0 x, cos f_0 x, ..., sin f_{L-1} x, cos f_{L-1} x), three columns each.
    """
    angles = x[:, None] * _frequencies(x, octaves, include_pi)
    waves = torch.stack([angles.sin(), angles.cos()], 2)
    return torch.cat([x, waves.flatten(1)], -1)


def encoding_pullback(
    encoded: Float[Tensor, "S C"], cotangent: Float[Tensor, "S C"], include_pi: bool
) -> Float[Tensor, "S 3"]:
    """J^T u, where J is the Jacobian of `fourier_encoding` by the points: the last step of a gradient's reverse pass.

    A sine's derivative is the cosine beside it, so the encoded points are all it needs.

    Args:
        encoded: what `fourier_encoding` gave.
        cotangent: u, one number for each column.
        include_pi: as it was for `fourier_encoding`.
    """
    octaves = (encoded.shape[-1] // 3 - 1) // 2
    sine, cosine = encoded[:, 3:].unflatten(-1, (octaves, 2, 3)).unbind(2)
    by_sine, by_cosine = cotangent[:, 3:].unflatten(-1, (octaves, 2, 3)).unbind(2)
    by_angle = by_sine * cosine - by_cosine * sine
    return cotangent[:, :3] + (by_angle * _frequencies(encoded, octaves, include_pi)).sum(1)


def _frequencies(like: Tensor, octaves: int, include_pi: bool) -> Float[Tensor, "L 1"]:
    frequencies = 2.0 ** torch.arange(octaves, dtype=like.dtype, device=like.device)[:, None]
    return frequencies * math.pi if include_pi else frequencies
