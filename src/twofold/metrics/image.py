"""How close a rendered image is to a photograph: PSNR, SSIM, silhouette overlap.

Every metric is of the images as they are stored in 8 bit, rounded unless truncation is asked for, so it can be
measured again from the PNG files. Images hold colours in 0..1.
"""

import math
from typing import Literal, NamedTuple

import torch
from jaxtyping import Bool, Float, Float64, UInt8
from torch import Tensor
from torch.nn.functional import conv2d, max_pool2d

from twofold.errors import TwofoldError

PSNR_CEILING = 100.0
"""dB given to equal images, so that means and files stay finite."""
SSIM_WINDOW = 7
"""Pixels along one side of the uniform window."""
GAUSSIAN_WINDOW, GAUSSIAN_SIGMA = 11, 1.5
"""Pixels along one side of the Gaussian window, and its standard deviation in pixels."""
Window = Literal["uniform", "gaussian"]
"""How SSIM averages around a pixel."""
PROTOCOLS = {
    "psnr": "-10 log10 of the mean squared error over all pixels and channels, 8 bit, at most 100 dB",
    "psnr_box": "PSNR over the bounding box of the true mask (> 0.5), background included",
    "ssim": "structural similarity, whole image, 8 bit, 7x7 uniform window per channel, data range 1",
    "ssim_box": "the same SSIM over the bounding box of the true mask (> 0.5)",
    "ssim_range_2": "the same SSIM of the whole image with data range 2, as older programs compute it for floats",
    "silhouette_iou": "intersection over union of opacity > 0.5 and the true mask > 0.5",
}
"""What each number of `compare` is, in one line."""
IGNORED_PROTOCOL = (
    "{share:.1f} % of the box on average, hidden by something in front, are left out: PSNR and overlap are over the "
    "other pixels, SSIM over the windows that touch none of them"
)
"""A further line where pixels were ignored."""


def to_8bit(image: Float[Tensor, "*b"], truncate: bool = False) -> UInt8[Tensor, "*b"]:
    r"""Colours as a PNG stores them: clipped to 0..1, times 255, rounded.

    $$q(x) = \lfloor 255 \min(\max(x, 0), 1) + \tfrac{1}{2} \rfloor$$

    Args:
        image: colours.
        truncate: leave the half out, as `uint8(255 * x)` does in programs of the field. A colour of a photograph, read
            as n / 255, stays n in both forms.

    >>> to_8bit(torch.tensor([-1.0, 0.5, 2.0]))
    tensor([  0, 128, 255], dtype=torch.uint8)
    >>> to_8bit(torch.tensor([-1.0, 0.5, 2.0]), truncate=True)
    tensor([  0, 127, 255], dtype=torch.uint8)

    Raises:
        ValueError: a colour is not a number.
    """
    if image.isnan().any():
        raise ValueError("the image holds NaN")
    scaled = image.clamp(0, 1).mul(255)
    return (scaled if truncate else scaled.round()).to(torch.uint8)


def psnr(
    image: Float[Tensor, "h w 3"], truth: Float[Tensor, "h w 3"], mask: Bool[Tensor, "h w"] | None = None,
    truncate: bool = False,
) -> float:  # fmt: skip
    r"""Peak signal-to-noise ratio in dB, over the whole image or the pixels of `mask`.

    $$\mathrm{PSNR} = -10 \log_{10} \frac{1}{3 |M|} \sum_{p \in M} \|x_p - y_p\|^2$$

    Args:
        image: the image, colours 0..1.
        truth: what it should be.
        mask: pixels that count; None for all.
        truncate: see `to_8bit`.

    >>> round(psnr(torch.full((2, 2, 3), 0.4), torch.full((2, 2, 3), 0.5)), 2)  # 26 of 255
    19.83
    """
    squared = (_stored(image, truncate) - _stored(truth, truncate)).square()
    error = (squared if mask is None else squared[mask]).mean().item()
    return min(-10 * math.log10(error), PSNR_CEILING) if error > 0 else PSNR_CEILING


