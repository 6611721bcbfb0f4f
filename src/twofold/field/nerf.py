"""The networks of HumanNeRF and MonoHuman in canonical space, and the non-rigid motion before them."""

import torch
from jaxtyping import Float
from torch import Tensor, nn

from twofold.body.skeleton import PARENTS
from twofold.field.encoding import encoding_size, fourier_encoding, hann_encoding
from twofold.field.output import RadianceOutput
from twofold.kernels.mlp import MLP

CANONICAL_OCTAVES = 10
NON_RIGID_OCTAVES = 6
IMAGE_FEATURES = 35
"""Columns of MonoHuman's blended key-frame features: colour and 32 features of `field.resunet`."""
TIE = 1e-4
"""Share of a squared distance by which two bones may differ and count as equally near."""


class NonRigidMotion(nn.Module):
    """x_c = x_skel + MLP(windowed encoding of x_skel, pose): what the skeleton does not explain (HumanNeRF Eq. 6).

    105 inputs (69 of the pose, 36 of the point), six hidden layers of 128, the encoded point again before the fifth, 3
    outputs: 101,123 parameters. The last layer starts at U(+-1e-5), so the motion starts near zero.
    """

    def __init__(self, pose_size: int = 69, generator: torch.Generator | None = None) -> None:
        super().__init__()
        encoded = 3 * 2 * NON_RIGID_OCTAVES
        self.network = MLP(
            encoded, [128] * 6, 3, pose_size, skip_layer=4, skip_first=False, last_bound=1e-5, generator=generator
        )

    def forward(
        self, x_skeletal: Float[Tensor, "S 3"], condition: Float[Tensor, "p"], open_bands: float
    ) -> Float[Tensor, "S 3"]:
        """The moved points, metres.

        Args:
            x_skeletal: points that the skeleton brought to canonical space (or, for MonoHuman's forward motion, to a
                pose), metres.
            condition: the pose (`deform.pose_correction.body_pose_condition`), or zeros.
            open_bands: of the encoding, see `open_hann_bands`; at 0 the offset is the same everywhere.
        """
        encoded = hann_encoding(x_skeletal, NON_RIGID_OCTAVES, open_bands)
        return x_skeletal + self.network(encoded, condition)


class CanonicalNerf(nn.Module):
    """Colour and density of HumanNeRF in canonical space: (c, sigma) = MLP(encoded x_c) (HumanNeRF Eq. 2).

    63 inputs, eight hidden layers of 256, the encoded point again before the sixth, 4 outputs: 494,084 parameters.
    There is no view direction.
    """

    def __init__(self, generator: torch.Generator | None = None) -> None:
        super().__init__()
        self.network = MLP(encoding_size(CANONICAL_OCTAVES), [256] * 8, 4, skip_layer=5, generator=generator)

    def forward(self, x_canonical: Float[Tensor, "S 3"]) -> RadianceOutput:
        """Density ReLU(sigma) and colour sigmoid(c) at canonical points (metres)."""
        result = self.network(fourier_encoding(x_canonical, CANONICAL_OCTAVES, include_pi=False))
        return RadianceOutput(density=result[:, 3].relu(), color=result[:, :3].sigmoid())


class ImageConditionedNerf(nn.Module):
    """Colour and density of MonoHuman: (z, sigma) = MLP_1(encoded x, encoded x - j), c = MLP_2(z, g).

    MLP_1 has 126 inputs, eight hidden layers of 256 with the inputs again before the sixth, and 36 outputs (534,564
    parameters); MLP_2 has 70 inputs, four hidden layers of 256 with the inputs again before the fourth, and 3 outputs
    (234,243).
    """

    def __init__(self, generator: torch.Generator | None = None) -> None:
        super().__init__()
        columns = 2 * encoding_size(CANONICAL_OCTAVES)
        self.geometry = MLP(columns, [256] * 8, 1 + IMAGE_FEATURES, skip_layer=5, generator=generator)
        self.color = MLP(2 * IMAGE_FEATURES, [256] * 4, 3, skip_layer=3, generator=generator)

    def forward(
        self,
        x_canonical: Float[Tensor, "S 3"],
        bone_offset: Float[Tensor, "S 3"],
        image_features: Float[Tensor, f"S {IMAGE_FEATURES}"],
    ) -> RadianceOutput:
        """Density ReLU(sigma) and colour sigmoid(MLP_2) at canonical points.

        Args:
            x_canonical: metres.
            bone_offset: from `offset_to_nearest_bone`, metres.
            image_features: g, blended over the key frames (`field.resunet.ViewBlending`).
        """
        latent = self._latent(x_canonical, bone_offset)
        color = self.color(torch.cat([latent[:, :IMAGE_FEATURES], image_features], -1))
        return RadianceOutput(density=latent[:, IMAGE_FEATURES].relu(), color=color.sigmoid())

    def density(self, x_canonical: Float[Tensor, "S 3"], bone_offset: Float[Tensor, "S 3"]) -> Float[Tensor, "S"]:
        """The density alone; arguments as for `forward`."""
        return self._latent(x_canonical, bone_offset)[:, IMAGE_FEATURES].relu()

    def _latent(self, x_canonical: Tensor, bone_offset: Tensor) -> Tensor:
        encoded = [fourier_encoding(x, CANONICAL_OCTAVES, include_pi=False) for x in (x_canonical, bone_offset)]
        return self.geometry(torch.cat(encoded, -1))


@torch.no_grad()
def offset_to_nearest_bone(x_canonical: Float[Tensor, "S 3"], joints: Float[Tensor, "24 3"]) -> Float[Tensor, "S 3"]:
    r"""x_c - j, with j the parent joint of the bone segment (of 23) that is nearest to x_c; no gradient.

    \[ x_c - J_{p(b)}, \qquad b = \arg\min_b \min_{0 \le t \le 1} \lVert x_c - J_{p(b)} - t (J_b - J_{p(b)}) \rVert \]

    >>> joints = torch.arange(24.0)[:, None] * torch.tensor([0.0, 1.0, 0.0])
    >>> offset_to_nearest_bone(torch.tensor([[2.0, -1.0, 0.0]]), joints)
    tensor([[ 2., -1.,  0.]])

    Args:
        x_canonical: points, metres.
        joints: of the T-pose, metres.
    """
    start = joints[list(PARENTS[1:])]
    along = joints[1:] - start
    offset = x_canonical[:, None] - start
    fraction = (offset * along).sum(-1) / along.square().sum(-1).clamp_min(1e-12)
    squared = (offset - fraction.clamp(0, 1)[..., None] * along).square().sum(-1)
    # Two bones that share a joint are equally near wherever that joint is the nearest point: the first one counts, not
    # rounding.
    near = squared <= squared.amin(-1, keepdim=True) * (1 + TIE) + TIE**2
    first = torch.where(near, torch.arange(len(start), device=near.device), len(start) - 1).amin(-1)
    return x_canonical - start[first]
