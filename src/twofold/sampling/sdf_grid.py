"""A field's signed distance on a grid around the canonical body: it skips empty and hidden space."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from twofold.field.grids import build_lattices

UNKNOWN = 1e6
"""What stands in a grid where the distance is not known, metres; finite, so that comparisons tell it."""
KNOWN_BELOW = 1e3
"""Distances of nodes from this on are not known, metres."""
Distance = Callable[[Float[Tensor, "n 3"]], Float[Tensor, "n"]]
"""A field's signed distance at canonical points, metres."""


@dataclass(frozen=True)
class SdfGrid:
    """Distances at the nodes of a grid, and how far the field was found to be from what lies between them.

    Attributes:
        values: signed distance at each node, metres; `UNKNOWN` where it is not known.
        low: the first node, metres.
        voxel: spacing of the nodes, metres.
        error: bound of the difference between the field and the interpolated distance, metres; see `tabulate`.
    """

    values: Float[Tensor, "X Y Z"]
    low: Float[Tensor, "3"]
    voxel: float
    error: float

    def interpolate(self, x: Float[Tensor, "S 3"]) -> Float[Tensor, "S"]:
        r"""The trilinear distance at points, metres; NaN where one of the eight nodes around is not known.

        >>> grid = SdfGrid(torch.arange(8.0).reshape(2, 2, 2), torch.zeros(3), voxel=0.1, error=0.0)
        >>> grid.interpolate(torch.tensor([[0.05, 0.05, 0.05], [0.2, 0.0, 0.0]]))
        tensor([3.5000,    nan])
        """
        index, weights = self.corners(x)
        nodes = self.values.flatten()[index]
        return torch.where((nodes < KNOWN_BELOW).all(-1), (nodes * weights).sum(-1), torch.nan)

    def corners(self, x: Float[Tensor, "S 3"]) -> tuple[Int[Tensor, "S 8"], Float[Tensor, "S 8"]]:
        """The eight nodes around each point, as numbers among all, and their weights; NaN beyond the grid."""
        unit = ((x.to(self.low.dtype) - self.low) / self.voxel).nan_to_num(-1.0)
        size = torch.tensor(self.values.shape, device=x.device)
        cell = unit.floor().clamp_min(0).minimum(size - 2)
        part = unit - cell
        outside = ((part < 0) | (part > 1)).any(-1)
        part = torch.where(outside[:, None], torch.nan, part)
        both = torch.stack([1 - part, part], -1)
        weights = (both[:, 0, :, None, None] * both[:, 1, None, :, None] * both[:, 2, None, None, :]).flatten(1)
        a, b, c = cell.long().unbind(-1)
        steps = [(i * size[1] + j) * size[2] + k for i in (0, 1) for j in (0, 1) for k in (0, 1)]
        return ((a * size[1] + b) * size[2] + c)[:, None] + torch.stack(steps), weights

    def bounds(self, x: Float[Tensor, "S 3"]) -> tuple[Float[Tensor, "S"], Float[Tensor, "S"]]:
        r"""Smallest and largest distance that the field may have at points, metres; infinite where it is not known.

        \[ \tilde s(x) - \epsilon \le s(x) \le \tilde s(x) + \epsilon \]

        with the interpolated distance $\tilde s$ and the grid's error $\epsilon$; an example stands at `tabulate`.
        """
        middle = self.interpolate(x)
        unknown = middle.isnan()
        return (
            torch.where(unknown, -torch.inf, middle - self.error),
            torch.where(unknown, torch.inf, middle + self.error),
        )

    def arrays(self) -> tuple[np.ndarray, np.ndarray, np.float32, np.float32]:
        """The grid on the CPU as compiled loops take it: values, low, inverse spacing, error."""
        return self.values.numpy(), self.low.numpy(), np.float32(1 / self.voxel), np.float32(self.error)