def ssim(
    image: Float[Tensor, "h w 3"], truth: Float[Tensor, "h w 3"], data_range: float = 1.0,
    ignored: Bool[Tensor, "h w"] | None = None, window: Window = "uniform", inside: Bool[Tensor, "h w"] | None = None,
    truncate: bool = False,
) -> float:  # fmt: skip
    r"""Structural similarity (Wang et al. 2004), mean of windows and channels.

    $$\mathrm{SSIM} = \frac{(2 \mu_x \mu_y + c_1)(2 \sigma_{xy} + c_2)}
    {(\mu_x^2 + \mu_y^2 + c_1)(\sigma_x^2 + \sigma_y^2 + c_2)}, \quad c_1 = (0.01 L)^2, \; c_2 = (0.03 L)^2$$

    with the data range $L$. Frames are over the windows that lie in the image whole. The uniform window has 7 x 7
    pixels and unbiased covariances (times 49/48), as scikit-image has them; the Gaussian one 11 x 11 with a standard
    deviation of 1.5 pixels and covariances as they are, as in the publication and in torchmetrics.

    Args:
        image: the image.
        truth: what it should be.
        data_range: 1 for colours in 0..1; 2 repeats what programs of the field got for floats without naming a range.
        ignored: pixels that count nowhere: the mean is over the windows that touch none of them.
        window: uniform or Gaussian.
        inside: the mean is over the windows whose middle lies here; None for all.
        truncate: see `to_8bit`.

    >>> flat = torch.full((8, 8, 3), 0.2)
    >>> round(ssim(flat, flat + 0.6), 4)  # (2 x 0.2 x 0.8 + 0.0001) / (0.04 + 0.64 + 0.0001)
    0.4707

    Raises:
        TwofoldError: a side is shorter than the window, or no window is left.
    """
    size = SSIM_WINDOW if window == "uniform" else GAUSSIAN_WINDOW
    if min(image.shape[:2]) < size:
        have = "x".join(str(n) for n in image.shape[:2])
        raise TwofoldError(f"SSIM needs at least {size}x{size} pixels, it got {have}; use larger images.")
    moments = _moments(to_8bit(image, truncate), to_8bit(truth, truncate), window)
    chosen = torch.ones(moments.mean_x.shape[1:], dtype=torch.bool)
    if inside is not None:
        edge = size // 2
        chosen = inside[edge : inside.shape[0] - edge, edge : inside.shape[1] - edge]
    return _chosen_mean(_similarity(moments, data_range), chosen, ignored, size)


class _Moments(NamedTuple):
    """Of every window, channel by channel."""

    mean_x: Float64[Tensor, "3 h w"]
    mean_y: Float64[Tensor, "3 h w"]
    variances: Float64[Tensor, "3 h w"]
    covariance: Float64[Tensor, "3 h w"]


def _moments(x: Tensor, y: Tensor, window: Window) -> _Moments:
    """Of colours 0..255, of any type: whole numbers where the window is uniform."""
    x, y = (p.movedim(-1, 0).to(torch.float32 if window == "uniform" else torch.float64) for p in (x, y))
    planes = torch.stack([x, y, x * x + y * y, x * y])
    if window == "uniform":
        # Sums of up to 49 x 2 x 255^2 whole numbers, which float32 holds exactly: faster than means in float64.
        means, unbiased = _sums(_sums(planes, 2), 3).double() / SSIM_WINDOW**2, SSIM_WINDOW**2 / (SSIM_WINDOW**2 - 1)
    else:
        means, unbiased = blurred(planes.flatten(0, 1)[:, None])[:, 0].unflatten(0, (4, 3)), 1.0
    mean_x, mean_y, squares, product = means[0] / 255, means[1] / 255, means[2] / 255**2, means[3] / 255**2
    variances = unbiased * (squares - mean_x * mean_x - mean_y * mean_y)
    return _Moments(mean_x, mean_y, variances, unbiased * (product - mean_x * mean_y))


def _sums(planes: Tensor, axis: int) -> Tensor:
    """Sums of seven neighbours along an axis, as 4 + 2 + 1."""
    length = planes.shape[axis] - SSIM_WINDOW + 1
    two = planes.narrow(axis, 0, planes.shape[axis] - 1) + planes.narrow(axis, 1, planes.shape[axis] - 1)
    four = two.narrow(axis, 0, length) + two.narrow(axis, 2, length)
    return four + two.narrow(axis, 4, length) + planes.narrow(axis, 6, length)


def blurred(planes: Float[Tensor, "n 1 h w"]) -> Float[Tensor, "n 1 H W"]:
    """Means under the Gaussian window of SSIM where it lies in the image whole.

    >>> blurred(torch.ones(1, 1, 12, 13)).shape
    torch.Size([1, 1, 2, 3])
    """
    offsets = torch.arange(GAUSSIAN_WINDOW, dtype=planes.dtype) - GAUSSIAN_WINDOW // 2
    weights = (-0.5 * (offsets / GAUSSIAN_SIGMA).square()).exp()
    weights = (weights / weights.sum())[None, None]
    return conv2d(conv2d(planes, weights[..., None]), weights[:, :, None])


def similarity_parts(
    image: Float[Tensor, "h w 3"], truth: Float[Tensor, "h w 3"], data_range: float = 1.0
) -> tuple[Float64[Tensor, "3 H W"], Float64[Tensor, "3 H W"]]:  # fmt: skip
    r"""The two factors of SSIM under the Gaussian window, not rounded: luminance, and contrast with structure.

    $$l = \frac{2 \mu_x \mu_y + c_1}{\mu_x^2 + \mu_y^2 + c_1}, \qquad
    cs = \frac{2 \sigma_{xy} + c_2}{\sigma_x^2 + \sigma_y^2 + c_2}$$

    >>> flat = torch.full((11, 11, 3), 0.2)
    >>> l, cs = similarity_parts(flat, flat + 0.6)
    >>> round(l.mean().item(), 4), round(cs.mean().item(), 4)
    (0.4707, 1.0)
    """
    return _parts(_moments(255 * image.double(), 255 * truth.double(), "gaussian"), data_range)


