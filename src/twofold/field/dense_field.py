"""What fields of dense networks share: how points and answers pass in and out, and who takes the gradients."""

from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor, nn

from twofold.field.output import FieldOutput


class DenseField(nn.Module, ABC):
    """A field of dense networks in canonical space. What differs is `_evaluate`, `_distance_and_gradient` and `sdf`.

    Gradients of the distance by the point are "analytic", a reverse pass written out, or of "autograd", the plain form:
    then points become leaves of torch's graph, and without gradient mode answers are detached.
    """

    def __init__(self, gradients: Literal["analytic", "autograd"]) -> None:
        super().__init__()
        self.analytic = gradients == "analytic"

    @abstractmethod
    def _evaluate(
        self, x: Float[Tensor, "S 3"], pose: Float[Tensor, "P"], to_observation: Float[Tensor, "S 3 3"] | None
    ) -> FieldOutput:
        """Distance, colour and gradient at points that require gradients where `autograd` takes them."""

    @abstractmethod
    def _distance_and_gradient(
        self, x: Float[Tensor, "S 3"], pose: Float[Tensor, "P"]
    ) -> tuple[Float[Tensor, "S"], Float[Tensor, "S 3"]]:
        """The distance and its gradient at points that require gradients where `autograd` takes them."""

    @abstractmethod
    def sdf(self, x_canonical: Float[Tensor, "S 3"], pose: Float[Tensor, "P"]) -> Float[Tensor, "S"]:
        """The distance that `forward` gives, alone, metres."""

    def forward(
        self,
        x_canonical: Float[Tensor, "S 3"],
        pose: Float[Tensor, "P"],
        to_observation: Float[Tensor, "S 3 3"] | None = None,
    ) -> FieldOutput:
        """Distance, colour and gradient of the whole, and of the base branch where there is one beside it.

        Args:
            x_canonical: points, metres.
            pose: what the pose-dependent networks are conditioned on; as released, the 69 body angles over pi.
            to_observation: M, with the normal of observation space along M times the canonical gradient; for points
                moved by a matrix J that is the inverse transpose of J. None leaves normals canonical.
        """
        if self.analytic:
            return self._evaluate(x_canonical, pose, to_observation)
        with torch.enable_grad():
            output = self._evaluate(_leaf(x_canonical), pose, to_observation)
        return output if torch.is_grad_enabled() else _detached(output)

    def sdf_at(self, pose: Float[Tensor, "P"]) -> Callable[[Float[Tensor, "S 3"]], Float[Tensor, "S"]]:
        """`sdf` at one pose."""
        return lambda x_canonical: self.sdf(x_canonical, pose)

    def distance_and_gradient(
        self, x_canonical: Float[Tensor, "S 3"], pose: Float[Tensor, "P"]
    ) -> tuple[Float[Tensor, "S"], Float[Tensor, "S 3"]]:
        """The distance and its canonical gradient, both differentiable by the parameters; no colour is computed."""
        if self.analytic:
            return self._distance_and_gradient(x_canonical, pose)
        with torch.enable_grad():
            sdf, gradient = self._distance_and_gradient(_leaf(x_canonical), pose)
        return (sdf, gradient) if torch.is_grad_enabled() else (sdf.detach(), gradient.detach())


def _leaf(x: Tensor) -> Tensor:
    """Points that a gradient can be taken by: themselves where they depend on something learned."""
    return x if x.requires_grad else x.detach().requires_grad_()


def _detached(output: FieldOutput) -> FieldOutput:
    gradient = None if output.gradient is None else output.gradient.detach()
    base = None if output.base is None else _detached(output.base)
    return FieldOutput(output.sdf.detach(), output.color.detach(), gradient, base)
