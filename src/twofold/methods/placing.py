"""Where methods with a body put the samples of a ray: in a shell around it, or by the error-bounded sampler."""

from collections.abc import Callable
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from twofold.config import require_within
from twofold.deform.skinning import to_canonical
from twofold.geometry.cameras import Rays, clip_to_box
from twofold.kernels.kdtree import query_nearest, search_tree
from twofold.methods.base import PosedAvatar
from twofold.sampling.error_bounded import ErrorBoundedSampler
from twofold.sampling.sdf_grid import DistanceTable
from twofold.sampling.shell import Shell, nearest_listed, sample_shell
from twofold.volume.rendering import laplace_density, possible_samples, seen_samples
from twofold.volume.samples import Samples

Distance = Callable[[Float[Tensor, "n 3"]], Float[Tensor, "n"]]
"""A field's signed distance at canonical points, metres."""
Shares = Callable[[Float[Tensor, "S K"]], Float[Tensor, "S K"]]
"""The weights of the K nearest vertices by their squared distances, metres squared."""


@dataclass(frozen=True)
class ShellSampler:
    """Samples near the posed body only, and of these only the ones that can be seen."""

    radius: float = 0.06
    """How far from the body's vertices samples are taken, metres."""
    step: float = 0.01
    """Distance of samples on a ray, metres."""
    voxel: float = 0.02
    """Edge of the voxels that list where the shell is, metres."""
    least_weight: float = 1e-3
    """Samples that a pass without gradients finds to add less than this to their pixel are left out; 0 keeps all."""
    stray: float = 0.0
    """Samples that come closer to the body by more than this when they are carried home, metres, are air; 0 keeps
    them. Not for a field that starts as a sphere."""
    table_voxel: float = 0.015
    """Pictures from dense networks: spacing of a lattice of distances, asked once a pose, that tells most samples to be
    empty or hidden before the networks are asked; metres, 0 asks the networks about every sample."""

    def __post_init__(self) -> None:
        """Refuses sizes that leave nothing to sample."""
        # The voxels of a body fill half a gigabyte at the least edge; a ray crosses it in a thousand steps.
        require_within(
            self, radius=(0.005, 0.5), step=(0.001, 0.5), voxel=(0.005, 0.5), least_weight=(0, 1), stray=(0, 0.5),
            table_voxel=(0, 0.5),
        )  # fmt: skip
        if 0 < self.table_voxel < 0.004:
            raise ValueError(f"table_voxel={self.table_voxel:g} should be 0.004 to 0.5, or 0 for no table")


@dataclass(frozen=True)
class Placed:
    """Samples of some rays and what carries them home.

    Attributes:
        samples: packed.
        nearest: the K nearest body vertices of each.
        shares: the weight of each of these.
        outlier: too far from the body to count.
    """

    samples: Samples
    nearest: Int[Tensor, "S K"]
    shares: Float[Tensor, "S K"]
    outlier: Bool[Tensor, "S"]

    def __getitem__(self, index: Tensor) -> "Placed":
        return Placed(self.samples[index], self.nearest[index], self.shares[index], self.outlier[index])


def place_in_shell(
    sampler: ShellSampler, rays: Rays, posed: PosedAvatar, neighbours: int, shares: Shares, limit: float,
    generator: torch.Generator | None,
) -> Placed:  # fmt: skip
    """Every sample of the rays within `limit` metres of the body; a generator moves each ray's comb at random."""
    samples, nearest, squared = sample_shell(posed.shell, rays, sampler.step, generator, limit)
    if neighbours > 1:
        points = samples.points(rays).detach()
        nearest, squared = nearest_listed(posed.shell, points, posed.shell.rows_at(points), neighbours)
    outlier = torch.zeros(len(samples), dtype=torch.bool, device=squared.device)
    return Placed(samples, nearest, shares(squared), outlier)


def that_count(
    sampler: ShellSampler, placed: Placed, rays: Rays, posed: PosedAvatar, home: Shell | None, distance: Distance,
    beta: Float[Tensor, ""], table: Callable[[int], DistanceTable | None] | None,
) -> Placed:  # fmt: skip
    """The samples that the networks are worth asking about: no strays, none that is known to be empty or hidden.

    Args:
        sampler: says which of these checks are made.
        placed: all samples.
        rays: that they lie on.
        posed: carries them home.
        home: of the canonical body, for the strays; None leaves them.
        distance: of the field.
        beta: scale of the density, metres.
        table: gives a table of distances where that pays for so many samples; None never.
    """
    if len(placed.samples) == 0 or (home is None and sampler.least_weight == 0):
        return placed
    x_canonical = carried_home(placed, rays, posed)
    if home is not None:
        kept = (~astray(placed, x_canonical, rays, posed, home, sampler.stray)).nonzero()[:, 0]
        placed, x_canonical = placed[kept], x_canonical[kept]
    if sampler.least_weight > 0:
        known = table(len(x_canonical)) if table else None
        seen = seen_in_shell(placed, x_canonical, len(rays), distance, beta, sampler.least_weight, known)
        placed = placed[seen]
    return placed


