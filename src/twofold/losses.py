"""What training makes small. Each term is a mean over rays, points or pixels unless it says otherwise."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn import functional as F

from twofold.config import require_within
from twofold.kernels.virtual_image import can_pick, picked_ssim

S3IM_REPEATS = 10
"""Orders in which the rays are laid out in the virtual image: as given, then permuted at random."""
S3IM_WINDOW = 4
"""Pixels across the window of `s3im`, and between two windows."""
S3IM_SIGMA = 1.5
"""Standard deviation of that window, pixels."""
S3IM_CENTER = (S3IM_WINDOW - 1) / 2
"""Middle of that window, pixels from its first one; the release has 2."""
_STABLE = (0.01**2, 0.03**2)
"""Added to products of means, and of deviations, of colours in 0..1 (Wang et al. 2004)."""
ENTROPY_OFFSET = 1e-6
"""Added inside the logarithms of `binarisation`."""
SPARSE_CLEARANCE, SPARSE_EPOCHS = 0.05, 200
"""How far a ray without opacity stays from the surface, metres; and the epoch from which its weight is constant."""
CONSISTENT_LIKELIHOOD, CONSISTENT_DISTANCE = 0.3, 0.05
"""Samples that `deformation_consistency` counts: sum of bone weights, and distance in metres."""
MAX_POINT_OFFSET = 0.04
"""Offsets up to this length cost nothing in `point_offsets`, metres."""
MAX_STEPS = 10**12
"""More than any training takes; a step of it means never."""


@dataclass(frozen=True)
class LossConfig:
    """Weights of the loss terms; a weight of zero leaves the term out."""

    reconstruction: float = 1.0
    eikonal: float = 0.1
    common: float = 0.5
    lpips: float = 1.0
    lpips_start: int = 20_000
    """First step with the perceptual term; 20,001 in the release."""
    lpips_dropout: float = 0.0
    """Chance of each squared difference of features to be left out; 0.5 in the release."""
    lpips_off_box: Literal["black", "picture"] = "black"
    """What patches show where no ray meets the body's box: black on both sides, or, as released, the background where
    the avatar is rendered and the image where it is not."""
    mask: float = 0.1
    mask_form: Literal["sides", "mean", "hard"] = "sides"
    """"sides": inside and outside rays averaged apart, a pixel on the edge by its parts; "mean": plain mean; "hard": as
    released, with hard labels and averages of their own for patches."""
    base_mask: float = 0.0
    """Mask term of the base rendering (ours): without it the base has holes where clothes are as dark as the
    background, since the common loss compares colours only."""
    s3im: float = 0.1
    s3im_center: float = S3IM_CENTER
    """Middle of the Gaussian window, pixels from its first one of four; 2 in the release."""
    eikonal_points: int = 512
    """Random canonical body vertices, each moved by a normal deviate."""
    eikonal_spread: float = 0.01
    """Standard deviation of that, metres."""
    eikonal_replacement: bool = True
    """Whether the same vertex may be drawn twice; the release draws without replacement."""
    reduction: Literal["mean", "sum"] = "mean"
    """Whether colour differences are averaged over rays and channels, as released, or summed, as printed."""

    def __post_init__(self) -> None:
        """Refuses weights that reward what they should punish."""
        weights = (self.eikonal, self.common, self.lpips, self.mask, self.base_mask, self.s3im)
        right = min(weights) >= 0 < self.reconstruction
        if not right:
            raise ValueError("weights should not be negative, reconstruction positive")
        require_within(
            self, reconstruction=(0, 1e6), eikonal=(0, 1e6), common=(0, 1e6), lpips=(0, 1e6), mask=(0, 1e6),
            base_mask=(0, 1e6), s3im=(0, 1e6), lpips_start=(0, MAX_STEPS), eikonal_points=(1, 1_000_000),
            eikonal_spread=(0, 1), s3im_center=(0, S3IM_WINDOW - 1), lpips_dropout=(0, 0.99),
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
        truth: of the image, 0..1.
        reduction: mean over rays and channels, as released, or sum, as printed.
    """
    difference = (color - truth).abs()
    return difference.mean() if reduction == "mean" else difference.sum()


