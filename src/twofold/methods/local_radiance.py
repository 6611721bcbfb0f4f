"""DANBO's networks: density and colour from pose-dependent volumes around the bones. NPC's first stage trains them."""

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from twofold.field.bone_boxes import RIGID_PARTS, inside_boxes
from twofold.field.conditioned_radiance import ConditionedRadiance
from twofold.field.encoding import encoding_size, fourier_encoding
from twofold.field.local_volumes import VOLUME_COLUMNS, LocalVolumes
from twofold.methods.boxed_config import Radiance

FEATURE_OCTAVES, VIEW_OCTAVES, POSE_OCTAVES = 6, 4, 5


def inside_rigid(coordinates: Float[Tensor, "S 24 3"]) -> Bool[Tensor, "S"]:
    """Whether points are in the box of a rigid part; outside of these there is nothing."""
    return inside_boxes(coordinates[:, list(RIGID_PARTS)]).any(-1)


class LocalRadiance(nn.Module):
    """h = sum of p_j h_j over the boxes that hold a point; density and colour are networks of its encoding.

    With the boxes 2,454,852 parameters; `field.local_volumes.LocalVolumes` makes h, and
    `field.conditioned_radiance.ConditionedRadiance` the rest.
    """

    def __init__(self, generator: torch.Generator | None = None) -> None:
        super().__init__()
        self.volumes = LocalVolumes(generator)
        self.radiance = ConditionedRadiance(
            encoding_size(FEATURE_OCTAVES, VOLUME_COLUMNS), encoding_size(VIEW_OCTAVES), generator
        )

    def forward(
        self, tables: Float[Tensor, "24 f k 3"], coordinates: Float[Tensor, "S 24 3"], views: Float[Tensor, "S 3"],
        code: Float[Tensor, "c"], generator: torch.Generator | None = None,
    ) -> Radiance:  # fmt: skip
        """Density and colour of points, and the sum of p_j over the rigid parts as their extra.

        Args:
            tables: of the pose, from `LocalVolumes.tables`.
            coordinates: of the points in all boxes.
            views: unit view directions in the root's space.
            code: of the frame.
            generator: draws noise onto the density; None adds none.
        """
        feature, assigned = self._feature(tables, coordinates)
        view = fourier_encoding(views, VIEW_OCTAVES, include_pi=False)
        answer = self.radiance(feature, view, code, generator)
        return Radiance(answer.density, answer.color, assigned)

    def density(self, tables: Float[Tensor, "24 f k 3"], coordinates: Float[Tensor, "S 24 3"]) -> Float[Tensor, "S"]:
        """The density alone, without noise."""
        return self.radiance.density(self._feature(tables, coordinates)[0])[:, 0].relu()

    def _feature(self, tables: Tensor, coordinates: Tensor) -> tuple[Tensor, Tensor]:
        blended, probability = self.volumes(tables, coordinates, inside_boxes(coordinates))
        encoded = fourier_encoding(blended, FEATURE_OCTAVES, include_pi=False)
        return encoded, probability[:, list(RIGID_PARTS)].sum(-1)
