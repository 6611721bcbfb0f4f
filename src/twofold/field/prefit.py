"""Fits a field's signed distance to a mesh before training (Vid2Avatar starts from the canonical body)."""

from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from twofold.config import require_within
from twofold.geometry.signed_distance import signed_distance
from twofold.geometry.surfaces import sample_surface


@runtime_checkable
class DistanceField(Protocol):
    """A field whose signed distance can be fitted."""

    def distance_and_gradient(
        self, x_canonical: Float[Tensor, "S 3"], pose: Float[Tensor, "P"]
    ) -> tuple[Float[Tensor, "S"], Float[Tensor, "S 3"]]:
        """The distance (metres) and its gradient, differentiable by the parameters."""
        ...

    def sdf(self, x_canonical: Float[Tensor, "S 3"], pose: Float[Tensor, "P"]) -> Float[Tensor, "S"]:
        """The distance alone."""
        ...


@dataclass(frozen=True)
class PrefitConfig:
    """How a distance is fitted.

    Attributes:
        steps: of Adam.
        learning_rate: falls to zero along a half cosine.
        points: in each step.
        pool: points whose distance to the mesh is computed, once; steps draw from them.
        near: half of them lie around the surface, at half of these standard deviations each, metres.
        margin: the other points are uniform in the mesh's box, so much larger on every side, metres.
        eikonal: weight of (|gradient| - 1)^2.
    """

    steps: int = 1000
    learning_rate: float = 5e-4
    points: int = 1024
    pool: int = 50_000
    near: tuple[float, float] = (0.01, 0.1)
    margin: float = 0.3
    eikonal: float = 0.1

    def __post_init__(self) -> None:
        """Refuses numbers that fit nothing."""
        require_within(
            self, steps=(1, 1_000_000), learning_rate=(1e-7, 1), points=(1, 1_000_000), pool=(16, 10_000_000),
            margin=(0, 10), eikonal=(0, 1e3),
        )  # fmt: skip


def distance_pool(
    vertices: Float[Tensor, "V 3"], faces: Int[Tensor, "F 3"], config: PrefitConfig, generator: torch.Generator
) -> tuple[Float[Tensor, "n 3"], Float[Tensor, "n"]]:
    """Points around a closed mesh and their signed distances to it, metres; half of them close to the surface."""
    near = config.pool // 2
    surface, _ = sample_surface(vertices, faces, near, generator)
    spread = torch.tensor(config.near).repeat((near + 1) // 2)[:near, None]
    noise = torch.randn(near, 3, generator=generator) * spread
    low, high = vertices.amin(0) - config.margin, vertices.amax(0) + config.margin
    anywhere = torch.rand(config.pool - near, 3, generator=generator).to(vertices)
    points = torch.cat([surface + noise.to(vertices), low + (high - low) * anywhere])
    return points, signed_distance(points, vertices, faces)


def fit_distance(
    field: DistanceField,
    parameters: list[nn.Parameter],
    pose: Float[Tensor, "P"],
    vertices: Float[Tensor, "V 3"],
    faces: Int[Tensor, "F 3"],
    config: PrefitConfig,
    generator: torch.Generator,
) -> float:
    """Trains `parameters` until the field's distance is that of a closed mesh; gives the mean error near it, metres.

    The loss is the mean |s - distance| and the eikonal term. The authors of Vid2Avatar ship fitted weights; how they
    were fitted is not known.

    Args:
        field: to be fitted.
        parameters: of its distance network.
        pose: condition at which it is fitted; zeros for the canonical body.
        vertices: of the mesh, canonical space, metres.
        faces: counter-clockwise from outside.
        config: see there.
        generator: draws the points.
    """
    points, distances = distance_pool(vertices, faces, config, generator)
    optimizer = torch.optim.Adam(parameters, lr=config.learning_rate)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, config.steps)
    for _ in range(config.steps):
        index = torch.randint(len(points), (config.points,), generator=generator).to(points.device)
        sdf, gradient = field.distance_and_gradient(points[index], pose)
        loss = (sdf - distances[index]).abs().mean()
        loss = loss + config.eikonal * (gradient.norm(dim=-1) - 1).square().mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        schedule.step()
    with torch.no_grad():
        near = slice(0, min(config.pool // 2, 8192))
        return float((field.sdf(points[near], pose) - distances[near]).abs().mean())
