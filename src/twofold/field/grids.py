"""Feature grids around the canonical body: a trilinear encoding whose coarse levels carry low frequencies only.

A level is a regular lattice of feature vectors, kept only at the nodes near the body. Its spacing bounds the
frequencies that it can hold just as the octaves of a Fourier encoding do (half a period per cell), and eight lookups
cost far less than a wide network.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int
from scipy import ndimage
from torch import Tensor, nn

from twofold.field import grid_kernels as kernels
from twofold.geometry.surfaces import nearest_vertices, vertex_normals
from twofold.kernels.parallel import in_parts
from twofold.kernels.row_gradient import RowGradient


@dataclass(frozen=True)
class Lattices:
    """Where the nodes of all levels lie.

    Attributes:
        rows: table row of every node, level after level; nodes far from the body share their level's first row.
        place: lower corner (metres) and inverse spacing (1 / metres) of each level.
        shape: nodes along each axis, and where the level begins in `rows`.
    """

    rows: Int[Tensor, "nodes"]
    place: Float[Tensor, "L 4"]
    shape: Int[Tensor, "L 4"]

    @property
    def arrays(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Rows, place and shape on the CPU as compiled loops take them."""
        return self.rows.numpy(), self.place.numpy(), self.shape.numpy()


def build_lattices(
    points: Float[np.ndarray, "n 3"],
    voxels: tuple[float, ...],
    radius: float | Sequence[float],
    by_level: Sequence[Float[np.ndarray, "_ 3"]] | None = None,
) -> tuple[Lattices, Float[np.ndarray, "N 3"]]:
    r"""The nodes within `radius` metres (plus a cell's diagonal) of surface points, for each spacing.

    Node $i$ of a level with the corner $l$ and the spacing $h$ lies at $l + h \, i$; kept are those with
    $\min_p \lVert l + h i - p \rVert \le r + (1 + \sqrt 3) h$ of a point's nearest node.

    >>> lattices, positions = build_lattices(np.zeros((1, 3), np.float32), (0.1, 0.05), radius=0.02)
    >>> lattices.place[:, 3], len(positions) == int(lattices.rows.max()) + 1
    (tensor([10., 20.]), True)

    Args:
        points: of the surface, metres.
        voxels: spacing of each level, metres.
        radius: how far from the points features exist, metres; of all levels, or of each.
        by_level: points of each level, where they differ: a level may cover some parts of the body only.

    Returns:
        the lattices, and the position of each table row (a level's first row stands for everywhere else).
    """
    rows, places, shapes, positions = [], [], [], []
    count = begin = 0
    alike = by_level is None and isinstance(radius, float | int)
    for level, voxel in enumerate(voxels):
        points = points if by_level is None else by_level[level]
        own = radius if isinstance(radius, float | int) else radius[level]
        reach = own + np.sqrt(3) * voxel
        # Of a level that ends before others two more layers, which hold no nodes: what lies outside of the lattice is
        # everywhere else there, too.
        more = 0.0 if alike else 2 * voxel
        # In this order: stored features belong to rows that another rounding would change.
        low = points.min(0) - reach - voxel - more
        shape = np.ceil((points.max(0) + reach + voxel + more - low) / voxel).astype(int) + 1
        empty = np.ones(shape, dtype=bool)
        empty[tuple(np.round((points - low) / voxel).astype(int).T)] = False
        away = np.asarray(ndimage.distance_transform_edt(empty))
        nodes = np.argwhere(away * voxel <= reach + voxel)
        row = np.full(shape, count, dtype=np.int32)
        row[tuple(nodes.T)] = np.arange(count + 1, count + 1 + len(nodes), dtype=np.int32)
        rows.append(row.ravel())
        places.append([*low, 1 / voxel])
        shapes.append([*shape, begin])
        positions.extend([points.mean(0, keepdims=True), low + nodes * voxel])
        count += len(nodes) + 1
        begin += row.size
    lattices = Lattices(
        rows=torch.from_numpy(np.concatenate(rows)),
        place=torch.tensor(np.array(places), dtype=torch.float32),
        shape=torch.tensor(np.array(shapes), dtype=torch.int64),
    )
    return lattices, np.concatenate(positions).astype(np.float32)


