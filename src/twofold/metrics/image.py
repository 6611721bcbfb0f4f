"""How close a rendered image is to a photograph: PSNR, SSIM, silhouette overlap.

Every figure is of the images as they are stored, rounded to 8 bit, so it can be measured again from the PNG files.
Images hold colours in 0..1.
"""

import math

import torch
from jaxtyping import Bool, Float, UInt8
from torch import Tensor
from torch.nn.functional import avg_pool2d, max_pool2d

from twofold.errors import TwofoldError

PSNR_CEILING = 100.0
"""dB given to equal images, so that means and files stay finite."""
SSIM_WINDOW = 7
"""Pixels along one side."""
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


def to_8bit(image: Float[Tensor, "*b"]) -> UInt8[Tensor, "*b"]:
    """Colours as a PNG stores them: clipped to 0..1, times 255, rounded.

    >>> to_8bit(torch.tensor([-1.0, 0.5, 2.0]))
    tensor([  0, 128, 255], dtype=torch.uint8)

    Raises:
        ValueError: a colour is not a number.
    """
    if image.isnan().any():
        raise ValueError("the image holds NaN")
    return image.clamp(0, 1).mul(255).round().to(torch.uint8)


def psnr(
    image: Float[Tensor, "h w 3"], truth: Float[Tensor, "h w 3"], mask: Bool[Tensor, "h w"] | None = None
) -> float:
    """Peak signal-to-noise ratio in dB, over the whole image or the pixels of `mask`."""
    squared = (_stored(image) - _stored(truth)).square()
    error = (squared if mask is None else squared[mask]).mean().item()
    return min(-10 * math.log10(error), PSNR_CEILING) if error > 0 else PSNR_CEILING


def ssim(
    image: Float[Tensor, "h w 3"],
    truth: Float[Tensor, "h w 3"],
    data_range: float = 1.0,
    ignored: Bool[Tensor, "h w"] | None = None,
) -> float:
    """Structural similarity, as scikit-image defines it: uniform window, unbiased covariances, mean of the channels.

    Args:
        image: the image.
        truth: what it should be.
        data_range: 1 for colours in 0..1; 2 repeats what programs of the field got for floats without naming a range.
        ignored: pixels that count nowhere: the mean is over the windows that touch none of them.

    Raises:
        TwofoldError: a side is shorter than the window, or every window touches an ignored pixel.
    """
    if min(image.shape[:2]) < SSIM_WINDOW:
        size = "x".join(str(n) for n in image.shape[:2])
        raise TwofoldError(f"SSIM needs at least 7x7 pixels, it got {size}; use larger images.")
    x, y = _stored(image).movedim(-1, 0), _stored(truth).movedim(-1, 0)

    def mean(values: Tensor) -> Tensor:
        return avg_pool2d(values[None], SSIM_WINDOW, stride=1)[0]

    unbiased = SSIM_WINDOW**2 / (SSIM_WINDOW**2 - 1)
    mean_x, mean_y = mean(x), mean(y)
    variance_x = unbiased * (mean(x * x) - mean_x * mean_x)
    variance_y = unbiased * (mean(y * y) - mean_y * mean_y)
    covariance = unbiased * (mean(x * y) - mean_x * mean_y)
    c1, c2 = (0.01 * data_range) ** 2, (0.03 * data_range) ** 2
    similarity = ((2 * mean_x * mean_y + c1) * (2 * covariance + c2)) / (
        (mean_x.square() + mean_y.square() + c1) * (variance_x + variance_y + c2)
    )
    if ignored is not None:
        touched = max_pool2d(ignored[None].double(), SSIM_WINDOW, stride=1)[0] > 0
        similarity = similarity[:, ~touched]
        if not similarity.numel():
            raise TwofoldError("Every window of SSIM touches ignored pixels; leave this frame out.")
    return similarity.mean().item()


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
    """All figures of one image, named as in `PROTOCOLS`; pixels that are `ignored` count in none of them."""
    if ignored is not None and not ignored.any():
        ignored = None
    return {
        "psnr": psnr(image, truth, None if ignored is None else ~ignored),
        "psnr_box": psnr_box(image, truth, mask, ignored=ignored),
        "ssim": ssim(image, truth, ignored=ignored),
        "ssim_box": ssim_box(image, truth, mask, ignored=ignored),
        "ssim_range_2": ssim(image, truth, 2.0, ignored),
        "silhouette_iou": silhouette_iou(opacity, mask, ignored=ignored),
    }


def _stored(image: Tensor) -> Tensor:
    """What is read back from a PNG, in double precision: SSIM subtracts nearly equal numbers."""
    return to_8bit(image).double() / 255
