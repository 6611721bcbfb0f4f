"""The space outside a sphere, parametrised by direction and inverse distance (NeRF++; Vid2Avatar's background).

All lengths are those of the scene that the sphere encloses; Vid2Avatar scales the scene so that its radius is 3.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor, nn

from twofold.config import require, require_within
from twofold.field.encoding import encoding_size, fourier_encoding
from twofold.field.networks import Network, NetworkConfig, Precision
from twofold.field.output import RadianceOutput

RADIUS = 3.0
POINT_OCTAVES, VIEW_OCTAVES = 10, 4
OPEN_INTERVAL = 1e10
"""Length of a ray's last interval, which reaches to infinity."""


def sphere_exit(
    origins: Float[Tensor, "R 3"], directions: Float[Tensor, "R 3"], radius: float = RADIUS
) -> Float[Tensor, "R"]:
    r"""Distance along each ray, from inside the sphere around the origin of space, to where it leaves the sphere.

    \[ t = \sqrt{(o \cdot d)^2 - \lVert o \rVert^2 + R^2} - o \cdot d \]

    >>> sphere_exit(torch.tensor([[1.0, 0.0, 0.0]]), torch.tensor([[1.0, 0.0, 0.0]]))
    tensor([2.])

    Args:
        origins: inside the sphere.
        directions: unit length.
        radius: of the sphere.
    """
    toward = (origins * directions).sum(-1)
    return (toward.square() - origins.square().sum(-1) + radius**2).clamp_min(0).sqrt() - toward


def inverse_distances(
    rays: int,
    count: int = 32,
    radius: float = RADIUS,
    generator: torch.Generator | None = None,
    device: torch.device | str = "cpu",
) -> Float[Tensor, "rays n"]:
    r"""Inverse distances from the sphere (1 / radius) towards infinity (0), one in each of `count` strata.

    \[ \rho_i = \frac{1}{R} \Big( 1 - \frac{i}{n - 1} \Big) \]

    >>> inverse_distances(1, count=3, radius=2.0)
    tensor([[0.5000, 0.2500, 0.0000]])

    Args:
        rays: number of rays.
        count: samples of each.
        radius: of the sphere.
        generator: draws a place within each stratum; None spaces them evenly, both ends included.
        device: of the result.
    """
    steps = torch.linspace(0, 1, count).expand(rays, count)
    if generator is not None:
        middle = (steps[:, 1:] + steps[:, :-1]) / 2
        low, high = torch.cat([steps[:, :1], middle], 1), torch.cat([middle, steps[:, -1:]], 1)
        draw = torch.rand((rays, count), generator=generator, device=generator.device)
        steps = low + (high - low) * draw.to(low.device)
    return (steps.flip(1) / radius).to(device)


def inverse_intervals(inverse: Float[Tensor, "R n"]) -> Float[Tensor, "R n"]:
    r"""Length of each sample's interval in inverse distance; the last one is open.

    \[ \delta_i = \rho_i - \rho_{i+1}, \qquad \delta_n = 10^{10} \]

    >>> inverse_intervals(torch.tensor([[0.5, 0.25, 0.0]]))
    tensor([[2.5000e-01, 2.5000e-01, 1.0000e+10]])
    """
    return torch.cat([-inverse.diff(dim=1), torch.full_like(inverse[:, :1], OPEN_INTERVAL)], 1)