def corners(x: Float[Tensor, "S 3"], lattices: Lattices, level: int) -> tuple[Int[Tensor, "S 8"], Float[Tensor, "S 3"]]:
    r"""Table rows of the eight nodes around each point, and its position in the cell (0..1), in PyTorch.

    \[ u = (x - l) / h, \qquad \text{cell } \lfloor u \rfloor, \quad \text{position } u - \lfloor u \rfloor \]

    >>> lattices, positions = build_lattices(np.zeros((1, 3), np.float32), (0.1,), radius=0.2)
    >>> rows, part = corners(torch.tensor([[0.03, 0.0, 0.0]]), lattices, 0)
    >>> nodes = torch.from_numpy(positions)[rows[0]]
    >>> nodes.amin(0) + 0.1 * part[0]  # the lowest corner and the way from it give the point back
    tensor([0.0300, 0.0000, 0.0000])
    """
    shape = lattices.shape[level]
    unit = (x - lattices.place[level, :3].to(x.dtype)) * lattices.place[level, 3].to(x.dtype)
    unit = torch.minimum(unit.clamp_min(0), shape[:3].to(x.dtype) - 1.001)
    cell = unit.floor()
    whole = cell.long()
    base = shape[3] + (whole[:, 0] * shape[1] + whole[:, 1]) * shape[2] + whole[:, 2]
    offsets = torch.stack([(a * shape[1] + b) * shape[2] + c for a in (0, 1) for b in (0, 1) for c in (0, 1)])
    return lattices.rows[base[:, None] + offsets].long(), unit - cell


def interpolate_in_torch(
    table: Float[Tensor, "N C"], x: Float[Tensor, "S 3"], lattices: Lattices
) -> Float[Tensor, "S LC"]:
    r"""`interpolate` by ordinary PyTorch operations, with all derivatives: for GPUs, and the compiled form's twin.

    The weight of corner $k$ is $\prod_i (1 - u_i)^{1 - k_i} u_i^{k_i}$.

    >>> lattices, positions = build_lattices(np.zeros((1, 3), np.float32), (0.1,), radius=0.2)
    >>> x = torch.tensor([[0.03, -0.02, 0.11]])
    >>> torch.allclose(interpolate_in_torch(torch.from_numpy(positions), x, lattices), x, atol=1e-6)
    True
    """
    features = []
    for level in range(len(lattices.place)):
        index, part = corners(x, lattices, level)
        both = torch.stack([1 - part, part], -1)
        xy = both[:, 0, :, None] * both[:, 1, None, :]
        weights = (xy[..., None] * both[:, 2, None, None, :]).flatten(1)
        features.append((weights[..., None] * table[index]).sum(1))
    return torch.cat(features, -1)


def pullback_in_torch(
    table: Float[Tensor, "N C"], x: Float[Tensor, "S 3"], cotangent: Float[Tensor, "S LC"], lattices: Lattices
) -> Float[Tensor, "S 3"]:
    r"""`interpolation_pullback` by ordinary PyTorch operations.

    \[ (J^\top u)_i = \sum_k (F_k \cdot u) \, \frac{\partial}{\partial x_i} \prod_j (1 - t_j)^{1 - k_j} t_j^{k_j} \]

    with the position $t$ in the cell.

    >>> lattices, positions = build_lattices(np.zeros((1, 3), np.float32), (0.1,), radius=0.2)
    >>> u = torch.tensor([[1.0, 2.0, 3.0]])
    >>> pullback_in_torch(torch.from_numpy(positions), torch.tensor([[0.03, -0.02, 0.11]]), u, lattices)
    tensor([[1.0000, 2.0000, 3.0000]])
    """
    total = torch.zeros_like(x)
    for level, u in enumerate(cotangent.chunk(len(lattices.place), -1)):
        index, part = corners(x.detach(), lattices, level)
        along = (table[index] * u[:, None]).sum(-1).unflatten(-1, (2, 2, 2))
        both = torch.stack([1 - part, part], -1)
        slope = torch.tensor([-1.0, 1.0], dtype=x.dtype, device=x.device) * lattices.place[level, 3].to(x.dtype)
        slope = slope.expand(len(x), 2)
        gradients = []
        for axis in range(3):
            factors = [slope if a == axis else both[:, a] for a in range(3)]
            gradients.append(torch.einsum("sabc,sa,sb,sc->s", along, *factors))
        total = total + torch.stack(gradients, -1)
    return total


