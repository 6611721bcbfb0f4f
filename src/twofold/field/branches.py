"""One branch of the factorized field: its networks, and the reverse pass through its distance."""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor, nn

from twofold.field.encoding import encoding_pullback
from twofold.field.networks import Network, NetworkConfig, ReadyNetwork, Tape


@dataclass(frozen=True)
class ReadyBranch:
    """A branch's networks at one pose.

    Attributes:
        sdf: encoded point (and what the other branch hands over) to distance and feature.
        color: to colour; its last hidden layer is handed over.
        feature_code: shortens the colour feature that the other branch hands over.
    """

    sdf: ReadyNetwork
    color: ReadyNetwork
    feature_code: nn.Linear | None

    def told(self, color_feature: Float[Tensor, "S f"]) -> Float[Tensor, "S g"]:
        """The other branch's colour feature, as this one's colour network sees it."""
        return color_feature if self.feature_code is None else self.feature_code(color_feature)


class BranchNetworks(nn.Module):
    """Distance and colour network of one branch, and the linear maps that shorten its colour network's inputs.

    Args:
        sdf: of the distance network; its constants are the pose, or none.
        color: of the colour network; its constants are the pose or its code, or none.
        pose_code: numbers that the pose becomes for the colour network; None gives it as it is.
        feature_code: numbers that the other branch's colour feature becomes; None gives it as it is.
        generator: draws the start.
    """

    def __init__(
        self,
        sdf: NetworkConfig,
        color: NetworkConfig,
        pose_code: int | None,
        feature_code: int | None,
        generator: torch.Generator | None = None,
    ) -> None:
        super().__init__()
        self.sdf, self.color = Network(sdf, generator), Network(color, generator)
        self.pose_code = None if pose_code is None else _linear(sdf.constants, pose_code, generator)
        self.feature_code = None if feature_code is None else _linear(color.width, feature_code, generator)

    def at(self, pose: Float[Tensor, "P"]) -> ReadyBranch:
        """The networks at one pose; a branch that takes none ignores it."""
        if self.sdf.config.constants == 0:
            return ReadyBranch(self.sdf.at(), self.color.at(), self.feature_code)
        code = pose if self.pose_code is None else self.pose_code(pose)
        return ReadyBranch(self.sdf.at(pose), self.color.at(code), self.feature_code)


@dataclass(frozen=True)
class Geometry:
    """A distance network's answer at points.

    Attributes:
        network: that answered.
        encoded: the encoded points.
        sdf: distances, metres.
        feature: the other outputs.
        tape: for the reverse pass; None where gradients come from automatic differentiation.
        below: the geometry whose feature was an input too.
        include_pi: as it was for the encoding.
    """

    network: ReadyNetwork
    encoded: Float[Tensor, "S e"]
    sdf: Float[Tensor, "S"]
    feature: Float[Tensor, "S f"]
    tape: Tape | None
    below: "Geometry | None"
    include_pi: bool

    def pull_sdf(self) -> Float[Tensor, "S 3"]:
        """Gradient of the distance by the point."""
        return self.pull(torch.ones_like(self.sdf)[:, None], 0)

    def pull(self, cotangent: Float[Tensor, "S k"], first: int) -> Float[Tensor, "S 3"]:
        """Gradient by the point of k outputs from `first` (0 is the distance), weighted by `cotangent` and summed.

        It goes through the encoding and, where features were handed over, through the network that they came from.
        """
        if self.tape is None:
            raise ValueError("this geometry was computed without a tape, so it has no reverse pass")
        by_input = self.network.pullback(self.tape, cotangent, first)
        columns = self.encoded.shape[-1]
        own = encoding_pullback(self.encoded, by_input[:, :columns], self.include_pi)
        return own if self.below is None else own + self.below.pull(by_input[:, columns:], 1)


@dataclass(frozen=True)
class Branch:
    """What a branch says: geometry, canonical gradient of its distance, its colour as it leaves the network.

    Attributes:
        geometry: distance and feature.
        gradient: of the distance.
        color: before any sigmoid.
        color_feature: the colour network's last hidden layer.
    """

    geometry: Geometry
    gradient: Float[Tensor, "S 3"]
    color: Float[Tensor, "S 3"]
    color_feature: Float[Tensor, "S f"]


def _linear(inputs: int, outputs: int, generator: torch.Generator | None) -> nn.Linear:
    """nn.Linear, its usual start drawn from `generator`."""
    layer = nn.Linear(inputs, outputs)
    with torch.no_grad():
        for parameter in layer.parameters():
            parameter.copy_((2 * torch.rand(parameter.shape, generator=generator) - 1) / inputs**0.5)
    return layer