def inverted_sphere_points(
    origins: Float[Tensor, "R 3"], directions: Float[Tensor, "R 3"], inverse: Float[Tensor, "R n"]
) -> Float[Tensor, "R n 4"]:
    r"""The points of rays at inverse distances rho from the origin of space, as (unit direction, rho) (NeRF++ Eq. 12).

    \[ \Big( \rho p + \sqrt{1 - \rho^2 \lVert p \rVert^2} \, d, \; \rho \Big), \qquad p = o - (o \cdot d) d \]

    With p the foot of the perpendicular from the origin onto the ray and d the ray's direction, the point's direction
    is rho p + sqrt(1 - rho^2 |p|^2) d. That is where rotating the sphere hit by asin(|p| / R) - asin(rho |p|) ends,
    without angles; it is exact at infinity (rho = 0), where the direction is d.

    >>> inverted_sphere_points(torch.tensor([[1.0, 0.0, 0.0]]), torch.tensor([[0.0, 1.0, 0.0]]), torch.tensor([[0.6]]))
    tensor([[[0.6000, 0.8000, 0.0000, 0.6000]]])

    Args:
        origins: inside the sphere.
        directions: unit length.
        inverse: at most 1 / radius.
    """
    foot = origins - (origins * directions).sum(-1, keepdim=True) * directions
    rho = inverse[..., None]
    along = (1 - rho.square() * foot.square().sum(-1)[:, None, None]).clamp_min(0).sqrt()
    return torch.cat([rho * foot[:, None] + along * directions[:, None], rho], -1)


@dataclass(frozen=True)
class InvertedSphereFieldConfig:
    """Sizes of the background field; the defaults are those of Vid2Avatar."""

    code_size: int = 32
    """Numbers that stand for a frame."""
    width: int = 256
    """Units of the hidden layers of the first network."""
    depth: int = 8
    """Of these layers."""
    skip_layer: int = 4
    """The one that sees the encoded point again."""
    color_width: int = 128
    """Units of the colour's hidden layer."""
    hidden_dtype: Precision = "float32"
    """Of the layers between first and last, see `Precision`."""

    def __post_init__(self) -> None:
        """Refuses sizes that no network has."""
        require_within(
            self, code_size=(1, 4096), width=(1, 4096), depth=(2, 64), skip_layer=(1, self.depth - 1),
            color_width=(1, 4096),
        )  # fmt: skip
        columns = encoding_size(POINT_OCTAVES, 4)
        require(columns < self.width, f"width={self.width} should be above {columns}, the columns that skip_layer adds")

    def build(self, generator: torch.Generator | None = None) -> "InvertedSphereField":
        """A new field, its initial weights drawn from `generator`."""
        return InvertedSphereField(self, generator)


class InvertedSphereField(nn.Module):
    """Density and colour of the background, conditioned on a code for each frame.

    (a, f) = MLP(encoded point, code), density |a|, colour = sigmoid(MLP(encoded view, code, f)). 534,957 and 40,835
    parameters; the codes (32 numbers a frame) belong to the method.
    """

    def __init__(self, config: InvertedSphereFieldConfig, generator: torch.Generator | None = None) -> None:
        super().__init__()
        encoded = encoding_size(POINT_OCTAVES, 4)
        geometry = NetworkConfig(
            inputs=encoded,
            outputs=1 + config.width,
            depth=config.depth,
            width=config.width,
            constants=config.code_size,
            skip_layer=config.skip_layer,
            skip_columns=encoded,
            weight_norm=False,
            start="torch",
            hidden_dtype=config.hidden_dtype,
        )
        color = NetworkConfig(
            inputs=encoding_size(VIEW_OCTAVES) + config.width,
            outputs=3,
            depth=1,
            width=config.color_width,
            constants=config.code_size,
            activation="relu",
            weight_norm=False,
            start="torch",
        )
        self.geometry, self.color = Network(geometry, generator), Network(color, generator)

    def forward(
        self, points: Float[Tensor, "S 4"], views: Float[Tensor, "S 3"], code: Float[Tensor, "c"]
    ) -> RadianceOutput:
        """Density (per unit of inverse distance) and colour.

        Args:
            points: from `inverted_sphere_points`, flattened.
            views: the ray's direction at each point, unit length.
            code: of the frame.
        """
        geometry = self.geometry(fourier_encoding(points, POINT_OCTAVES, include_pi=False), code)
        seen = torch.cat([fourier_encoding(views, VIEW_OCTAVES, include_pi=False), geometry[:, 1:]], -1)
        return RadianceOutput(density=geometry[:, 0].abs(), color=self.color(seen, code).sigmoid())
