"""What training makes small. Each term is a mean over rays, points or pixels unless it says otherwise."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional as F

from twofold.config import require_within

S3IM_REPEATS = 10
"""Orders in which the rays are laid out in the virtual picture: as given, then permuted at random."""
S3IM_WINDOW = 4
"""Pixels across the window of `s3im`, and between two windows."""
S3IM_SIGMA = 1.5
"""Standard deviation of that window, pixels."""
MOST_STEPS = 10**12
"""No training takes so many; a step of it means never."""


@dataclass(frozen=True)
class LossConfig:
    """Weights of the loss terms; a weight of zero leaves the term out."""

    reconstruction: float = 1.0
    eikonal: float = 0.1
    common: float = 0.5
    lpips: float = 1.0
    lpips_start: int = 20_000
    """First step with the perceptual term."""
    mask: float = 0.1
    mask_form: Literal["sides", "mean"] = "sides"
    """"sides": inside and outside rays averaged apart, as released; "mean": plain mean."""
    s3im: float = 0.1
    eikonal_points: int = 512
    """Random canonical body vertices, each moved by a normal deviate."""
    eikonal_spread: float = 0.01
    """Standard deviation of that, metres."""
    reduction: Literal["mean", "sum"] = "mean"
    """Whether colour differences are averaged over rays and channels, as released, or summed, as printed."""

    def __post_init__(self) -> None:
        """Refuses weights that reward what they should punish."""
        weights = (self.eikonal, self.common, self.lpips, self.mask, self.s3im)
        right = min(weights) >= 0 < self.reconstruction
        if not right:
            raise ValueError("weights should not be negative, reconstruction positive")
        require_within(
            self, reconstruction=(0, 1e6), eikonal=(0, 1e6), common=(0, 1e6), lpips=(0, 1e6), mask=(0, 1e6),
            s3im=(0, 1e6), lpips_start=(0, MOST_STEPS), eikonal_points=(1, 1_000_000), eikonal_spread=(0, 1),
        )  # fmt: skip


def reconstruction(
    color: Float[Tensor, "R 3"], truth: Float[Tensor, "R 3"], reduction: Literal["mean", "sum"] = "mean"
) -> Float[Tensor, ""]:
    """Absolute difference of rendered and true colours (Eq. 9).

    >>> black, grey = torch.zeros(2, 3), torch.full((2, 3), 0.5)
    >>> reconstruction(black, grey), reconstruction(black, grey, "sum")
    (tensor(0.5000), tensor(3.))

    Args:
        color: rendered, 0..1.
        truth: of the picture, 0..1.
        reduction: mean over rays and channels, as released, or sum, as printed.
    """
    difference = (color - truth).abs()
    return difference.mean() if reduction == "mean" else difference.sum()


def common(
    base_color: Float[Tensor, "R 3"], truth: Float[Tensor, "R 3"], reduction: Literal["mean", "sum"] = "mean"
) -> Float[Tensor, ""]:
    """The same for the picture that the base branch renders alone (Eq. 11); it keeps that branch from idling.

    Args:
        base_color: rendered from s1 and c1, 0..1.
        truth: of the picture, 0..1.
        reduction: as in `reconstruction`.
    """
    return reconstruction(base_color, truth, reduction)


def eikonal(gradient: Float[Tensor, "S 3"]) -> Float[Tensor, ""]:
    """Mean of (|gradient| - 1)^2: a signed distance grows by a metre a metre (Eq. 10).

    Args:
        gradient: of the signed distance by the canonical point.
    """
    return (gradient.norm(dim=-1) - 1).square().mean()


def total(terms: Mapping[str, Float[Tensor, ""]], weights: Mapping[str, float] | None = None) -> Float[Tensor, ""]:
    """Weighted sum of named terms (Eq. 12).

    >>> total({"reconstruction": torch.tensor(2.0), "eikonal": torch.tensor(3.0)}, {"eikonal": 0.1})
    tensor(2.3000)

    Args:
        terms: by name, at least one.
        weights: lambda of each; 1 where none is given.

    Raises:
        ValueError: there are no terms, or a weight names none of them.
    """
    weights = weights or {}
    if not terms or set(weights) - set(terms):
        raise ValueError(f"weights are for {sorted(weights)}, the terms are {sorted(terms)}")
    return torch.stack([weights.get(name, 1.0) * term for name, term in terms.items()]).sum()


def mask(
    opacity: Float[Tensor, "R"], coverage: Float[Tensor, "R"], form: Literal["sides", "mean"] = "sides"
) -> Float[Tensor, ""]:
    """Absolute difference of opacity and mask.

    >>> opacity, coverage = torch.tensor([0.5, 0.0, 0.0, 0.0]), torch.tensor([1.0, 0.0, 0.0, 0.0])
    >>> mask(opacity, coverage), mask(opacity, coverage, "mean")
    (tensor(0.5000), tensor(0.1250))

    Args:
        opacity: rendered, 0..1.
        coverage: share of the pixel that the person covers; for "sides" a pixel counts to both sides by its shares.
        form: "sides" adds the mean over the inside and the mean over the outside, as released, so that the smaller
            side weighs as much as the larger; "mean" is the mean over all rays.
    """
    difference = (opacity - coverage).abs()
    if form == "mean":
        return difference.mean()
    return _mean_over(difference, coverage) + _mean_over(difference, 1 - coverage)


def s3im(color: Float[Tensor, "R 3"], truth: Float[Tensor, "R 3"], generator: torch.Generator) -> Float[Tensor, ""]:
    """Structure beyond single pixels (S3IM, Xie et al. 2023): 1 - SSIM of a virtual picture made of unrelated rays.

    The rays, in order and then in nine random orders, fill the rows of a picture as high as the square root of their
    number (576 rays make 24 x 240). SSIM is taken in 4 x 4 Gaussian windows, 4 apart, with a border of one zero pixel.
    Fewer rays than fill a window have no structure; their loss is zero.

    Args:
        color: rendered, 0..1.
        truth: of the picture, 0..1.
        generator: draws the orders.
    """
    rays = len(color)
    height = math.isqrt(rays)
    if height + 2 < S3IM_WINDOW:
        return color.sum() * 0
    device = generator.device
    orders = [torch.randperm(rays, generator=generator, device=device) for _ in range(S3IM_REPEATS - 1)]
    order = torch.cat([torch.arange(rays, device=device), *orders]).to(color.device)
    # Where the rows do not come out even, the last few rays of the last order are left out.
    width = len(order) // height
    order = order[: height * width]
    first, second = (c[order].T.reshape(3, 1, height, width) for c in (color, truth))
    return 1 - _windowed_ssim(first, second).mean()


def _mean_over(values: Tensor, shares: Tensor) -> Tensor:
    """Weighted mean, zero where nothing has weight."""
    whole = shares.sum()
    return (values * shares).sum() / torch.where(whole > 0, whole, torch.ones_like(whole))


def _windowed_ssim(first: Tensor, second: Tensor) -> Tensor:
    """Structural similarity of pictures [n 1 h w] in each window; colours in 0..1."""
    offsets = torch.arange(S3IM_WINDOW, dtype=first.dtype, device=first.device) - (S3IM_WINDOW - 1) / 2
    bell = torch.exp(-offsets.square() / (2 * S3IM_SIGMA**2))
    window = (bell[:, None] * bell / bell.sum() ** 2)[None, None]

    def mean(picture: Tensor) -> Tensor:
        return F.conv2d(picture, window, stride=S3IM_WINDOW, padding=1)

    mean1, mean2 = mean(first), mean(second)
    variance1, variance2 = mean(first.square()) - mean1.square(), mean(second.square()) - mean2.square()
    covariance = mean(first * second) - mean1 * mean2
    c1, c2 = 0.01**2, 0.03**2
    light = (2 * mean1 * mean2 + c1) / (mean1.square() + mean2.square() + c1)
    return light * (2 * covariance + c2) / (variance1 + variance2 + c2)
