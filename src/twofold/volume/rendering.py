"""From signed distances to pixels: density, packed samples, compositing."""

from collections.abc import Callable

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from twofold.volume.samples import Samples


def laplace_density(sdf: Float[Tensor, "*b"], beta: Float[Tensor, ""]) -> Float[Tensor, "*b"]:
    """Volume density of a signed distance (Eq. 7): the Laplace distribution's CDF of -sdf, over its scale.

    Args:
        sdf: metres, negative inside.
        beta: scale of the distribution, metres, positive.

    Returns:
        density per metre, between 0 far outside and 1 / beta deep inside.
    """
    tail = 0.5 * torch.exp(-sdf.abs() / beta)
    return torch.where(sdf > 0, tail, 1 - tail) / beta


def composite_weights(density: Float[Tensor, "S"], samples: Samples) -> Float[Tensor, "S"]:
    """What each sample adds to its ray, T_i (1 - exp(-sigma_i delta_i)); a ray's weights sum to at most one."""
    optical = density * samples.delta
    return torch.exp(-_optical_depth(optical, samples)) * -torch.expm1(-optical)


def possible_samples(
    samples: Samples, fewest: Float[Tensor, "S"], most: Float[Tensor, "S"], least: float
) -> Bool[Tensor, "S"]:
    """Which samples can have a weight above `least` when their densities (per metre) lie between two bounds.

    A weight is largest where the sample itself is as dense, and all before it as thin, as they can be.
    """
    reaches = torch.exp(-_optical_depth(fewest * samples.delta, samples))
    return reaches * -torch.expm1(-most * samples.delta) > least


def _optical_depth(optical: Float[Tensor, "S"], samples: Samples) -> Float[Tensor, "S"]:
    """Sum of sigma_j delta_j over the samples j before each one on its ray."""
    # One running sum over all rays would lose digits in float32; what a ray starts with is taken off again.
    total = torch.cumsum(optical.double(), 0)
    before = total - optical
    first = torch.ones_like(samples.ray_index, dtype=torch.bool)
    first[1:] = samples.ray_index[1:] != samples.ray_index[:-1]
    start = torch.cummax(torch.where(first, torch.arange(len(samples), device=first.device), 0), 0).values
    return (before - before[start]).to(optical.dtype)


@torch.no_grad()
def seen_samples(
    samples: Samples, density: Callable[[Int[Tensor, "n"]], Float[Tensor, "n"]], rays: int, least: float, first: int = 8
) -> Bool[Tensor, "S"]:
    """Which samples add more than `least` to their pixel, found from front to back.

    Rays are followed a few samples at a time, and no further once less than `least` of their light comes through: what
    lies behind a surface is never asked for.

    Args:
        samples: packed.
        density: of the samples with these indices, per metre.
        rays: how many there are.
        least: smallest weight (`composite_weights`) that counts.
        first: samples a ray is followed by at first; each further stretch is half as long again.
    """
    count = len(samples)
    device = samples.depth.device
    order = torch.arange(count, device=device)
    begins = torch.zeros(count, dtype=torch.long, device=device)
    new = torch.ones(count, dtype=torch.bool, device=device)
    new[1:] = samples.ray_index[1:] != samples.ray_index[:-1]
    begins = torch.cummax(torch.where(new, order, begins), 0).values
    rank = order - begins
    seen = torch.zeros(count, dtype=torch.bool, device=device)
    through = torch.ones(rays, device=device)
    start, length, last = 0, first, int(rank.max()) if count else -1
    while start <= last:
        stretch = (rank >= start) & (rank < start + length) & (through > least)[samples.ray_index]
        index = stretch.nonzero()[:, 0]
        if len(index):
            part = samples[index]
            found = density(index)
            weights = composite_weights(found, part) * through[part.ray_index]
            seen[index] = weights > least
            optical = torch.zeros_like(through).index_add_(0, part.ray_index, found * part.delta)
            through = through * torch.exp(-optical)
        start, length = start + length, length + length // 2
    return seen


def composite(
    weights: Float[Tensor, "S"], values: Float[Tensor, "S C"], samples: Samples, rays: int
) -> Float[Tensor, "rays C"]:
    """Sum of weighted values along each ray (Eq. 8); a ray without samples gets zero."""
    out = torch.zeros(rays, values.shape[-1], dtype=values.dtype, device=values.device)
    return out.index_add(0, samples.ray_index, weights[:, None] * values)
