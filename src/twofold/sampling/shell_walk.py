"""Samples in a shell with their way to canonical space, found in one compiled walk on CPUs."""

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from twofold.geometry.cameras import Rays
from twofold.kernels.lanes import LANES
from twofold.kernels.parallel import in_parts
from twofold.sampling import walk_kernels
from twofold.sampling.placement import Deformation, Placement
from twofold.sampling.shell import Shell, ray_starts
from twofold.volume.samples import Samples


def can_walk(shell: Shell, rays: Rays) -> bool:
    """Whether `walk_to_canonical` can be used: single precision on a CPU, lists that fit into a vector."""
    own = (rays.origins, rays.directions, shell.vertices)
    return shell.nearest.shape[1] <= LANES and all(t.dtype == torch.float32 and not t.is_cuda for t in own)


@torch.no_grad()
def walk_to_canonical(
    shell: Shell, rays: Rays, step: float, generator: torch.Generator | None, limit: float, k: int,
    deformation: Deformation, forward: Float[Tensor, "V 3 4"], canonical: Shell, slack: float,
) -> Placement:  # fmt: skip
    """What `sample_shell`, `placement` and `miswarped` find one after the other.

    Args:
        shell: where to sample.
        rays: their near and far bounds are respected.
        step: metres.
        generator: shifts each ray's evenly spaced samples; None puts samples at mid-step.
        limit: largest distance to the nearest vertex, metres.
        k: how many nearest vertices count.
        deformation: by what weights they do.
        forward: canonical-to-posed transforms of the vertices.
        canonical: the shell of the canonical body, which mis-warped samples come too close to.
        slack: by more than this, metres; 0 keeps all.
    """
    clipped, ray_ids, start = ray_starts(shell, rays, generator)
    k = min(k, shell.nearest.shape[1])
    lines = (clipped.origins, clipped.directions, clipped.near, clipped.far, start)
    rows = torch.nn.functional.pad(forward.detach().flatten(1), (0, LANES - 12))
    given = (
        _arrays(shell), (*(t.contiguous().numpy() for t in lines), np.float32(step)), _arrays(canonical),
        np.float32(limit), np.float32(slack), deformation.falloff == "smooth",
        np.float32(deformation.scale if deformation.falloff == "scene" else 1), rows.numpy(), k,
    )  # fmt: skip
    parts = in_parts(len(ray_ids), lambda begin, end: walk_kernels.walk_to_canonical(*given, begin, end), least=64)
    whole = parts[0] if len(parts) == 1 else [np.concatenate(part) for part in zip(*parts, strict=True)]
    ray, depth, nearest, weights, point, inverse = (torch.from_numpy(array) for array in whole)
    samples = Samples(ray_ids[ray], depth, torch.full_like(depth, step))
    outlier = torch.zeros(len(depth), dtype=torch.bool)
    return Placement(samples, nearest, weights, outlier, point, inverse.unflatten(1, (3, 4)))


def _arrays(shell: Shell) -> tuple[np.ndarray, float, np.ndarray, np.ndarray, np.ndarray]:
    low, row, nearest, vertices = (t.numpy() for t in (shell.low, shell.row, shell.nearest, shell.vertices))
    return low, shell.voxel, row, nearest, vertices
