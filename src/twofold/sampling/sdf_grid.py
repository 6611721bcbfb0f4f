"""A field's signed distance on a grid around the canonical body: queried once a pose, it skips empty space."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from twofold.field.grids import Lattices, build_lattices, interpolate


@dataclass(frozen=True)
class SdfGrid:
    """Distances at lattice nodes, and how far the field was found to be from what lies between them.

    Attributes:
        lattices: the nodes, one level.
        values: signed distance at each, metres; the first row, which stands for everywhere else, is NaN.
        error: metres.
    """

    lattices: Lattices
    values: Float[Tensor, "N 1"]
    error: float

    def __len__(self) -> int:
        return len(self.values)

    def bounds(self, x: Float[Tensor, "S 3"]) -> tuple[Float[Tensor, "S"], Float[Tensor, "S"]]:
        r"""Smallest and largest distance that the field may have at points, metres; infinite where the grid ends.

        \[ \tilde s(x) - \epsilon \le s(x) \le \tilde s(x) + \epsilon \]

        with the interpolated distance $\tilde s$ and the table's error $\epsilon$; an example stands at `tabulate`.
        """
        middle = interpolate(self.values, x, self.lattices)[:, 0]
        unknown = middle.isnan()
        return (
            torch.where(unknown, -torch.inf, middle - self.error),
            torch.where(unknown, torch.inf, middle + self.error),
        )


@torch.no_grad()
def tabulate(
    distance: Callable[[Float[Tensor, "n 3"]], Float[Tensor, "n"]],
    points: Float[Tensor, "n 3"],
    voxel: float,
    radius: float,
    chunk: int = 65_536,
    trials: int = 4096,
) -> SdfGrid:
    r"""Queries a field at the nodes of a grid, and between some of them for the error of the interpolation.

    \[ \epsilon = \tfrac32 \max_t |\tilde s(x_t) - s(x_t)| \]

    over the places $x_t$ of the trials.

    >>> grid = tabulate(lambda x: x[:, 0] - 0.2, torch.zeros(1, 3), voxel=0.1, radius=0.3)
    >>> low, high = grid.bounds(torch.tensor([[0.25, 0.0, 0.0], [9.0, 0.0, 0.0]]))
    >>> low, high  # a plane is interpolated without error
    (tensor([0.0500,   -inf]), tensor([0.0500,    inf]))

    Args:
        distance: the field's signed distance, metres.
        points: the canonical body, metres; nodes lie around them.
        voxel: spacing of the nodes, metres.
        radius: how far from the points, metres.
        chunk: points queried at once.
        trials: where the interpolation is tested: random places close to the surface. One and a half times the largest
            difference is the table's error.
    """
    device = points.device
    lattices, nodes = build_lattices(points.detach().cpu().numpy().astype(np.float32), (voxel,), radius)
    lattices = Lattices(*(tensor.to(device) for tensor in vars(lattices).values()))
    at = torch.from_numpy(nodes).to(device)
    values = torch.cat([distance(part) for part in at.split(chunk)]).float()
    values[0] = torch.nan
    grid = SdfGrid(lattices, values[:, None].contiguous(), 0.0)
    # Where it matters: cells that the surface may pass through, everywhere if there are none.
    close = (values.abs() < 2 * voxel).nonzero()[:, 0]
    close = close if len(close) else torch.arange(1, len(values), device=device)
    generator = torch.Generator().manual_seed(0)
    chosen = close[torch.randint(len(close), (trials,), generator=generator).to(device)]
    places = at[chosen] + voxel * (torch.rand(trials, 3, generator=generator) - 0.5).to(device)
    nearer, _ = grid.bounds(places)
    known = nearer.isfinite()
    wrong = (nearer - distance(places))[known].abs()
    return SdfGrid(lattices, grid.values, 1.5 * float(wrong.max()) if len(wrong) else torch.inf)