@torch.no_grad()
def carried_home(placed: Placed, rays: Rays, posed: PosedAvatar) -> Float[Tensor, "S 3"]:
    """Where the samples are in canonical space, to choose among them; without gradients."""
    return to_canonical(placed.samples.points(rays), placed.nearest, placed.shares, posed.forward)[0]


@torch.no_grad()
def astray(
    placed: Placed, x_canonical: Float[Tensor, "S 3"], rays: Rays, posed: PosedAvatar, canonical: Shell, slack: float
) -> Bool[Tensor, "S"]:
    """Samples that inverse skinning carries to a part of the body that they are not at.

    Air beside the neck belongs to the shoulder below it. Carried home by a lowered arm it ends up inside the head. So a
    sample that comes closer to the canonical body than it was to the posed one, by more than `slack` metres, is air.
    """
    away = (placed.samples.points(rays) - posed.body.vertices[placed.nearest[:, 0]]).norm(dim=-1)
    rows = canonical.rows_at(x_canonical)
    near = ((away > slack) & (rows >= 0)).nonzero()[:, 0]
    _, squared = nearest_listed(canonical, x_canonical[near], rows[near], 1)
    stray = torch.zeros(len(away), dtype=torch.bool, device=away.device)
    stray[near] = squared[:, 0].sqrt() < away[near] - slack
    return stray


@torch.no_grad()
def seen_in_shell(
    placed: Placed, x_canonical: Float[Tensor, "S 3"], rays: int, distance: Distance, beta: Float[Tensor, ""],
    least: float, table: DistanceTable | None = None,
) -> Int[Tensor, "n"]:  # fmt: skip
    """Which of the samples add more than `least` to their pixel.

    Args:
        placed: all samples.
        x_canonical: the same, carried home.
        rays: how many these lie on.
        distance: of the field.
        beta: scale of the density, metres.
        least: a weight (`composite_weights`).
        table: of the same field in the same pose; what it knows to be empty or hidden is not asked.
    """
    asked = torch.arange(len(x_canonical), device=x_canonical.device)
    if table is not None:
        nearer, further = table.bounds(x_canonical)
        most, fewest = laplace_density(nearer, beta), laplace_density(further, beta)
        asked = possible_samples(placed.samples, fewest, most, least).nonzero()[:, 0]

    def density(index: Tensor) -> Tensor:
        return laplace_density(distance(x_canonical[asked[index]]), beta)

    return asked[seen_samples(placed.samples[asked], density, rays, least)]


RELEASED_MARGIN = 0.3
"""How far the box of the joints reaches beyond them in the release, metres."""
RELEASED_SLACK = 0.01
"""What it is enlarged by after that, scene units."""


def joint_box(joints: Float[Tensor, "J 3"], scale: float = 1.0) -> Float[Tensor, "2 3"]:
    """Lower and upper corner of the axis-aligned box around joints, without gradients.

    Args:
        joints: metres.
        scale: scene units to a metre.
    """
    margin = RELEASED_MARGIN + RELEASED_SLACK / scale
    return torch.stack([joints.detach().amin(0) - margin, joints.detach().amax(0) + margin])


def place_error_bounded(
    sampler: ErrorBoundedSampler, rays: Rays, posed: PosedAvatar, shares: Shares, limit: float,
    generator: torch.Generator | None, distance: Distance, beta: Float[Tensor, ""], scale: float = 1.0,
) -> Placed:  # fmt: skip
    """Samples in the box of the joints by the error-bounded sampler.

    Args:
        sampler: its constants.
        rays: to place samples on.
        posed: the body, the box, and how many nearest vertices carry a sample home.
        shares: weighs these.
        limit: samples further than this from the body are outliers, metres.
        generator: places them at random (training); None evenly.
        distance: of the field.
        beta: scale of the density, metres.
        scale: of the sampler's units, which it sees origins and depths in, to a metre; distances stay in metres.
    """
    clipped, hit = clip_to_box(rays, *posed.box)
    inside = hit.nonzero()[:, 0]
    seen = clipped[inside]
    seen = Rays(seen.origins * scale, seen.directions, seen.near * scale, seen.far * scale)
    tree = search_tree(posed.body.vertices.detach().cpu().numpy())

    def nearest_to(points: Tensor) -> tuple[Tensor, Tensor]:
        away, index = query_nearest(tree, points.detach().cpu().numpy(), posed.neighbours)
        return torch.from_numpy(index).to(points.device), torch.from_numpy(away).float().to(points.device)

    def sdf(points: Tensor) -> Tensor:
        points = points / scale
        index, apart = nearest_to(points)
        x_canonical, _ = to_canonical(points, index, shares(apart**2), posed.forward.detach())
        value = distance(x_canonical)
        # The release treats outliers as empty only when it does not train.
        return value if generator is not None else torch.where(apart[:, 0] > limit, 4.0, value)

    with torch.no_grad():
        samples = sampler.sample(seen, sdf, beta, generator, generator is not None)
    samples = Samples(inside[samples.ray_index], samples.depth / scale, samples.delta / scale)
    index, apart = nearest_to(samples.points(rays))
    return Placed(samples, index, shares(apart**2), apart[:, 0] > limit)
