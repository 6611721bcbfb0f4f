"""A second set of depths where a first one found something (NPC, DANBO, PM-Avatar)."""

import torch
from jaxtyping import Float
from torch import Tensor

from twofold.sampling.error_bounded import invert

WEIGHT_FLOOR = 0.01
"""Added to every weight, so that some depths go where nothing was found."""


def blurred_weights(weights: Float[Tensor, "R n"]) -> Float[Tensor, "R m"]:
    r"""(max(w_{i-1}, w_i) + max(w_i, w_{i+1})) / 2 + 0.01 for all samples but the first and last (m = n - 2).

    \[ w'_i = \tfrac12 \big( \max(w_{i-1}, w_i) + \max(w_i, w_{i+1}) \big) + 0.01 \]

    A sample beside a surface gets a share of its neighbour's weight, so that a surface between two samples is found.

    >>> blurred_weights(torch.tensor([[0.0, 0.0, 1.0, 0.0]]))
    tensor([[0.5100, 1.0100]])
    """
    pairs = torch.maximum(weights[:, 1:], weights[:, :-1])
    return (pairs[:, 1:] + pairs[:, :-1]) / 2 + WEIGHT_FLOOR


@torch.no_grad()
def importance_depths(
    depths: Float[Tensor, "R n"],
    weights: Float[Tensor, "R n"],
    count: int,
    generator: torch.Generator | None = None,
) -> Float[Tensor, "R count"]:
    r"""Depths drawn from a distribution that is constant between the middles of neighbouring depths; no gradient.

    \[ t = F^{-1}(q), \qquad F' \propto w'_i
    \text{ between } \tfrac12 (t_{i-1} + t_i) \text{ and } \tfrac12 (t_i + t_{i+1}) \]

    >>> depths = torch.tensor([[0.0, 1.0, 2.0, 3.0]])
    >>> importance_depths(depths, torch.tensor([[0.0, 1.0, 0.0, 0.0]]), 3).round(decimals=2)
    tensor([[0.5000, 1.2500, 2.5000]])

    Args:
        depths: ascending, at least 3 a ray, metres.
        weights: of the samples at these depths in their pixel.
        count: depths to draw for each ray.
        generator: draws the quantiles; None spaces them evenly from 0 to 1, as the authors' programs do.
    """
    middles = (depths[:, 1:] + depths[:, :-1]) / 2
    if generator is None:
        quantiles = torch.linspace(0, 1, count, dtype=depths.dtype, device=depths.device)
        quantiles = quantiles.expand(len(depths), count).contiguous()
    else:
        quantiles = torch.rand((len(depths), count), generator=generator, dtype=depths.dtype, device=generator.device)
        quantiles = quantiles.to(depths.device)
    return invert(middles, blurred_weights(weights), quantiles)
