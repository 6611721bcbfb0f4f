"""Packed samples with random depths and densities."""

import torch

from twofold.volume.samples import Samples


def packed(counts, seed=0, dtype=torch.float64):
    """Samples of len(counts) rays, that many on each, and a density for each sample."""
    generator = torch.Generator().manual_seed(seed)
    index = torch.repeat_interleave(torch.arange(len(counts)), torch.tensor(counts))
    total = len(index)
    delta = 0.2 * torch.rand(total, generator=generator, dtype=dtype)
    return Samples(index, delta.cumsum(0), delta), 8 * torch.rand(total, generator=generator, dtype=dtype)
