"""The shell sampler: samples near the posed body only, and of these only the ones that can be seen."""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float, Int
from torch import Tensor

from twofold.config import require_within
from twofold.geometry.cameras import Rays
from twofold.sampling.joint_box import joint_box
from twofold.sampling.placement import Deformation, FieldQuery, Placement, placement
from twofold.sampling.posed_surface import PosedSurface
from twofold.sampling.pruning import miswarped, visible
from twofold.sampling.sdf_grid import SdfGrid, tabulate
from twofold.sampling.shell import Shell, build_shell, expected_samples, nearest_listed, sample_shell
from twofold.sampling.shell_walk import Walk, can_walk, parts_of_step, start_walk
from twofold.sampling.training_grid import TrainingGrid
from twofold.volume.samples import Samples

_GRID_PAYS = 150_000
"""Samples from which on an SDF grid at 15 mm, of some eighty thousand nodes, is the quicker way."""

_COVERED = 0.99
"""Share of places at which the bounds of that grid hold: with those of all places it would rule out few samples."""

_COVERED_ALONE = 0.75
"""The same where the grid alone chooses the samples (`FieldQuery.costly`). Of paper-size networks with a density scale
of 3 mm it chooses a fifth more samples than queries would, and colours are no further from those of all samples."""


@dataclass(frozen=True)
class ShellSampler:
    """Samples near the posed body only, and of these only the ones that can be seen."""

    radius: float = 0.06
    """How far from the body's vertices samples are placed, metres."""
    step: float = 0.01
    """Distance between samples on a ray, metres."""
    voxel: float = 0.02
    """Edge of the voxels that list where the shell is, metres."""
    min_weight: float = 1e-3
    """Samples that a pass without gradients finds to add less than this to their pixel are discarded; 0 keeps all."""
    miswarp_slack: float = 0.0
    """Samples that come closer to the body by more than this when they are mapped to canonical space, metres, are
    mis-warped and discarded; 0 keeps them. Not for a field that starts as a sphere."""
    leap: float = 0.7
    """Share of the distance to the surface, where that is too large for a sample to count, that a ray may cross without
    a look at the samples between; 0 looks at every sample. Used on CPUs."""
    finest: float = 0.0
    """Near the surface steps are divided until they are as short as twice the density's scale, down to this, metres; 0
    leaves them as they are."""
    sdf_grid_voxel: float = 0.015
    """Rendering of large images: spacing of a grid of signed distances, queried once a pose, that finds most samples to
    be empty or hidden before the field is queried; metres, 0 queries the field for every sample."""
    training_grid_every: int = 0
    """While training on a CPU: steps after which such a grid is made anew, in the pose of another training frame each
    time; 0 makes none."""

    def __post_init__(self) -> None:
        """Refuses sizes that leave nothing to sample."""
        # The voxels of a body fill half a gigabyte at the smallest edge; a ray crosses it in a thousand steps.
        require_within(
            self, radius=(0.005, 0.5), step=(0.001, 0.5), voxel=(0.005, 0.5), min_weight=(0, 1), miswarp_slack=(0, 0.5),
            sdf_grid_voxel=(0, 0.5), leap=(0, 1), finest=(0, 0.5), training_grid_every=(0, 100_000),
        )  # fmt: skip
        if 0 < self.sdf_grid_voxel < 0.004:
            raise ValueError(f"sdf_grid_voxel={self.sdf_grid_voxel:g} should be 0.004 to 0.5, or 0 for no grid")
        if 0 < self.finest < 5e-4:
            raise ValueError(f"finest={self.finest:g} should be 0.0005 to 0.5, or 0 to leave steps as they are")
        if self.finest > 0 and self.min_weight == 0:
            raise ValueError("finest divides the steps of samples that count; it needs a min_weight above 0")

    @property
    def reach(self) -> float:
        """How far from the body samples can be, metres."""
        return self.radius

    def shell(self, body: Float[Tensor, "V 3"], neighbours: int) -> Shell:
        """The shell around a body, with enough candidates for that many neighbours."""
        return build_shell(body, self.radius, self.voxel, max(6, 2 * neighbours))

    def ray_box(
        self, joints: Float[Tensor, "24 3"], given: Callable[[], Float[Tensor, "24 3"]], scale: float
    ) -> Float[Tensor, "2 3"]:
        """A box around the posed joints; rays are bounded by the shell instead."""
        return joint_box(joints)

    def build(
        self, deformation: Deformation, canonical: Float[Tensor, "V 3"], faces: Int[Tensor, "F 3"]
    ) -> "ShellPlacer":
        """The sampler of one avatar, around its canonical body."""
        return ShellPlacer(self, deformation, canonical, faces)