class _Interpolate(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, table: Tensor, x: Tensor, lattices: Lattices) -> Tensor:  # type: ignore[override]
        ctx.save_for_backward(table, x)
        ctx.lattices = lattices
        out = np.empty((len(x), table.shape[1] * len(lattices.place)), dtype=np.float32)
        given = (x.detach().contiguous().numpy(), table.detach().numpy(), *lattices.arrays, out)
        in_parts(len(x), lambda begin, end: kernels.interpolate(*given, begin, end))
        return torch.from_numpy(out)

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, Tensor | None, None]:  # type: ignore[override]
        table, x = ctx.saved_tensors
        points, slopes, arrays = x.contiguous().numpy(), gradient.contiguous().numpy(), ctx.lattices.arrays
        by_table = by_x = None
        if ctx.needs_input_grad[0]:
            by_table = torch.zeros_like(table)
            given = (points, slopes, *arrays, by_table.numpy())
            in_parts(len(ctx.lattices.place), lambda begin, end: kernels.scatter(*given, begin, end), least=1)
        if ctx.needs_input_grad[1]:
            by_x = torch.empty_like(x)
            more = (points, table.detach().numpy(), slopes, *arrays, by_x.numpy())
            in_parts(len(x), lambda begin, end: kernels.pull(*more, begin, end))
        return by_table, by_x, None


class _Pullback(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, table: Tensor, x: Tensor, cotangent: Tensor, lattices: Lattices) -> Tensor:  # type: ignore[override]
        x, cotangent = x.detach().contiguous(), cotangent.detach().contiguous()
        ctx.save_for_backward(table, x, cotangent)
        ctx.lattices = lattices
        out = torch.empty(len(x), 3)
        given = (x.numpy(), table.detach().numpy(), cotangent.numpy(), *lattices.arrays, out.numpy())
        in_parts(len(x), lambda begin, end: kernels.pull(*given, begin, end))
        return out

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, None, Tensor | None, None]:  # type: ignore[override]
        table, x, cotangent = ctx.saved_tensors
        arrays, slopes = ctx.lattices.arrays, gradient.contiguous().numpy()
        by_table = by_cotangent = None
        if ctx.needs_input_grad[0]:
            by_table = torch.zeros_like(table)
            given = (x.numpy(), cotangent.numpy(), slopes, *arrays, by_table.numpy())
            in_parts(len(ctx.lattices.place), lambda begin, end: kernels.pull_scatter(*given, begin, end), least=1)
        if ctx.needs_input_grad[2]:
            by_cotangent = torch.empty_like(cotangent)
            more = (x.numpy(), table.detach().numpy(), slopes, *arrays, by_cotangent.numpy())
            in_parts(len(x), lambda begin, end: kernels.push(*more, begin, end))
        return by_table, None, by_cotangent, None


def interpolate(table: Float[Tensor, "N C"], x: Float[Tensor, "S 3"], lattices: Lattices) -> Float[Tensor, "S LC"]:
    r"""Trilinear features of all levels side by side; differentiable by the table and by the points.

    \[ f(x) = \sum_{k \in \{0,1\}^3} F_k \prod_{i=1}^3 (1 - u_i)^{1 - k_i} \, u_i^{k_i} \]

    with the position $u$ in the cell and the features $F_k$ at its corners.

    >>> lattices, positions = build_lattices(np.zeros((1, 3), np.float32), (0.1,), radius=0.2)
    >>> table = torch.from_numpy(positions)  # each node's feature is its own place, which is linear
    >>> interpolate(table, torch.tensor([[0.03, -0.02, 0.11]]), lattices)
    tensor([[ 0.0300, -0.0200,  0.1100]])

    Args:
        table: a feature vector for each row.
        x: points, metres.
        lattices: where the nodes of the table's rows lie.
    """
    if table.dtype != torch.float32 or table.is_cuda:
        return interpolate_in_torch(table, x, lattices)
    return _Interpolate.apply(table, x, lattices)  # type: ignore[return-value]


