"""NPC's second stage: points on the surface that its first stage found, and the networks that read them."""

from collections.abc import Collection
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Int
from skimage.measure import marching_cubes
from torch import Tensor, nn

from twofold.errors import TwofoldError
from twofold.field.bone_boxes import RIGID_PARTS, bone_frames, box_coordinates
from twofold.field.pixel_background import PixelBackground
from twofold.field.point_features import (
    PointFeatures,
    PointRadiance,
    PointTables,
    QueriedFeatures,
    nearest_posed_points,
)
from twofold.field.points import PARTS, PointCloud, PointDeformation, PosedPoints, choose_positions
from twofold.losses import eikonal, neighbour_distances, point_offsets, surface_points
from twofold.methods.boxed_config import Radiance
from twofold.volume.rendering import laplace_density

BETA, MIN_BETA = 0.1, 1e-4
"""Initial scale of the density, and what is added to its absolute value; metres."""
CONSTRAINED = 100
"""Points of each part that a step asks for the eikonal and the surface term."""
EIKONAL_SPREAD = 0.03
"""How far from a point the eikonal term asks, along each axis, metres."""
DROPPED = 0.8
"""How often the nearest point has no weight in these queries."""


@dataclass(frozen=True)
class ReadyPoints:
    """The points in a pose, with what queries look up."""

    posed: PosedPoints
    tables: PointTables


@dataclass(frozen=True)
class PointWeights:
    """Weights of NPC's terms beside the colours; the defaults are the authors' program."""

    offsets: float = 1.0
    """Offsets of 4 cm and more."""
    eikonal: float = 0.01
    neighbours: float = 10.0
    """Distances between neighbouring points that differ from those of the rest pose."""
    surface: float = 0.1
    """Points outside of the surface."""


class PointNetworks(nn.Module):
    """Points, how a pose moves them, and distance and colour from the points around a query.

    2,580,473 parameters with 3800 points.

    Args:
        positions: box coordinates of the points.
        joints: of the rest pose, metres.
        half_sizes: of all boxes, metres.
        generator: draws the start.
        beta: initial scale of the density, metres.
    """

    def __init__(
        self,
        positions: Float[Tensor, "m 19 3"],
        joints: Float[Tensor, "24 3"],
        half_sizes: Float[Tensor, "24 3"],
        generator: torch.Generator | None = None,
        beta: float = BETA,
    ) -> None:
        super().__init__()
        self.cloud = PointCloud(positions, joints, half_sizes, generator=generator)
        self.deformation = PointDeformation(generator)
        self.features = PointFeatures(generator)
        self.radiance = PointRadiance(generator)
        self.background = PixelBackground(generator)
        self.raw_beta = nn.Parameter(torch.tensor(beta))

    @property
    def beta(self) -> Float[Tensor, ""]:
        """Scale of the density, metres."""
        return self.raw_beta.abs() + MIN_BETA

    def ready(self, features: Float[Tensor, "24 f"], transforms: Float[Tensor, "24 4 4"]) -> ReadyPoints:
        """The points in a pose, once for all queries.

        Args:
            features: of the pose, `field.graph.pose_features` with 5 octaves.
            transforms: from the rest pose, one a joint.
        """
        return ReadyPoints(self.deformation(self.cloud, features, transforms), self.features.tables(self.cloud))

    def forward(
        self, ready: ReadyPoints, queries: Float[Tensor, "S 3"], views: Float[Tensor, "S 3"], code: Float[Tensor, "c"]
    ) -> Radiance:
        """Density and colour at queries in the boxes; the extra is the signed distance, metres."""
        sdf, color = self.radiance(self._queried(ready, queries, views), code)
        return Radiance(laplace_density(sdf, self.beta), color, sdf)

    def density(self, ready: ReadyPoints, queries: Float[Tensor, "S 3"]) -> Float[Tensor, "S"]:
        """The density alone."""
        sdf = self.radiance.sdf(self._queried(ready, queries, torch.zeros_like(queries)))
        return laplace_density(sdf, self.beta)

    def constraints(
        self, ready: ReadyPoints, weights: PointWeights, generator: torch.Generator
    ) -> dict[str, Float[Tensor, ""]]:
        """The weighted terms that hold the points together and the distance to them; see `losses`.

        Queries do not move with the points: they carry no gradient.
        """
        posed, rest = ready.posed, self.cloud.rest_points().flatten(0, 1)
        chosen = self._chosen(generator)
        at = posed.positions.detach()[chosen]
        moved = at + EIKONAL_SPREAD * (2 * self._random(at.shape, generator) - 1)
        moved.requires_grad_(True)
        near = self.radiance.sdf(self._dropping(ready, moved, generator))
        gradient = torch.autograd.grad(near.sum(), moved, create_graph=True)[0]
        on = self.radiance.sdf(self._dropping(ready, at, generator))
        return {
            "offsets": weights.offsets * point_offsets(posed.offsets),
            "eikonal": weights.eikonal * eikonal(gradient),
            "neighbours": weights.neighbours * neighbour_distances(posed.positions, rest, self.cloud.neighbours[:, 1:]),
            "surface": weights.surface * surface_points(on),
        }

    def _chosen(self, generator: torch.Generator) -> Int[Tensor, "n"]:
        """Numbers of random points, as many of each part."""
        slots = torch.randint(
            len(self.cloud.positions), (CONSTRAINED, PARTS), generator=generator, device=generator.device
        )
        return (slots * PARTS + torch.arange(PARTS, device=slots.device)).flatten().to(self.raw_beta.device)

    def _random(self, shape: torch.Size, generator: torch.Generator) -> Tensor:
        return torch.rand(shape, generator=generator, device=generator.device).to(self.raw_beta)

    def _dropping(self, ready: ReadyPoints, queries: Tensor, generator: torch.Generator) -> QueriedFeatures:
        dropped = self._random(queries.shape[:1], generator) < DROPPED
        return self._queried(ready, queries, torch.zeros_like(queries), dropped)

    def _queried(
        self, ready: ReadyPoints, queries: Tensor, views: Tensor, dropped: Tensor | None = None
    ) -> QueriedFeatures:
        posed = ready.posed
        coordinates = box_coordinates(queries.detach(), posed.world_to_frame, self.cloud.half_sizes)
        nearest = nearest_posed_points(queries.detach(), coordinates, posed.positions.detach())
        return self.features(queries, views, nearest, self.cloud, posed, ready.tables, dropped)