@dataclass(frozen=True)
class GridNodes:
    """Nodes of a grid that lie near some points.

    Attributes:
        positions: of these, metres.
        flat: where each stands among all nodes of the grid.
        shape: nodes along each axis.
        low: the first node of the grid, metres.
        voxel: spacing, metres.
    """

    positions: Float[Tensor, "N 3"]
    flat: Int[Tensor, "N"]
    shape: tuple[int, int, int]
    low: Float[Tensor, "3"]
    voxel: float

    def filled(self, values: Float[Tensor, "N"], error: float) -> SdfGrid:
        """The grid with these distances at its nodes, metres."""
        whole = torch.full((self.shape[0] * self.shape[1] * self.shape[2],), UNKNOWN, device=values.device)
        whole[self.flat] = values.float()
        return SdfGrid(whole.reshape(self.shape), self.low, self.voxel, error)

    def near_surface(
        self, values: Float[Tensor, "N"], count: int, generator: torch.Generator
    ) -> Float[Tensor, "count 3"]:
        """Random places in cells that the surface may pass through, everywhere if there are none."""
        close = (values.abs() < 2 * self.voxel).nonzero()[:, 0]
        close = close if len(close) else torch.arange(len(values), device=values.device)
        chosen = close[torch.randint(len(close), (count,), generator=generator).to(values.device)]
        return self.positions[chosen] + self.voxel * (torch.rand(count, 3, generator=generator) - 0.5).to(values.device)


def grid_nodes(points: Float[Tensor, "n 3"], voxel: float, radius: float) -> GridNodes:
    """The nodes of a grid within `radius` (plus a cell's diagonal) of points, metres."""
    lattices, positions = build_lattices(points.detach().cpu().numpy().astype(np.float32), (voxel,), radius)
    device, shape = points.device, lattices.shape[0, :3].tolist()
    # Nodes far from the body share the first row.
    flat = (lattices.rows > 0).nonzero()[:, 0]
    at = torch.from_numpy(positions)[lattices.rows[flat].long()]
    low = lattices.place[0, :3].to(device)
    return GridNodes(at.to(device), flat.to(device), (shape[0], shape[1], shape[2]), low, voxel)


@torch.no_grad()
def tabulate(
    distance: Distance,
    points: Float[Tensor, "n 3"],
    voxel: float,
    radius: float,
    chunk: int = 65_536,
    trials: int = 4096,
    covered: float = 1.0,
) -> SdfGrid:
    r"""Queries a field at the nodes of a grid, and between some of them for the error of the interpolation.

    \[ \epsilon = \tfrac32 \max_t |\tilde s(x_t) - s(x_t)| \qquad \text{or} \qquad
        \epsilon = Q_q(|\tilde s(x_t) - s(x_t)|) \]

    over the places $x_t$ of the trials: of all of them, or of the share $q$ that is to be covered. Where the field
    exceeds the bound, a sample can be missed whose weight is near the least one that counts.

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
        trials: where the interpolation is tested: random places close to the surface.
        covered: share of these places at which the grid's error is to hold, $q$.
    """
    nodes = grid_nodes(points, voxel, radius)
    values = query_nodes(nodes, distance, chunk)
    grid = nodes.filled(values, 0.0)
    places = nodes.near_surface(values, trials, torch.Generator().manual_seed(0))
    wrong = differences(grid, distance, places)
    if len(wrong) == 0:
        return nodes.filled(values, torch.inf)
    return nodes.filled(values, float(1.5 * wrong.max() if covered == 1 else wrong.quantile(covered)))


@torch.no_grad()
def query_nodes(nodes: GridNodes, distance: Distance, chunk: int = 65_536) -> Float[Tensor, "N"]:
    """A field's signed distance at the nodes, metres; `chunk` of them are queried at once."""
    return torch.cat([distance(part) for part in nodes.positions.split(chunk)]).float()


@torch.no_grad()
def differences(grid: SdfGrid, distance: Distance, places: Float[Tensor, "n 3"]) -> Float[Tensor, "m"]:
    """By how much a grid is off at places, metres, where it is known."""
    middle = grid.interpolate(places)
    return (middle - distance(places))[~middle.isnan()].abs()
