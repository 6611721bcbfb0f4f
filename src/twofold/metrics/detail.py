"""Measures of detail that need no trained network: multi-scale SSIM and a gradient-domain error.

They say whether edges and texture are where they should be. `gradient_error` stands in for LPIPS where its weights are
absent; it is another measure and is never shown under that name.
"""

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn.functional import avg_pool2d

from twofold.errors import TwofoldError
from twofold.metrics.image import GAUSSIAN_WINDOW, similarity_parts, to_8bit

SCALE_WEIGHTS = (0.0448, 0.2856, 0.3001, 0.2363, 0.1333)
"""Exponents of the five scales of multi-scale SSIM, finest first."""
GRADIENT_SCALES = 4
"""Octaves of the gradient-domain error: details of 1 to 8 pixels."""
PROTOCOLS = {
    "ms_ssim": "multi-scale structural similarity (Wang et al. 2003), whole image, 8 bit, Gaussian window, range 1; "
    "five scales or as many as the image has room for, with the weights' sum kept at 1",
    "gradient_error": "difference of the images' gradients over the sum of their lengths, mean of four octaves, "
    "subject's box, 8 bit: 0 for equal detail, 1 for none in common; needs no network and is not LPIPS",
}
"""What each number is, in one line."""


def ms_ssim(
    image: Float[Tensor, "h w 3"], truth: Float[Tensor, "h w 3"], data_range: float = 1.0, truncate: bool = False
) -> float:
    r"""Multi-scale structural similarity (Wang, Simoncelli and Bovik 2003), mean of the channels.

    $$\mathrm{MS} = \bar{l cs}_S^{\,w_S} \prod_{s < S} \bar{cs}_s^{\,w_s}$$

    over the mean factors of SSIM (`similarity_parts`) in images halved s times by means of 2 x 2 pixels. Images too
    small for five scales use the first S weights divided by their sum. Negative means count as 0.

    Args:
        image: the image, colours 0..1.
        truth: what it should be.
        data_range: see `twofold.metrics.image.ssim`.
        truncate: see `twofold.metrics.image.to_8bit`.

    >>> flat = torch.full((22, 22, 3), 0.2)  # two scales; only the last looks at the brightness
    >>> round(ms_ssim(flat, flat + 0.6), 4), round(0.4707 ** (0.2856 / (0.0448 + 0.2856)), 4)
    (0.5213, 0.5213)

    Raises:
        TwofoldError: a side is shorter than the window.
    """
    side = min(image.shape[:2])
    if side < GAUSSIAN_WINDOW:
        size = "x".join(str(n) for n in image.shape[:2])
        raise TwofoldError(
            f"SSIM needs at least {GAUSSIAN_WINDOW}x{GAUSSIAN_WINDOW} pixels, it got {size}; use larger images."
        )
    count = sum(side // 2**scale >= GAUSSIAN_WINDOW for scale in range(len(SCALE_WEIGHTS)))
    total = sum(SCALE_WEIGHTS[:count])
    x, y = (to_8bit(original, truncate).double() / 255 for original in (image, truth))
    product = torch.ones(3, dtype=torch.float64)
    for scale in range(count):
        luminance, structure = similarity_parts(x, y, data_range)
        last = scale == count - 1
        means = (luminance * structure if last else structure).mean((1, 2))
        product = product * means.clamp_min(0) ** (SCALE_WEIGHTS[scale] / total)
        x, y = _halved(x), _halved(y)
    return product.mean().item()


def gradient_error(
    image: Float[Tensor, "h w 3"], truth: Float[Tensor, "h w 3"], inside: Bool[Tensor, "h w"] | None = None,
    truncate: bool = False,
) -> float:  # fmt: skip
    r"""Share of the images' gradients that they do not have in common, 0..1, mean over octaves.

    $$E = \frac{1}{S} \sum_s \frac{\sum_p |\nabla x_s - \nabla y_s|_1}{\sum_p |\nabla x_s|_1 + |\nabla y_s|_1}$$

    with forward differences along rows and columns of all channels, in images halved s times by means of 2 x 2
    pixels. Wrong brightness costs nothing, a blurred edge as much as it lacks, an edge in the wrong place all of it.
    Squared errors prefer the blur; people, and LPIPS with them, do not.

    Args:
        image: the image, colours 0..1, at least 2 pixels along each side.
        truth: what it should be.
        inside: differences between two pixels that both lie here count; None for all.
        truncate: see `twofold.metrics.image.to_8bit`.

    >>> edge = torch.zeros(2, 4, 3)
    >>> edge[:, 2:] = 1
    >>> round(gradient_error(edge / 5 + 0.4, edge / 5), 6), gradient_error(edge.flip(1), edge)
    (0.0, 1.0)
    """
    x, y = (to_8bit(original, truncate).double() / 255 for original in (image, truth))
    weight = torch.ones(x.shape[:2], dtype=torch.float64) if inside is None else inside.double()
    errors: list[Tensor] = []
    while len(errors) < GRADIENT_SCALES and (not errors or min(x.shape[:2]) > 1):
        difference, size = torch.zeros((), dtype=torch.float64), torch.zeros((), dtype=torch.float64)
        for axis in (0, 1):
            last = weight.shape[axis] - 1
            both = (weight.narrow(axis, 0, last) * weight.narrow(axis, 1, last))[..., None]
            one, other = x.diff(dim=axis), y.diff(dim=axis)
            difference += (both * (one - other).abs()).sum()
            size += (both * (one.abs() + other.abs())).sum()
        errors.append(difference / size if size > 0 else torch.zeros_like(size))
        x, y = _halved(x), _halved(y)
        weight = (_halved(weight[..., None])[..., 0] == 1).double()
    return torch.stack(errors).mean().item()


def _halved(image: Float[Tensor, "h w c"]) -> Float[Tensor, "H W c"]:
    return avg_pool2d(image.movedim(-1, 0), 2).movedim(0, -1) if min(image.shape[:2]) > 1 else image