def surface_positions(
    volume: Float[np.ndarray, "x y z"],
    low: Float[Tensor, "3"],
    voxel: float,
    joints: Float[Tensor, "24 3"],
    half_sizes: Float[Tensor, "24 3"],
    count: int,
    unseen: Collection[int] = (),
    body: Float[Tensor, "b 3"] | None = None,
) -> Float[Tensor, "m 19 3"]:
    """Box coordinates of points where a level of the rest pose is zero, `count` (m) of each part; see `PointCloud`.

    Args:
        volume: the level on a grid, negative inside.
        low: where the grid begins, metres.
        voxel: its spacing, metres.
        joints: of the rest pose, metres.
        half_sizes: of all boxes, metres.
        count: points of each part.
        unseen: parts that no image shows.
        body: points on the body's surface, which are taken there, metres.

    Raises:
        TwofoldError: there is no surface, or too little of it in a part.
    """
    if volume.min() >= 0 or volume.max() <= 0:
        raise TwofoldError(
            "NPC's first stage found no surface in the rest pose, so there is nothing to put points on; train it "
            "longer (method.first_steps), or look at the capture's poses and masks with `twofold check`."
        )
    vertices = torch.from_numpy(marching_cubes(volume, 0.0, spacing=(voxel,) * 3)[0].copy()).to(low) + low
    still = torch.eye(4, dtype=low.dtype, device=low.device).repeat(24, 1, 1)
    to_frame = bone_frames(joints).world_to_frame(still)[list(RIGID_PARTS)]
    rigid = half_sizes[list(RIGID_PARTS)]
    instead = None if body is None else box_coordinates(body.to(low), to_frame, rigid)
    return choose_positions(box_coordinates(vertices, to_frame, rigid), rigid, count, unseen, instead)
