"""Samples placed on rays and mapped to canonical space: what every sampler of a body-based method returns."""

from dataclasses import dataclass
from typing import Literal, Protocol

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from twofold.deform.skinning import map_to_canonical, weights_by, with_pose_gradient
from twofold.geometry.cameras import Rays
from twofold.sampling.posed_surface import PosedSurface
from twofold.sampling.sdf_grid import Distance, SdfGrid
from twofold.sampling.training_grid import TrainingGrid
from twofold.volume.samples import Samples


@dataclass(frozen=True)
class Deformation:
    """How samples are mapped to canonical space.

    Attributes:
        falloff: how the nearest vertices count, as `deform.skinning.weights_by` has it.
        outlier_distance: samples further than this from the body count as empty, metres.
        scale: scene units per metre: 1, or the release's normalisation.
    """

    falloff: Literal["exponential", "scene", "smooth"]
    outlier_distance: float
    scale: float = 1.0

    def weigh(self, squared_distances: Float[Tensor, "S K"]) -> Float[Tensor, "S K"]:
        """The weights of the K nearest vertices from their squared distances, metres squared."""
        return weights_by(self.falloff, squared_distances, self.scale)


@dataclass(frozen=True)
class FieldQuery:
    """What a sampler may ask of a field in one pose.

    Attributes:
        distance: signed distance at canonical points, metres.
        beta: scale of the Laplace density, metres.
        version: changes whenever the field's parameters do.
        costly: a query costs a third of what shading the sample does, or more: where a grid of distances has chosen the
            samples, they are not chosen once more by queries.
        recent_grid: distances as they were some training steps ago.
    """

    distance: Distance
    beta: Float[Tensor, ""]
    version: tuple[int, ...] = ()
    costly: bool = False
    recent_grid: SdfGrid | None = None


@dataclass(frozen=True)
class Placement:
    """Samples of some rays with their canonical positions.

    Attributes:
        samples: packed.
        nearest: the K nearest body vertices of each sample.
        weights: the weight of each of these.
        outlier: too far from the body to count.
        x_canonical: the sample in canonical space, metres; without gradients.
        inverse: the posed-to-canonical transform of each sample; without gradients.
    """

    samples: Samples
    nearest: Int[Tensor, "S K"]
    weights: Float[Tensor, "S K"]
    outlier: Bool[Tensor, "S"]
    x_canonical: Float[Tensor, "S 3"]
    inverse: Float[Tensor, "S 3 4"]

    def __getitem__(self, index: Tensor) -> "Placement":
        return Placement(
            self.samples[index],
            self.nearest[index],
            self.weights[index],
            self.outlier[index],
            self.x_canonical[index],
            self.inverse[index],
        )

    def differentiable(self, surface: PosedSurface) -> tuple[Float[Tensor, "S 3"], Float[Tensor, "S 3 3"]]:
        """Canonical positions and J^-T of the skinning, as computed before, now with the gradient by the pose."""
        return with_pose_gradient(self.x_canonical, self.inverse, self.nearest, self.weights, surface.forward)


@torch.no_grad()
def placement(
    samples: Samples, rays: Rays, nearest: Int[Tensor, "S K"], weights: Float[Tensor, "S K"],
    outlier: Bool[Tensor, "S"], surface: PosedSurface,
) -> Placement:  # fmt: skip
    """Samples whose nearest vertices are known, mapped to canonical space once."""
    x_canonical, inverse = map_to_canonical(samples.points(rays), nearest, weights, surface.forward)
    return Placement(samples, nearest, weights, outlier, x_canonical, inverse)


class Sampler(Protocol):
    """Places samples on rays. A sampler's configuration builds one.

    Attributes:
        training_grid: what the avatar tabulates while it is trained, and stores; None where the sampler uses none.
    """

    training_grid: TrainingGrid | None

    def place(
        self, rays: Rays, surface: PosedSurface, query: FieldQuery, training: bool, generator: torch.Generator | None
    ) -> Placement:
        """Samples worth shading.

        Args:
            rays: to place samples on.
            surface: the posed body.
            query: of the field.
            training: whether the field is being trained; evaluation may use caches and stricter tests.
            generator: moves samples at random; None spaces them evenly.
        """
        ...