def common(
    base_color: Float[Tensor, "R 3"], truth: Float[Tensor, "R 3"], reduction: Literal["mean", "sum"] = "mean"
) -> Float[Tensor, ""]:
    """The same for the image that the base branch renders alone (Eq. 11); it keeps that branch from idling.

    Args:
        base_color: rendered from s1 and c1, 0..1.
        truth: of the image, 0..1.
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


def hard_mask(opacity: Float[Tensor, "R"], coverage: Float[Tensor, "R"], singles: int) -> Float[Tensor, ""]:
    r"""Mask term with hard labels, averaged apart for single pixels and for the pixels of patches, as released.

    A single pixel is inside where the person covers all of it, a pixel of a patch where the person covers any of it.
    With $I$ and $O$ the inside and outside rays of a group and $A$ the opacity, a group's term is

    \[ \frac{1}{|I|} \sum_{r \in I} |A_r - 1| + \frac{1}{|O|} \sum_{r \in O} |A_r| \]

    and the mean over the two groups is returned; an empty side counts zero, an empty group not at all.

    >>> opacity, coverage = torch.tensor([0.5, 0.5, 0.5, 0.25]), torch.tensor([1.0, 0.5, 0.5, 0.0])
    >>> hard_mask(opacity, coverage, 2)  # the groups have 0.5 + 0.5 and 0.5 + 0.25
    tensor(0.8750)

    Args:
        opacity: rendered, 0..1.
        coverage: share of the pixel that the person covers.
        singles: how many of the rays are single pixels; they come first.
    """
    groups: list[Tensor] = []
    for rays, inside in ((opacity[:singles], coverage[:singles] >= 1), (opacity[singles:], coverage[singles:] > 0)):
        label = inside.to(opacity.dtype)
        if len(rays):
            groups.append(_mean_over((rays - 1).abs(), label) + _mean_over(rays.abs(), 1 - label))
    return torch.stack(groups).mean()


def s3im(
    color: Float[Tensor, "R 3"],
    truth: Float[Tensor, "R 3"],
    generator: torch.Generator,
    center: float = S3IM_CENTER,
) -> Float[Tensor, ""]:
    """Structure beyond single pixels (S3IM, Xie et al. 2023): 1 - SSIM of a virtual image made of unrelated rays.

    The rays, in order and then in nine random orders, fill the rows of an image as high as the square root of their
    number (576 rays make 24 x 240). SSIM is taken in 4 x 4 Gaussian windows, 4 apart, with a border of one zero pixel.
    Fewer rays than fill a window have no structure; their loss is zero.

    Args:
        color: rendered, 0..1.
        truth: of the image, 0..1.
        generator: draws the orders.
        center: middle of the Gaussian window, pixels from its first one of 0..3; the release has 2, off its centre.
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
    window = _window(center, color)
    if can_pick(color, truth):
        return 1 - picked_ssim(color, truth, order.view(height, width), window, _STABLE)
    first, second = (c[order].T.reshape(3, 1, height, width) for c in (color, truth))
    return 1 - _windowed_ssim(first, second, window).mean()


def squared_error(color: Float[Tensor, "*b"], truth: Float[Tensor, "*b"]) -> Float[Tensor, ""]:
    """Mean squared difference of colours (HumanNeRF, MonoHuman)."""
    return (color - truth).square().mean()


def binarisation(opacity: Float[Tensor, "R"]) -> Float[Tensor, ""]:
    """Twice the mean entropy of the opacity, -a ln(a + e) - (1 - a) ln(1 - a + e) with e = 1e-6 (Vid2Avatar).

    It is zero where every pixel is either person or background.

    >>> binarisation(torch.tensor([0.5, 1.0])).round(decimals=4)
    tensor(0.6931)

    Args:
        opacity: rendered, 0..1.
    """
    rest = 1 - opacity
    return -2 * (opacity * (opacity + ENTROPY_OFFSET).log() + rest * (rest + ENTROPY_OFFSET).log()).mean()


def opacity_sparseness(opacity: Float[Tensor, "R"], clearance: Float[Tensor, "R"]) -> Float[Tensor, ""]:
    """Mean opacity of rays that stay more than 5 cm away from the canonical surface; zero without any (Vid2Avatar).

    >>> opacity_sparseness(torch.tensor([0.5, 1.0]), torch.tensor([0.1, 0.0]))
    tensor(0.5000)

    Args:
        opacity: rendered, 0..1.
        clearance: smallest signed distance of each ray's samples to the canonical mesh, metres.
    """
    return _mean_over(opacity.abs(), (clearance > SPARSE_CLEARANCE).to(opacity.dtype))


def in_shape(opacity: Float[Tensor, "R"], clearance: Float[Tensor, "R"]) -> Float[Tensor, ""]:
    """Mean of 1 - opacity of rays that enter the canonical surface; zero without any (Vid2Avatar).

    Args:
        opacity: rendered, 0..1.
        clearance: smallest signed distance of each ray's samples to the canonical mesh, metres.
    """
    return _mean_over((1 - opacity).abs(), (clearance <= 0).to(opacity.dtype))


def sparseness_weights(epoch: int) -> tuple[float, float]:
    """Weights of `opacity_sparseness` and `in_shape` at an epoch: 3e-3 (1 + e^2 / 40) and 1e-2 (1 - e / 200), e <= 200.

    >>> sparseness_weights(0), sparseness_weights(300)
    ((0.003, 0.01), (3.003, 0.0))
    """
    e = min(epoch, SPARSE_EPOCHS)
    return 3e-3 * (1 + e * e / 40), 1e-2 * (1 - e / SPARSE_EPOCHS)


