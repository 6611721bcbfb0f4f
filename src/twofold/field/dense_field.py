"""What fields of dense networks share: how points and answers pass in and out, and who takes the gradients."""

from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import Any, Literal, TypeVar

import torch
from jaxtyping import Float
from torch import Tensor, nn

from twofold.field.output import FieldOutput
from twofold.kernels.parallel import in_parts, one_thread_each

Answer = TypeVar("Answer")


_PART = 4096
"""Samples that a thread of a CPU passes through networks at once: 256 numbers of each stay in its cache."""


class DenseField(nn.Module, ABC):
    """A field of dense networks in canonical space. What differs: `at`, `_evaluate`, `_distance_and_gradient`, `_sdf`.

    Gradients of the distance by the point are "analytic", a reverse pass written out, or of "autograd", the plain form:
    then points become leaves of torch's graph, and without gradient mode answers are detached.
    """

    dense = True
    """Each query passes through large networks."""

    def __init__(self, gradients: Literal["analytic", "autograd"]) -> None:
        super().__init__()
        self.analytic = gradients == "analytic"

    @abstractmethod
    def at(self, pose: Float[Tensor, "P"]) -> Any:
        """The networks at one pose, their matrices multiplied out: what the next three take as `networks`."""

    @abstractmethod
    def _evaluate(
        self, x: Float[Tensor, "S 3"], networks: Any, to_observation: Float[Tensor, "S 3 3"] | None
    ) -> FieldOutput:
        """Distance, colour and gradient at points that require gradients where `autograd` takes them."""

    @abstractmethod
    def _distance_and_gradient(
        self, x: Float[Tensor, "S 3"], networks: Any
    ) -> tuple[Float[Tensor, "S"], Float[Tensor, "S 3"]]:
        """The distance and its gradient at points that require gradients where `autograd` takes them."""

    @abstractmethod
    def _sdf(self, x: Float[Tensor, "S 3"], networks: Any) -> Float[Tensor, "S"]:
        """The distance alone."""

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
        if not self.analytic:
            with torch.enable_grad():
                output = self._evaluate(_leaf(x_canonical), self.at(pose), to_observation)
            return output if torch.is_grad_enabled() else _detached(output)
        networks = self.at(pose)

        def part(begin: int, end: int) -> FieldOutput:
            matrices = None if to_observation is None else to_observation[begin:end]
            return self._evaluate(x_canonical[begin:end], networks, matrices)

        return _joined(_in_parts(x_canonical, part))

    def sdf(self, x_canonical: Float[Tensor, "S 3"], pose: Float[Tensor, "P"]) -> Float[Tensor, "S"]:
        """The distance that `forward` gives, alone, metres; about a third of its cost."""
        return self.sdf_at(pose)(x_canonical)

    def sdf_at(self, pose: Float[Tensor, "P"]) -> Callable[[Float[Tensor, "S 3"]], Float[Tensor, "S"]]:
        """`sdf` at one pose. The networks are multiplied out here, once for any number of calls."""
        networks = self.at(pose)
        return lambda x: torch.cat(_in_parts(x, lambda begin, end: self._sdf(x[begin:end], networks)))

    def distance_and_gradient(
        self, x_canonical: Float[Tensor, "S 3"], pose: Float[Tensor, "P"]
    ) -> tuple[Float[Tensor, "S"], Float[Tensor, "S 3"]]:
        """The distance and its canonical gradient, both differentiable by the parameters; no colour is computed."""
        if self.analytic:
            networks, x = self.at(pose), x_canonical
            parts = _in_parts(x, lambda begin, end: self._distance_and_gradient(x[begin:end], networks))
            return torch.cat([sdf for sdf, _ in parts]), torch.cat([gradient for _, gradient in parts])
        with torch.enable_grad():
            sdf, gradient = self._distance_and_gradient(_leaf(x_canonical), self.at(pose))
        return (sdf, gradient) if torch.is_grad_enabled() else (sdf.detach(), gradient.detach())


def _in_parts(rows: Tensor, work: Callable[[int, int], Answer]) -> list[Answer]:
    """What `work(begin, end)` gives for parts of the rows; for all at once where gradients are wanted, and on GPUs.

    On CPUs each thread takes parts of its own, which stay in its cache, and need not wait for others at each layer.
    """
    if torch.is_grad_enabled() or rows.is_cuda:
        return [work(0, len(rows))]

    @torch.no_grad()
    def share(begin: int, end: int) -> list[Answer]:
        torch.set_num_threads(1)
        return [work(at, min(at + _PART, end)) for at in range(begin, max(end, begin + 1), _PART)]

    with one_thread_each():
        return [answer for answers in in_parts(len(rows), share, least=_PART) for answer in answers]


def _joined(parts: list[FieldOutput]) -> FieldOutput:
    """The answers for all parts as one."""
    if len(parts) == 1:
        return parts[0]
    gradients = [part.gradient for part in parts if part.gradient is not None]
    bases = [part.base for part in parts if part.base is not None]
    sdf, color = (torch.cat([getattr(part, name) for part in parts]) for name in ("sdf", "color"))
    return FieldOutput(sdf, color, torch.cat(gradients) if gradients else None, _joined(bases) if bases else None)


def _leaf(x: Tensor) -> Tensor:
    """Points that a gradient can be taken by: themselves where they depend on something learned."""
    return x if x.requires_grad else x.detach().requires_grad_()


def _detached(output: FieldOutput) -> FieldOutput:
    gradient = None if output.gradient is None else output.gradient.detach()
    base = None if output.base is None else _detached(output.base)
    return FieldOutput(output.sdf.detach(), output.color.detach(), gradient, base)
