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
        r"""Positions in the world, $x_i = o + t_i d$.

        >>> import torch
        >>> ray = Rays(torch.tensor([[0.0, 0.0, 1.0]]), torch.tensor([[0.0, 0.6, 0.8]]), torch.zeros(1), torch.ones(1))
        >>> Samples(torch.tensor([0, 0]), torch.tensor([0.0, 5.0]), torch.ones(2)).points(ray)
        tensor([[0., 0., 1.],
                [0., 3., 5.]])
        """
        origins, directions = rays.origins[self.ray_index], rays.directions[self.ray_index]
        return origins + self.depth[:, None] * directions

    def __getitem__(self, index: Tensor) -> "Samples":
        return Samples(self.ray_index[index], self.depth[index], self.delta[index])

    def __len__(self) -> int:
        return len(self.depth)