def deformation_consistency(
    x_observed: Float[Tensor, "S 3"], x_returned: Float[Tensor, "S 3"], likelihood: Float[Tensor, "S"]
) -> Float[Tensor, ""]:
    """Mean distance between points and where they come back after both deformations (MonoHuman Eq. 7).

    Only samples count whose bone weights sum to more than 0.3 and that come back more than 5 cm away; zero without any.

    Args:
        x_observed: points of observation space, metres.
        x_returned: the same after the backward and the forward deformation, metres.
        likelihood: sum of the bone weights.
    """
    distance = (x_observed - x_returned).norm(dim=-1)
    counts = (likelihood > CONSISTENT_LIKELIHOOD) & (distance > CONSISTENT_DISTANCE)
    return _mean_over(distance, counts.to(distance.dtype))


def box_volumes(half_sizes: Float[Tensor, "J 3"]) -> Float[Tensor, ""]:
    """Sum over boxes of the product of their half-sizes, cubic metres; keeps boxes tight (DANBO, PM-Avatar).

    >>> box_volumes(torch.tensor([[1.0, 2.0, 3.0], [1.0, 1.0, 1.0]]))
    tensor(7.)
    """
    return half_sizes.prod(-1).sum()


def box_assignment(probability: Float[Tensor, "S J"], hit: Float[Tensor, "S"]) -> Float[Tensor, ""]:
    """Mean of (hit - sum_j p_j)^2: a sample on the person belongs to one box, others to none (DANBO).

    Args:
        probability: of each box, zero for boxes that do not hold the sample (`field.local_volumes.LocalVolumes`).
        hit: one for samples on the person, else zero.
    """
    return (hit - probability.sum(-1)).square().mean()


def point_offsets(offsets: Float[Tensor, "n 3"]) -> Float[Tensor, ""]:
    """Mean over all points of |offset|^2 where it is longer than 4 cm, else zero (NPC).

    Args:
        offsets: from skinned to posed points, before long ones are left out, metres.
    """
    squared = offsets.square().sum(-1)
    return torch.where(squared > MAX_POINT_OFFSET**2, squared, torch.zeros_like(squared)).mean()


def neighbour_distances(
    posed: Float[Tensor, "n 3"], rest: Float[Tensor, "n 3"], neighbours: Int[Tensor, "n k"]
) -> Float[Tensor, ""]:
    """Mean of (posed distance - rest distance)^2 between each point and its neighbours (NPC).

    Args:
        posed: points in a pose, metres.
        rest: the same in the rest pose, metres.
        neighbours: numbers of the neighbours of each point, the point itself not among them.
    """
    first, second = ((p[:, None] - p[neighbours]).norm(dim=-1) for p in (posed, rest))
    return (first - second).square().mean()


def surface_points(sdf: Float[Tensor, "n"]) -> Float[Tensor, ""]:
    """Mean of max(s, 0) at the points: points outside of the surface pull it outwards (NPC)."""
    return sdf.relu().mean()


def background(
    predicted: Float[Tensor, "R 3"], truth: Float[Tensor, "R 3"], opacity: Float[Tensor, "R"]
) -> Float[Tensor, ""]:
    """Mean of (1 - opacity) (predicted - truth)^2 for a learned background; no gradient by the opacity (NPC).

    Args:
        predicted: the background's colour, 0..1.
        truth: of the image, 0..1.
        opacity: rendered, 0..1.
    """
    return ((1 - opacity.detach())[:, None] * (predicted - truth).square()).mean()


def _mean_over(values: Tensor, weights: Tensor) -> Tensor:
    """Weighted mean, zero where nothing has weight."""
    whole = weights.sum()
    return (values * weights).sum() / torch.where(whole > 0, whole, torch.ones_like(whole))


def _window(center: float, like: Tensor) -> Tensor:
    """Weights of a window's pixels, which sum to 1; the bell's middle is `center` pixels from the first one."""
    offsets = torch.arange(S3IM_WINDOW, dtype=like.dtype, device=like.device) - center
    bell = torch.exp(-offsets.square() / (2 * S3IM_SIGMA**2))
    return bell[:, None] * bell / bell.sum() ** 2


def _windowed_ssim(first: Tensor, second: Tensor, window: Tensor) -> Tensor:
    """Structural similarity of images [n 1 h w] in each window; colours in 0..1."""

    def mean(image: Tensor) -> Tensor:
        return F.conv2d(image, window[None, None], stride=S3IM_WINDOW, padding=1)

    mean1, mean2 = mean(first), mean(second)
    variance1, variance2 = mean(first.square()) - mean1.square(), mean(second.square()) - mean2.square()
    covariance = mean(first * second) - mean1 * mean2
    c1, c2 = _STABLE
    light = (2 * mean1 * mean2 + c1) / (mean1.square() + mean2.square() + c1)
    return light * (2 * covariance + c2) / (variance1 + variance2 + c2)
