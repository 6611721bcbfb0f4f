"""Which samples can be seen: found without gradients before the networks are queried for shading."""

from collections.abc import Callable

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from twofold.sampling import visibility_kernels as kernels
from twofold.volume.rendering import composite_weights, optical_depth
from twofold.volume.samples import Samples


def possible_samples(
    samples: Samples, fewest: Float[Tensor, "S"], most: Float[Tensor, "S"], least: float
) -> Bool[Tensor, "S"]:
    r"""Which samples can have a weight above `least` when their densities lie between two bounds.

    A weight is largest where the sample itself is as dense, and all before it as thin, as they can be:

    \[ w_i \le e^{-\sum_{j<i} \sigma^{\min}_j \delta_j} \, (1 - e^{-\sigma^{\max}_i \delta_i}) \]

    >>> samples = Samples(torch.tensor([0, 0, 0]), torch.tensor([1.0, 2.0, 3.0]), torch.ones(3))
    >>> possible_samples(samples, torch.tensor([0.0, 9.0, 9.0]), torch.tensor([0.0, 10.0, 10.0]), 0.01)
    tensor([False,  True, False])

    Args:
        samples: packed.
        fewest: lower bound of each density, per metre.
        most: upper bound.
        least: smallest weight that counts.
    """
    reaches = torch.exp(-optical_depth(fewest * samples.delta, samples))
    return reaches * -torch.expm1(-most * samples.delta) > least


@torch.no_grad()
def seen_samples(
    samples: Samples, density: Callable[[Int[Tensor, "n"]], Float[Tensor, "n"]], rays: int, least: float, first: int = 8
) -> Bool[Tensor, "S"]:
    r"""Which samples add more than `least` to their pixel, $w_i > w_{\min}$, found from front to back.

    Rays are followed a few samples at a time, and no further once less than `least` of their light comes through: what
    lies behind a surface is never asked for.

    >>> samples = Samples(torch.zeros(4, dtype=torch.long), torch.arange(4.0), torch.ones(4))
    >>> density = torch.tensor([0.0, 1.0, 20.0, 20.0])
    >>> seen_samples(samples, lambda index: density[index], rays=1, least=0.01, first=2)
    tensor([False,  True,  True, False])

    Args:
        samples: packed.
        density: of the samples with these indices, per metre.
        rays: how many there are.
        least: smallest weight (`composite_weights`) that counts.
        first: samples a ray is followed by at first; each further stretch is half as long again.
    """
    if not samples.depth.is_cuda and samples.depth.dtype == torch.float32:
        return _seen_compiled(samples, density, rays, least, first)
    count = len(samples)
    device = samples.depth.device
    order = torch.arange(count, device=device)
    begins = torch.zeros(count, dtype=torch.long, device=device)
    new = torch.ones(count, dtype=torch.bool, device=device)
    new[1:] = samples.ray_index[1:] != samples.ray_index[:-1]
    begins = torch.cummax(torch.where(new, order, begins), 0).values
    rank = order - begins
    seen = torch.zeros(count, dtype=torch.bool, device=device)
    through = torch.ones(rays, dtype=samples.depth.dtype, device=device)
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


def _seen_compiled(
    samples: Samples, density: Callable[[Tensor], Tensor], rays: int, least: float, length: int
) -> Tensor:
    """`seen_samples` with compiled bookkeeping; the densities are still asked for stretch by stretch."""
    ray_index, delta = samples.ray_index.contiguous().numpy(), samples.delta.contiguous().numpy()
    first = np.searchsorted(ray_index, np.arange(rays + 1))
    through, seen = np.ones(rays, np.float32), np.zeros(len(ray_index), dtype=bool)
    index, start, last = np.empty(len(ray_index), np.int64), 0, int(np.diff(first).max(initial=0))
    limit = np.float32(least)
    while start < last:
        # Rays are in the order of their samples, so a stretch is too.
        count = kernels.next_stretch(first, through, start, length, limit, index)
        found = density(torch.from_numpy(index[:count])).float().contiguous().numpy()
        kernels.follow(index[:count], ray_index, delta, found, through, limit, seen)
        start, length = start + length, length + length // 2
    return torch.from_numpy(seen)