class ShellPlacer:
    """See `ShellSampler`. Keeps the canonical shell, and the SDF grid of the last pose."""

    def __init__(self, config: ShellSampler, deformation: Deformation, canonical: Tensor, faces: Tensor) -> None:
        """Nothing is built yet."""
        self.config, self.deformation = config, deformation
        edges = (canonical[faces] - canonical[faces.roll(1, -1)]).norm(dim=-1)
        # The middle of an equilateral triangle is that far from its corners.
        self._spacing = float(edges.quantile(0.9)) / math.sqrt(3)
        self._canonical = canonical
        self._canonical_shell: Shell | None = None
        self._last_grid: tuple[PosedSurface, tuple[int, ...], SdfGrid] | None = None
        every = config.training_grid_every if config.min_weight else 0
        self.training_grid = TrainingGrid(canonical, config.radius, every) if every else None

    def place(
        self, rays: Rays, surface: PosedSurface, query: FieldQuery, training: bool, generator: torch.Generator | None
    ) -> Placement:
        """See `twofold.sampling.placement.Sampler`."""
        least, shell = self.config.min_weight, self._shell(surface)
        if least == 0:
            return self.well_warped(rays, surface, generator)
        grid = query.recent_grid if training else self._grid(shell, rays, surface, query)
        if can_walk(shell, rays):
            walk = self._walk(shell, rays, surface, generator)
            return walk.seen(query, least, self.config.leap, self.config.finest, grid)

        def seen(placed: Placement) -> Placement:
            return placed[visible(placed.samples, placed.x_canonical, len(rays), query, least, grid)]

        placed = seen(self.well_warped(rays, surface, generator))
        parts = parts_of_step(self.config.step, float(query.beta.detach()), self.config.finest)
        return placed if parts == 1 else seen(self._divided(placed.samples, rays, surface, parts))

    @torch.no_grad()
    def well_warped(self, rays: Rays, surface: PosedSurface, generator: torch.Generator | None) -> Placement:
        """`candidates` without those that are mis-warped."""
        shell = self._shell(surface)
        if can_walk(shell, rays):
            return self._walk(shell, rays, surface, generator).whole()
        return self._without_stray(self.candidates(rays, surface, generator), rays, surface)

    def _without_stray(self, placed: Placement, rays: Rays, surface: PosedSurface) -> Placement:
        slack = self.config.miswarp_slack
        if slack == 0 or len(placed.samples) == 0:
            return placed
        stray = miswarped(placed, rays, surface, self.canonical_shell(surface.forward.device), slack)
        return placed[(~stray).nonzero()[:, 0]]

    @torch.no_grad()
    def _divided(self, samples: Samples, rays: Rays, surface: PosedSurface, parts: int) -> Placement:
        """`parts` samples evenly spread over the step of each of these."""
        shell, step = self._shell(surface), self.config.step / parts
        middles = (torch.arange(parts, device=samples.depth.device) + 0.5 - parts / 2).to(samples.depth)
        depth = (samples.depth[:, None] + step * middles).flatten()
        index = samples.ray_index.repeat_interleave(parts)
        fine = Samples(index, depth, torch.full_like(depth, step))
        points = fine.points(rays)
        rows = shell.rows_at(points)
        inside = ((rows >= 0) & (depth >= rays.near[index]) & (depth < rays.far[index])).nonzero()[:, 0]
        nearest, squared = nearest_listed(shell, points[inside], rows[inside], surface.neighbours)
        close = squared[:, 0] < self._limit**2
        placed = self._placed(fine[inside[close]], nearest[close], squared[close], rays, surface)
        return self._without_stray(placed, rays, surface)

    def _placed(
        self, samples: Samples, nearest: Tensor, squared: Tensor, rays: Rays, surface: PosedSurface
    ) -> Placement:
        outlier = torch.zeros(len(samples), dtype=torch.bool, device=squared.device)
        return placement(samples, rays, nearest, self.deformation.weigh(squared), outlier, surface)

    @property
    def _limit(self) -> float:
        """How far from the nearest vertex samples are placed, metres."""
        return min(self.config.radius, self.deformation.outlier_distance)

    def _walk(self, shell: Shell, rays: Rays, surface: PosedSurface, generator: torch.Generator | None) -> Walk:
        slack = self.config.miswarp_slack
        canonical = self.canonical_shell(surface.forward.device) if slack > 0 else shell
        return start_walk(
            shell, rays, self.config.step, generator, self._limit, surface.neighbours, self.deformation,
            surface.forward, canonical, slack, self._spacing,
        )  # fmt: skip

    @torch.no_grad()
    def candidates(self, rays: Rays, surface: PosedSurface, generator: torch.Generator | None) -> Placement:
        """Every sample of the rays in the shell; a generator jitters each ray's evenly spaced samples together."""
        shell, step = self._shell(surface), self.config.step
        samples, nearest, squared = sample_shell(shell, rays, step, generator, self._limit, surface.neighbours)
        return self._placed(samples, nearest, squared, rays, surface)

    def _shell(self, surface: PosedSurface) -> Shell:
        """The body's shell; it may have been built before the body's last small corrections."""
        return replace(surface.shell, vertices=surface.body.vertices.detach())

    def canonical_shell(self, device: torch.device) -> Shell:
        """The shell around the canonical body."""
        if self._canonical_shell is None or self._canonical_shell.vertices.device != device:
            points = self._canonical.to(device)
            self._canonical_shell = build_shell(points, self.config.radius, self.config.voxel)
        return self._canonical_shell

    def _grid(self, shell: Shell, rays: Rays, surface: PosedSurface, query: FieldQuery) -> SdfGrid | None:
        """The SDF grid of this pose, made as soon as it pays; the last one is kept."""
        voxel = self.config.sdf_grid_voxel
        if voxel == 0:
            return None
        if self._last_grid is not None and self._last_grid[0] is surface and self._last_grid[1] == query.version:
            return self._last_grid[2]
        if expected_samples(shell, rays, self.config.step) < _GRID_PAYS * (0.015 / voxel) ** 3:
            return None
        points, covered = self._canonical.to(surface.forward.device), _COVERED_ALONE if query.costly else _COVERED
        grid = tabulate(query.distance, points, voxel, self.config.radius, covered=covered)
        self._last_grid = (surface, query.version, grid)
        return grid