def interpolation_pullback(
    table: Float[Tensor, "N C"], x: Float[Tensor, "S 3"], cotangent: Float[Tensor, "S LC"], lattices: Lattices
) -> Float[Tensor, "S 3"]:
    r"""$J^\top u$ with the Jacobian $J$ of `interpolate` by the points: the last step of a gradient's reverse pass.

    The derivative of a factor $1 - u_i$ or $u_i$ is $\mp 1 / h$.

    >>> lattices, positions = build_lattices(np.zeros((1, 3), np.float32), (0.1,), radius=0.2)
    >>> table, u = torch.from_numpy(positions), torch.tensor([[1.0, 2.0, 3.0]])
    >>> interpolation_pullback(table, torch.tensor([[0.03, -0.02, 0.11]]), u, lattices)
    tensor([[1.0000, 2.0000, 3.0000]])

    Differentiable by the table and the cotangent, so a loss on the gradient trains both; the points count as constants.
    """
    if table.dtype != torch.float32 or table.is_cuda:
        return pullback_in_torch(table, x, cotangent, lattices)
    return _Pullback.apply(table, x, cotangent, lattices)  # type: ignore[return-value]


class FeatureGrid(nn.Module):
    """Several lattices around a canonical body with one feature table, trainable or given."""

    def __init__(
        self, points: Float[np.ndarray, "n 3"], voxels: tuple[float, ...], features: int,
        radius: float | Sequence[float], generator: torch.Generator | None = None,
        by_level: Sequence[Float[np.ndarray, "_ 3"]] | None = None,
    ) -> None:  # fmt: skip
        """Features near zero at the nodes within `radius` metres of `points`, or of those of each level."""
        super().__init__()
        lattices, _ = build_lattices(points, voxels, radius, by_level)
        # Rebuilt from the body when a run is loaded, hence not part of its state.
        self.register_buffer("rows", lattices.rows, persistent=False)
        self.register_buffer("place", lattices.place, persistent=False)
        self.register_buffer("shape", lattices.shape, persistent=False)
        count = int(lattices.rows.max()) + 1
        self.table = nn.Parameter((torch.rand(count, features, generator=generator) - 0.5) * 2e-3)
        self.size = features * len(voxels)
        self.row_gradient: RowGradient | None = None
        """Where compiled loops add up the table's gradient while it is trained with `RowAdam`."""

    @property
    def lattices(self) -> Lattices:
        """Where its nodes lie."""
        return Lattices(self.get_buffer("rows"), self.get_buffer("place"), self.get_buffer("shape"))

    def forward(self, x: Float[Tensor, "S 3"]) -> Float[Tensor, "S LC"]:
        """Features at points of canonical space."""
        return interpolate(self.table, x, self.lattices)

    def pullback(self, x: Float[Tensor, "S 3"], cotangent: Float[Tensor, "S LC"]) -> Float[Tensor, "S 3"]:
        """J^T u of `forward`; see `interpolation_pullback`."""
        return interpolation_pullback(self.table, x, cotangent, self.lattices)


def body_distance(
    points: Float[np.ndarray, "n 3"], vertices: Float[np.ndarray, "V 3"], faces: Int[np.ndarray, "F 3"]
) -> Float[np.ndarray, "n"]:
    r"""Approximate signed distance to a body, metres, negative inside.

    The offsets to the nearest vertices, projected on their normals and averaged: exact to a few millimetres near the
    surface, which is all that a prior needs.

    \[ d(x) \approx \sum_k w_k \, (x - v_k) \cdot n_k \, \Big/ \sum_k w_k, \qquad w_k = 1 / \lVert x - v_k \rVert^2 \]

    within 2 cm; further out its sign times the distance to the nearest vertex.

    >>> corner = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], np.float32)
    >>> faces = np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])
    >>> body_distance(np.array([[2.0, 0, 0], [0.2, 0.2, 0.2]], np.float32), corner, faces).round(2)
    array([ 1.  , -0.35], dtype=float32)
    """
    x, corners = torch.from_numpy(points), torch.from_numpy(vertices)
    distance, nearest = nearest_vertices(x, corners, k=min(6, len(corners)))
    normals = vertex_normals(corners, torch.from_numpy(faces))
    along = ((x[:, None] - corners[nearest]) * normals[nearest]).sum(-1)
    weights = 1 / distance.clamp_min(1e-4) ** 2
    mean = (along * weights).sum(-1) / weights.sum(-1)
    # Close to the surface the projection is the distance; further out the nearest vertex says how far.
    far = mean.sign() * distance[:, 0]
    return torch.where(distance[:, 0] < 0.02, mean, far).float().numpy()
