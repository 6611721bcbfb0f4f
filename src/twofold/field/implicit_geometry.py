"""Vid2Avatar's field: one signed distance and one colour network in canonical space, both conditioned on the pose."""

from dataclasses import dataclass
from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional as F

from twofold.config import require_within
from twofold.field.branches import BranchNetworks, Geometry, ReadyBranch
from twofold.field.dense_field import DenseField
from twofold.field.encoding import encoding_size, fourier_encoding
from twofold.field.networks import NetworkConfig, Precision
from twofold.field.output import FieldOutput


@dataclass(frozen=True)
class ImplicitFieldConfig:
    """The field's sizes; the defaults are those of Vid2Avatar.

    Attributes:
        octaves: frequencies of the encoded point, 2^k radians per metre.
        width: units of every hidden layer, and of the feature between the two networks.
        sdf_depth: hidden layers of the distance network.
        color_depth: of the colour network.
        skip_layer: hidden layer of the distance network that sees the encoded point again.
        pose_code: numbers that the colour network sees of the pose, by a linear map.
        radius: the distance starts near that of a sphere, metres.
        gradients: of the distance by the point: "analytic", a reverse pass written out, or "autograd", the plain form.
        hidden_dtype: of the layers between first and last, see `Precision`.
    """

    octaves: int = 6
    width: int = 256
    sdf_depth: int = 8
    color_depth: int = 4
    skip_layer: int = 4
    pose_code: int = 8
    radius: float = 0.6
    gradients: Literal["analytic", "autograd"] = "analytic"
    hidden_dtype: Precision = "float32"

    def __post_init__(self) -> None:
        """Refuses sizes that no network has."""
        require_within(
            self, octaves=(0, 20), width=(1, 4096), sdf_depth=(2, 64), color_depth=(1, 64),
            skip_layer=(1, self.sdf_depth - 1), pose_code=(1, 1024), radius=(0.01, 3),
        )  # fmt: skip
        if encoding_size(self.octaves) >= self.width:
            raise ValueError(
                f"octaves={self.octaves} make {encoding_size(self.octaves)} columns, which skip_layer="
                f"{self.skip_layer} puts into layers of width={self.width}; widen them or lower octaves"
            )

    def build(self, pose_size: int = 69, generator: torch.Generator | None = None) -> "ImplicitField":
        """A new field for poses of `pose_size` numbers, its initial weights drawn from `generator`."""
        return ImplicitField(self, pose_size, generator)


class ImplicitField(DenseField):
    """(s, f) = SDF(encoded x, pose); c = sigmoid(RGB(x, n, P pose, f)), n the normal (Vid2Avatar Eqs. 1, 2).

    815,850 parameters at the default sizes. The distance starts near that of a sphere (geometric initialisation).
    """

    def __init__(self, config: ImplicitFieldConfig, pose_size: int, generator: torch.Generator | None = None) -> None:
        super().__init__(config.gradients)
        self.config = config
        encoded = encoding_size(config.octaves)
        sdf = NetworkConfig(
            inputs=encoded,
            outputs=1 + config.width,
            depth=config.sdf_depth,
            width=config.width,
            constants=pose_size,
            skip_layer=config.skip_layer,
            skip_columns=encoded,
            start="sphere",
            radius=config.radius,
            hidden_dtype=config.hidden_dtype,
            native_softplus=config.gradients == "autograd",
        )
        color = NetworkConfig(
            inputs=3 + 3 + config.width,
            outputs=3,
            depth=config.color_depth,
            width=config.width,
            constants=config.pose_code,
            activation="relu",
            start="torch",
            hidden_dtype=config.hidden_dtype,
        )
        self.networks = BranchNetworks(sdf, color, config.pose_code, None, generator)

    def at(self, pose: Float[Tensor, "P"]) -> ReadyBranch:
        """See `DenseField.at`."""
        return self.networks.at(pose)

    def _sdf(self, x: Float[Tensor, "S 3"], networks: ReadyBranch) -> Float[Tensor, "S"]:
        """See `DenseField._sdf`."""
        return networks.sdf(self._encoded(x), 1)[:, 0]

    def _evaluate(
        self, x: Float[Tensor, "S 3"], networks: ReadyBranch, to_observation: Float[Tensor, "S 3 3"] | None
    ) -> FieldOutput:
        """See `DenseField._evaluate`."""
        geometry, gradient = self._geometry(networks, x)
        normal = gradient if to_observation is None else (to_observation * gradient[:, None]).sum(-1)
        inputs = torch.cat([x, F.normalize(normal, dim=-1, eps=1e-6), geometry.feature], -1)
        return FieldOutput(geometry.sdf, networks.color(inputs).sigmoid(), gradient)

    def _distance_and_gradient(
        self, x: Float[Tensor, "S 3"], networks: ReadyBranch
    ) -> tuple[Float[Tensor, "S"], Float[Tensor, "S 3"]]:
        """See `DenseField._distance_and_gradient`."""
        geometry, gradient = self._geometry(networks, x)
        return geometry.sdf, gradient

    def _encoded(self, x: Tensor) -> Tensor:
        return fourier_encoding(x, self.config.octaves, include_pi=False)

    def _geometry(self, networks: ReadyBranch, x: Tensor) -> tuple[Geometry, Tensor]:
        encoded = self._encoded(x)
        if self.analytic:
            output, tape = networks.sdf.forward_with_tape(encoded)
            geometry = Geometry(networks.sdf, encoded, output[:, 0], output[:, 1:], tape, None, False)
            return geometry, geometry.pull_sdf()
        output = networks.sdf(encoded)
        geometry = Geometry(networks.sdf, encoded, output[:, 0], output[:, 1:], None, None, False)
        (gradient,) = torch.autograd.grad(geometry.sdf.sum(), x, create_graph=self.training, retain_graph=True)
        return geometry, gradient
