"""Fourier features: how high a frequency a branch is able to see."""

import math

import torch
from jaxtyping import Float
from torch import Tensor


def encoding_size(octaves: int, dimensions: int = 3) -> int:
    r"""Columns that `fourier_encoding` gives for points of space, or for rows of `dimensions` numbers: $d (1 + 2L)$.

    >>> encoding_size(5), encoding_size(10), encoding_size(10, 4)
    (33, 63, 84)
    """
    return dimensions * (1 + 2 * octaves)


def fourier_encoding(x: Float[Tensor, "S d"], octaves: int, include_pi: bool) -> Float[Tensor, "S C"]:
    r"""The point beside its sines and cosines at doubling frequencies (Eqs. 2, 4).

    \[ \gamma_L(x) = \big( x, \sin(f_0 x), \cos(f_0 x), \dots, \sin(f_{L-1} x), \cos(f_{L-1} x) \big), \qquad
    f_k = 2^k \pi \text{ as printed, } 2^k \text{ as released} \]

    >>> fourier_encoding(torch.tensor([[0.0, 0.5, 1.0]]), octaves=1, include_pi=True).round(decimals=3).abs()
    tensor([[0.0000, 0.5000, 1.0000, 0.0000, 1.0000, 0.0000, 1.0000, 0.0000, 1.0000]])

    Args:
        x: points, metres; or rows of any other numbers.
        octaves: number of frequencies, L_ind or L_d in the paper; 0 gives the point alone.
        include_pi: frequencies 2^k pi radians per metre, as printed; otherwise 2^k, as the authors' program has it.

    Returns:
        (x, sin f_0 x, cos f_0 x, ..., sin f_{L-1} x, cos f_{L-1} x), d columns each.
    """
    angles = x[:, None] * _frequencies(x, octaves, include_pi)
    waves = torch.stack([angles.sin(), angles.cos()], 2)
    return torch.cat([x, waves.flatten(1)], -1)


def encoding_pullback(
    encoded: Float[Tensor, "S C"], cotangent: Float[Tensor, "S C"], include_pi: bool
) -> Float[Tensor, "S 3"]:
    r"""$J^\top u$ with the Jacobian $J$ of `fourier_encoding` by points: the last step of a gradient's reverse pass.

    A sine's derivative is the cosine beside it, so the encoded points are all it needs:

    \[ J^\top u = u_x + \sum_k f_k \big( u_{\sin,k} \cos(f_k x) - u_{\cos,k} \sin(f_k x) \big) \]

    >>> encoded = fourier_encoding(torch.zeros(1, 3), octaves=2, include_pi=False)
    >>> encoding_pullback(encoded, torch.ones(1, 15), include_pi=False)  # 1 + 2^0 + 2^1 at zero
    tensor([[4., 4., 4.]])

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


def hann_encoding(x: Float[Tensor, "S d"], octaves: int, open_bands: float) -> Float[Tensor, "S C"]:
    r"""Sines and cosines at doubling frequencies whose bands open one after the other (HumanNeRF Eq. 9).

    \[ w_k = \tfrac12 \big( 1 - \cos(\pi \, \mathrm{clamp}(\alpha - k, 0, 1)) \big) \]

    is the factor of band k, with $\alpha$ the bands that are open; x itself is not among the columns.

    >>> hann_encoding(torch.zeros(1, 1), octaves=3, open_bands=1.5).round(decimals=2)
    tensor([[0.0000, 1.0000, 0.0000, 0.5000, 0.0000, 0.0000]])

    Args:
        x: points, metres.
        octaves: number of frequencies, 2^k radians per metre.
        open_bands: how many bands are open, 0 to `octaves`; see `open_hann_bands`.

    Returns:
        (w_0 sin x, w_0 cos x, ..., w_{L-1} sin 2^{L-1} x, w_{L-1} cos 2^{L-1} x), d columns each.
    """
    angles = x[:, None] * _frequencies(x, octaves, include_pi=False)
    bands = torch.arange(octaves, dtype=x.dtype, device=x.device)
    windows = (1 - torch.cos(math.pi * (open_bands - bands).clamp(0, 1))) / 2
    return (torch.stack([angles.sin(), angles.cos()], 2) * windows[:, None, None]).flatten(1)


def open_hann_bands(step: int, first_step: int, last_step: int, octaves: int) -> float:
    r"""How many bands of `hann_encoding` are open at a training step.

    \[ \alpha = L \, \frac{\max(i - i_{\text{first}}, 0)}{i_{\text{last}} - i_{\text{first}}} \]

    >>> open_hann_bands(30_000, first_step=10_000, last_step=50_000, octaves=6)
    3.0
    """
    return octaves * max(step - first_step, 0) / (last_step - first_step)
