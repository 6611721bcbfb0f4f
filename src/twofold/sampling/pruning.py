"""Which placed samples are worth shading: neither mis-warped nor known to be empty or hidden."""

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from twofold.geometry.cameras import Rays
from twofold.kernels.parallel import in_parts
from twofold.sampling import shell_kernels
from twofold.sampling.placement import FieldQuery, Placement
from twofold.sampling.posed_surface import PosedSurface
from twofold.sampling.sdf_grid import SdfGrid
from twofold.sampling.shell import Shell, nearest_listed, shell_arrays
from twofold.sampling.visibility import possible_samples, seen_samples
from twofold.volume.rendering import laplace_density
from twofold.volume.samples import Samples


@torch.no_grad()
def miswarped(
    placed: Placement, rays: Rays, surface: PosedSurface, canonical: Shell, slack: float
) -> Bool[Tensor, "S"]:
    """Samples that inverse skinning maps to a part of the body that they are not at.

    The empty space beside the neck belongs to the shoulder below it. Mapped by a lowered arm it ends up inside the
    head. So a sample that comes closer to the canonical body than it was to the posed one, by more than `slack` metres,
    is mis-warped.
    """
    points = placed.samples.points(rays)
    if not points.is_cuda and points.dtype == torch.float32:
        wrong = torch.empty(len(points), dtype=torch.bool)
        given = (points, placed.x_canonical, placed.nearest[:, 0], surface.body.vertices.detach())
        own = (tensor.contiguous().numpy() for tensor in given)
        arrays = (*own, shell_arrays(canonical), np.float32(slack), wrong.numpy())
        in_parts(len(points), lambda begin, end: shell_kernels.miswarped(*arrays, begin, end))
        return wrong
    away = (points - surface.body.vertices[placed.nearest[:, 0]]).norm(dim=-1)
    rows = canonical.rows_at(placed.x_canonical)
    near = ((away > slack) & (rows >= 0)).nonzero()[:, 0]
    _, squared = nearest_listed(canonical, placed.x_canonical[near], rows[near], 1)
    wrong = torch.zeros(len(away), dtype=torch.bool, device=away.device)
    wrong[near] = squared[:, 0].sqrt() < away[near] - slack
    return wrong


@torch.no_grad()
def visible(
    samples: Samples, x_canonical: Float[Tensor, "S 3"], rays: int, query: FieldQuery, min_weight: float,
    grid: SdfGrid | None = None,
) -> Int[Tensor, "n"]:  # fmt: skip
    """Which of the samples add more than `min_weight` to their pixel.

    Args:
        samples: all of them.
        x_canonical: where these are in canonical space, metres.
        rays: how many these lie on.
        query: of the field.
        min_weight: a weight (`composite_weights`).
        grid: of the same field in the same pose; what it shows to be empty or hidden is not queried, and nothing at all
            where queries are costly.
    """
    beta = query.beta
    queried = torch.arange(len(x_canonical), device=x_canonical.device)
    if grid is not None:
        nearer, further = grid.bounds(x_canonical)
        largest, smallest = laplace_density(nearer, beta), laplace_density(further, beta)
        queried = possible_samples(samples, smallest, largest, min_weight).nonzero()[:, 0]
        if query.costly:
            return queried

    def density(index: Tensor) -> Tensor:
        return laplace_density(query.distance(x_canonical[index if grid is None else queried[index]]), beta)

    return queried[seen_samples(samples if grid is None else samples[queried], density, rays, min_weight)]
