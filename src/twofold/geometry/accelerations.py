"""Accelerations of what was seen at even or uneven times."""

import numpy as np
from jaxtyping import Float
from torch import Tensor

SHORTEST = 0.25
"""Share of the mean gap between frames below which two of them count as that far apart: time stamps are rounded."""


def limited_gaps(gaps: Float[np.ndarray, "g"]) -> Float[np.ndarray, "g"]:
    """Times between frames, seconds, none below `SHORTEST` times their mean: time stamps are rounded.

    >>> limited_gaps(np.array([1.0, 0.0, 2.0])).tolist()
    [1.0, 0.25, 2.0]
    """
    return np.maximum(gaps, SHORTEST * gaps.mean()) if len(gaps) else gaps


def accelerations(
    values: Float[Tensor, "t *n"], fps: float, seconds: Float[Tensor, "t"] | None = None, reach: int = 1
) -> Float[Tensor, "u *n"]:
    r"""Second derivatives by time, per second squared, from differences over `reach` frames to either side.

    \[ a_i = \frac{2}{h_i + h_{i+r}} \Big( \frac{x_{i+r} - x_i}{h_{i+r}} - \frac{x_i - x_{i-r}}{h_i} \Big),
    \qquad h_i = t_i - t_{i-r} \]

    which is $(x_{i+r} - 2 x_i + x_{i-r}) f^2 / r^2$ for frames at the even times $t_i = i / f$.

    >>> import torch
    >>> fall = torch.tensor([0.0, 0.1, 0.3, 0.4])
    >>> accelerations(4.9 * fall**2, 7.5, fall).round(decimals=4)
    tensor([9.8000, 9.8000])

    Args:
        values: in each frame.
        fps: frames per second, on average.
        seconds: when each was seen; None for even times.
        reach: $r$, frames; the first and the last r have no acceleration.
    """
    middle = values[reach:-reach]
    if seconds is None:
        return (values[2 * reach :] - 2 * middle + values[: -2 * reach]) * (fps / reach) ** 2
    gaps = (seconds[reach:] - seconds[:-reach]).clamp_min(SHORTEST * reach / fps)
    gaps = gaps.to(values).reshape(-1, *[1] * (values.dim() - 1))
    before, after = gaps[:-reach], gaps[reach:]
    rise = (values[2 * reach :] - middle) / after - (middle - values[: -2 * reach]) / before
    return rise * 2 / (before + after)