def _parts(moments: _Moments, data_range: float) -> tuple[Tensor, Tensor]:
    c1, c2 = (0.01 * data_range) ** 2, (0.03 * data_range) ** 2
    x, y, variances, covariance = moments
    return (2 * x * y + c1) / (x.square() + y.square() + c1), (2 * covariance + c2) / (variances + c2)


def _similarity(moments: _Moments, data_range: float) -> Tensor:
    luminance, structure = _parts(moments, data_range)
    return luminance.mul_(structure)


def _chosen_mean(similarity: Tensor, chosen: Tensor, ignored: Tensor | None, size: int) -> float:
    """Mean over the chosen windows that touch no ignored pixel."""
    if ignored is not None:
        chosen = chosen & ~(max_pool2d(ignored[None].float(), size, stride=1)[0] > 0)
    if not chosen.any():
        raise TwofoldError("Every window of SSIM touches ignored pixels or lies outside; leave this frame out.")
    return (similarity.mean() if chosen.all() else similarity[:, chosen].mean()).item()


def subject_box(mask: Float[Tensor, "h w"], margin: int = 0) -> tuple[slice, slice]:
    """Rows and columns that bound the mask (> 0.5), widened by `margin` pixels but not beyond the image.

    Raises:
        TwofoldError: the mask is empty.
    """
    inside = mask > 0.5
    if not inside.any():
        raise TwofoldError("The mask is empty, so the subject has no box; leave this frame out or correct its mask.")

    def extent(occupied: Tensor) -> slice:
        index = occupied.nonzero()[:, 0]
        return slice(max(int(index[0]) - margin, 0), min(int(index[-1]) + 1 + margin, len(occupied)))

    return extent(inside.any(1)), extent(inside.any(0))


def psnr_box(
    image: Float[Tensor, "h w 3"],
    truth: Float[Tensor, "h w 3"],
    mask: Float[Tensor, "h w"],
    margin: int = 0,
    ignored: Bool[Tensor, "h w"] | None = None,
) -> float:
    """PSNR in dB over the subject's box, which a large background cannot flatter, without `ignored` pixels."""
    box = subject_box(mask, margin)
    return psnr(image[box], truth[box], None if ignored is None else ~ignored[box])


def ssim_box(
    image: Float[Tensor, "h w 3"],
    truth: Float[Tensor, "h w 3"],
    mask: Float[Tensor, "h w"],
    margin: int = 0,
    ignored: Bool[Tensor, "h w"] | None = None,
) -> float:
    """SSIM over the subject's box, without windows that touch `ignored` pixels."""
    box = subject_box(mask, margin)
    return ssim(image[box], truth[box], ignored=None if ignored is None else ignored[box])


def silhouette_iou(
    opacity: Float[Tensor, "h w"],
    mask: Float[Tensor, "h w"],
    threshold: float = 0.5,
    ignored: Bool[Tensor, "h w"] | None = None,
) -> float:
    """Intersection over union of two silhouettes, without `ignored` pixels; 1 where both are empty."""
    ours, theirs = opacity > threshold, mask > threshold
    if ignored is not None:
        ours, theirs = ours & ~ignored, theirs & ~ignored
    union = (ours | theirs).sum().item()
    return (ours & theirs).sum().item() / union if union else 1.0


def compare(
    image: Float[Tensor, "h w 3"],
    truth: Float[Tensor, "h w 3"],
    opacity: Float[Tensor, "h w"],
    mask: Float[Tensor, "h w"],
    ignored: Bool[Tensor, "h w"] | None = None,
) -> dict[str, float]:
    """All metrics of one image, named as in `PROTOCOLS`; pixels that are `ignored` count in none of them."""
    if ignored is not None and not ignored.any():
        ignored = None
    if min(image[subject_box(mask)].shape[:2]) < SSIM_WINDOW:
        ssim(image[subject_box(mask)], truth[subject_box(mask)])  # says what is wrong
    # One pass of windows serves the whole image, its box (the windows within) and both ranges.
    moments = _moments(to_8bit(image), to_8bit(truth), "uniform")
    everywhere = torch.ones(moments.mean_x.shape[1:], dtype=torch.bool)
    boxed = torch.zeros_like(everywhere)
    boxed[tuple(slice(part.start, part.stop - SSIM_WINDOW + 1) for part in subject_box(mask))] = True
    range_1, range_2 = _similarity(moments, 1.0), _similarity(moments, 2.0)
    return {
        "psnr": psnr(image, truth, None if ignored is None else ~ignored),
        "psnr_box": psnr_box(image, truth, mask, ignored=ignored),
        "ssim": _chosen_mean(range_1, everywhere, ignored, SSIM_WINDOW),
        "ssim_box": _chosen_mean(range_1, boxed, ignored, SSIM_WINDOW),
        "ssim_range_2": _chosen_mean(range_2, everywhere, ignored, SSIM_WINDOW),
        "silhouette_iou": silhouette_iou(opacity, mask, ignored=ignored),
    }


def _stored(image: Tensor, truncate: bool = False) -> Tensor:
    """What is read back from a PNG, in double precision: SSIM subtracts nearly equal numbers."""
    return to_8bit(image, truncate).double() / 255
