"""Samples along rays, packed: never a block of rays times samples."""

from dataclasses import dataclass

from jaxtyping import Float, Int
from torch import Tensor

from twofold.geometry.cameras import Rays


@dataclass(frozen=True)
class Samples:
    """Samples of many rays in one flat list, grouped by ray and ordered by depth; a ray may have none.

    Attributes:
        ray_index: the ray each sample lies on, ascending.
        depth: where on that ray, metres.
        delta: length of ray that the sample stands for, metres.
    """

    ray_index: Int[Tensor, "S"]
    depth: Float[Tensor, "S"]
    delta: Float[Tensor, "S"]

    def points(self, rays: Rays) -> Float[Tensor, "S 3"]:
        """Positions in the world."""
        origins, directions = rays.origins[self.ray_index], rays.directions[self.ray_index]
        return origins + self.depth[:, None] * directions

    def __getitem__(self, index: Tensor) -> "Samples":
        return Samples(self.ray_index[index], self.depth[index], self.delta[index])

    def __len__(self) -> int:
        return len(self.depth)
