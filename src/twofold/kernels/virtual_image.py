"""Structural similarity of images whose pixels are picked from a list of colours: one compiled loop with its gradient.

Beside the structural loss of unrelated rays, whose image has ten pixels for each ray and 640 windows: as PyTorch's
operations gathering, convolving and their reverse passes take twenty times as long.
"""

# pyright: reportMissingParameterType=false

from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.autograd.function import once_differentiable

from twofold.kernels.parallel import compiled


def can_pick(color: Tensor, truth: Tensor) -> bool:
    """Whether `picked_ssim` can be used: single precision on a CPU, and nothing to learn from the true colours."""
    return not truth.requires_grad and all(t.dtype == torch.float32 and not t.is_cuda for t in (color, truth))


def picked_ssim(
    color: Float[Tensor, "R C"], truth: Float[Tensor, "R C"], order: Int[Tensor, "h w"], window: Float[Tensor, "k k"],
    constants: tuple[float, float],
) -> Float[Tensor, ""]:  # fmt: skip
    r"""Mean over windows and channels of the structural similarity of two images, differentiable by `color`.

    Pixel (i, j) of the images is `color[order[i, j]]` and `truth[order[i, j]]`. Windows lie beside each other, the
    first one reaches one pixel, which is zero, beyond the image. With means $\mu$, variances and covariance $\sigma$
    weighted by the window,

    \[ \text{SSIM} = \frac{2 \mu_x \mu_y + c_1}{\mu_x^2 + \mu_y^2 + c_1} \,
    \frac{2 \sigma_{xy} + c_2}{\sigma_x^2 + \sigma_y^2 + c_2} \]

    >>> flat = torch.full((2, 1), 0.5)
    >>> picked_ssim(flat, flat, torch.tensor([[0, 1], [1, 0]]), torch.full((4, 4), 1 / 16), (1e-4, 9e-4))
    tensor(1.)

    Args:
        color: from which pixels are picked.
        truth: the other image's.
        order: which colour each pixel has.
        window: weights, they sum to 1.
        constants: $c_1$ and $c_2$, added so that nothing is divided by zero.
    """
    return _PickedSsim.apply(color, truth, order, window, constants)  # type: ignore[return-value]


class _PickedSsim(torch.autograd.Function):
    @staticmethod
    def forward(  # type: ignore[override]
        ctx: Any, color: Tensor, truth: Tensor, order: Tensor, window: Tensor, constants: tuple[float, float]
    ) -> Tensor:
        by_color = torch.zeros(color.shape)
        given = (t.detach().contiguous().numpy() for t in (color, truth, order, window.double()))
        found = _ssim(*given, *constants, by_color.numpy())
        ctx.save_for_backward(by_color)
        return torch.tensor(found, dtype=torch.float32)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, by_ssim: Tensor) -> tuple[Tensor, None, None, None, None]:  # type: ignore[override]
        (by_color,) = ctx.saved_tensors
        return by_ssim * by_color, None, None, None, None


@compiled
def _ssim(color, truth, order, window, c1, c2, by_color):  # noqa: ANN001, ANN202
    """Mean similarity; by_color[R C] += its gradient."""
    height, width = order.shape
    size = window.shape[0]
    down, across = (height + 2 - size) // size + 1, (width + 2 - size) // size + 1
    share = 1 / (down * across * color.shape[1])
    total = 0.0
    for i in range(down):
        for j in range(across):
            top, left = i * size - 1, j * size - 1
            for c in range(color.shape[1]):
                mean_x = mean_y = square_x = square_y = product = 0.0
                for a in range(max(top, 0), min(top + size, height)):
                    for b in range(max(left, 0), min(left + size, width)):
                        ray, weight = order[a, b], window[a - top, b - left]
                        x, y = np.float64(color[ray, c]), np.float64(truth[ray, c])
                        mean_x += weight * x
                        mean_y += weight * y
                        square_x += weight * x * x
                        square_y += weight * y * y
                        product += weight * x * y
                squares = mean_x * mean_x + mean_y * mean_y + c1
                spread = square_x - mean_x * mean_x + square_y - mean_y * mean_y + c2
                light = (2 * mean_x * mean_y + c1) / squares
                structure = (2 * (product - mean_x * mean_y) + c2) / spread
                total += light * structure
                # By a colour: the window's weight times what follows from mean, variance and covariance.
                by_mean = (2 * mean_y - 2 * light * mean_x) / squares * structure * share
                along = 2 * light / spread * share
                for a in range(max(top, 0), min(top + size, height)):
                    for b in range(max(left, 0), min(left + size, width)):
                        ray, weight = order[a, b], window[a - top, b - left]
                        x, y = np.float64(color[ray, c]), np.float64(truth[ray, c])
                        change = y - mean_y - structure * (x - mean_x)
                        by_color[ray, c] += np.float32(weight * (by_mean + along * change))
    return total * share
