"""The two-branch grid field as one differentiable operation on CPUs; `fused_kernels` has the loops."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import pad

from twofold.field import fused_kernels as kernels
from twofold.field import fused_lookup_kernels as lookups
from twofold.field.grids import Lattices
from twofold.kernels.lanes import QUAD
from twofold.kernels.parallel import in_parts
from twofold.kernels.row_gradient import RowGradient

_LAYERS = 6
"""Weight and bias of a net's three layers."""
Net = tuple[Tensor, Tensor, Tensor, Tensor, Tensor, Tensor]
"""Weight and bias of the first, second and last layer; the pose's part of the first bias included."""
Cotangents = tuple[Tensor | None, ...]
_NO_MARKS = np.zeros(0, np.uint8)


@dataclass(frozen=True)
class FusedField:
    """The parameters of a field with both branches at one pose, float32 on the CPU.

    Attributes:
        prior: signed distance to the body at the nodes of its lattices, metres; and, in a second column, how well the
            surface there was observed, which weakens the gate.
        low: feature table of the low branch; see `in_quads`.
        high: feature table of the high branch.
        lattices: of prior, low and high grid.
        nets: distance and colour network of the low branch, then of the high one.
        gate_width: metres; infinite for plain sums.
        rows: where the gradients of the low and the high table are added up, in place of ordinary ones.
    """

    prior: Float[Tensor, "N P"]
    low: Float[Tensor, "L C"]
    high: Float[Tensor, "H C"]
    lattices: tuple[Lattices, Lattices, Lattices]
    nets: tuple[Net, Net, Net, Net]
    gate_width: float
    rows: tuple[RowGradient | None, RowGradient | None] = (None, None)

    @torch.no_grad()
    def sdf(self, x: Float[Tensor, "S 3"]) -> Float[Tensor, "S"]:
        """Signed distance alone, metres; without gradients."""
        return self.prepared()(x)

    def prepared(self) -> Callable[[Float[Tensor, "S 3"]], Float[Tensor, "S"]]:
        """`sdf` for many small sets of points, while no parameter changes."""
        arrays = self.arrays()

        def sdf(x: Tensor) -> Tensor:
            out = torch.empty(len(x))
            given = (_array(x), *arrays, out.numpy())
            in_parts(len(x), lambda begin, end: kernels.distances(*given, begin, end), least=256)
            return out

        return sdf

    def colors(
        self, x: Float[Tensor, "S 3"], turn: Float[Tensor, "S 3 3"], law: Float[Tensor, "3 9"]
    ) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor, Tensor]:
        """Distances, colours, canonical gradients: s, c, g of the whole and s1, c1, g1 of the low branch.

        Differentiable by points and parameters but for the gradients, which are constants.

        Args:
            x: points of canonical space, metres.
            turn: turns canonical gradients into those of observation space.
            law: brightness by normal.
        """
        s, c, s1, c1, g, g1 = _Colors.apply(self, x, turn.detach(), law, *self.parameters())  # type: ignore[misc]
        return s, c, g, s1, c1, g1

    def distance_and_gradient(self, x: Float[Tensor, "S 3"]) -> tuple[Float[Tensor, "S"], Float[Tensor, "S 3"]]:
        """Signed distance and its canonical gradient, both differentiable; the gradient by parameters only."""
        return _Gradient.apply(self, x, *self.parameters())  # type: ignore[return-value]

    def parameters(self) -> tuple[Tensor, ...]:
        """Tables, then weights and biases of all nets."""
        return self.low, self.high, *(tensor for net in self.nets for tensor in net)

    def arrays(self) -> tuple[Any, Any, np.float32]:
        """Grids, nets and gate as the kernels take them."""
        tables = (self.prior, self.low, self.high)
        grids = tuple((_array(table), *grid.arrays) for table, grid in zip(tables, self.lattices, strict=True))
        nets = tuple(tuple(_array(tensor) for tensor in net) for net in self.nets)
        return grids, nets, np.float32(self.gate_width)


def in_quads(field: FusedField) -> FusedField:
    r"""The same field with features of zero added at each node, until they fill whole short vectors.

    \[ (F, 0) \cdot (w, 0) = F \cdot w \]

    >>> lattices = Lattices(torch.zeros(8, dtype=torch.int32), torch.ones(1, 4), torch.tensor([[2, 2, 2, 0]]))
    >>> net = (torch.ones(1, 3), torch.zeros(1), torch.ones(1, 1), torch.zeros(1), torch.ones(1, 1), torch.zeros(1))
    >>> table = torch.ones(1, 3)
    >>> wide = in_quads(FusedField(table[:, :1], table, table, (lattices,) * 3, (net,) * 4, 0.05))
    >>> wide.low.shape[1], wide.nets[0][0]
    (4, tensor([[1., 1., 1., 0.]]))
    """
    channels = field.low.shape[1]
    missing = -channels % QUAD
    if not missing:
        return field

    def widened(net: Net, levels: int) -> Net:
        weight, own = net[0], levels * channels
        features = pad(weight[:, :own].unflatten(1, (levels, channels)), (0, missing)).flatten(1)
        return (torch.cat([features, weight[:, own:]], 1), *net[1:])

    low, high = (len(lattices.place) for lattices in field.lattices[1:])
    nets = tuple(widened(net, levels) for net, levels in zip(field.nets, (low, low, high, high), strict=True))
    tables = (pad(table, (0, missing)) for table in (field.low, field.high))
    return FusedField(field.prior, *tables, field.lattices, nets, field.gate_width)  # type: ignore[arg-type]


class _Colors(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, field: FusedField, x: Tensor, turn: Tensor, law: Tensor, *parameters: Tensor) -> Any:  # type: ignore[override]
        count = len(x)
        s, s1, c, c1, g, g1 = (torch.empty(count, *size) for size in ((), (), (3,), (3,), (3,), (3,)))
        given = (_array(x), *field.arrays(), _array(turn), _array(law))
        out = tuple(tensor.numpy() for tensor in (s, s1, c, c1, g, g1))
        in_parts(count, lambda begin, end: kernels.forward(*given, *out, begin, end))
        ctx.field, ctx.given, ctx.slopes = field, given, (g, g1)
        ctx.save_for_backward(x, law, *parameters)  # notices a parameter that is changed before the reverse pass
        ctx.mark_non_differentiable(g, g1)
        return s, c, s1, c1, g, g1

    @staticmethod
    def backward(ctx: Any, *by: Tensor) -> Cotangents:
        _ = ctx.saved_tensors  # raises where a parameter has been changed since
        by_s, by_c, by_s1, by_c1 = (_array(cotangent) for cotangent in by[:4])
        slopes, cotangents = tuple(slope.numpy() for slope in ctx.slopes), (by_s, by_s1, by_c, by_c1)
        by_x, by_law, *rest = _by_values(ctx.field, ctx.given, slopes, cotangents, ctx.needs_input_grad[1])
        return None, by_x, None, by_law, *rest


class _Gradient(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, field: FusedField, x: Tensor, *parameters: Tensor) -> Any:  # type: ignore[override]
        s, g = torch.empty(len(x)), torch.empty(len(x), 3)
        given = (_array(x), *field.arrays())
        in_parts(len(x), lambda begin, end: kernels.distance_and_gradient(*given, s.numpy(), g.numpy(), begin, end))
        ctx.field, ctx.given = field, given
        ctx.save_for_backward(x, *parameters)
        ctx.set_materialize_grads(False)
        return s, g

    @staticmethod
    def backward(ctx: Any, *by: Tensor | None) -> Cotangents:
        _ = ctx.saved_tensors
        field, given, (by_s, by_g) = ctx.field, ctx.given, by
        by_x, found = None, list[Tensor | None]()
        if by_g is not None:
            found.extend(_by_slopes(field, given, _array(by_g)))
        if by_s is not None:
            none = np.zeros((len(by_s), 3), np.float32)
            more = (*given, np.zeros((len(by_s), 3, 3), np.float32), np.zeros((3, 9), np.float32))
            cotangents = (_array(by_s), none[:, 0].copy(), none, none)
            by_x, _, *values = _by_values(field, more, (none, none), cotangents, ctx.needs_input_grad[1])
            found = [_both(a, b) for a, b in zip(values, found, strict=True)] if found else values
        return None, by_x, *(found or [None] * len(field.parameters()))


def _by_values(
    field: FusedField, given: Any, slopes: tuple[np.ndarray, np.ndarray], cotangents: tuple[np.ndarray, ...], by_x: bool
) -> list[Any]:
    """Gradients by points (where wanted), law, tables and nets from those by s, s1, c and c1."""
    count, (_, *grids) = len(given[0]), given[1]
    features = [np.empty((count, table.shape[1] * len(place)), np.float32) for table, _, place, _ in grids]
    points = torch.empty(count, 3)

    def part(begin: int, end: int) -> tuple[np.ndarray, np.ndarray]:
        (by_nets, views), by_law = _zeros(field), np.zeros((3, 9), np.float32)
        kernels.backward(*given, *slopes, *cotangents, *features, points.numpy(), by_x, views, by_law, begin, end)
        return by_nets, by_law

    parts = in_parts(count, part)
    tables = _scattered(lookups.scatter, field, grids, given[0], [(u,) for u in features])
    by_law = _summed([law for _, law in parts])
    return [points if by_x else None, by_law, *tables, *_by_nets(field, [nets for nets, _ in parts])]


def _by_slopes(field: FusedField, given: Any, by_g: np.ndarray) -> list[Tensor | None]:
    """Gradients by tables and nets from those by the distance's gradient."""
    count, (_, *grids) = len(by_g), given[1]
    features = [np.empty((count, table.shape[1] * len(place)), np.float32) for table, _, place, _ in grids]
    pushed = np.empty((count, 3), np.float32)

    def part(begin: int, end: int) -> np.ndarray:
        by_nets, views = _zeros(field)
        kernels.gradient_backward(*given, by_g, *features, pushed, views, begin, end)
        return by_nets

    parts = in_parts(count, part)
    slopes = list(zip(features, (by_g, pushed), strict=True))
    tables = _scattered(lookups.scatter_slopes, field, grids, given[0], slopes)
    return [*tables, *_by_nets(field, parts)]


def _both(one: Tensor | None, other: Tensor | None) -> Tensor | None:
    return other if one is None else one if other is None else one + other


def _array(tensor: Tensor) -> np.ndarray:
    return tensor.detach().contiguous().numpy()


def _zeros(field: FusedField) -> tuple[np.ndarray, tuple[tuple[np.ndarray, ...], ...]]:
    """Room for the gradients of all nets in one array, and the places of weights and biases in it, net by net."""
    tensors = [tensor for net in field.nets for tensor in net]
    bounds = np.cumsum([0, *(tensor.numel() for tensor in tensors)]).tolist()
    room = np.zeros(bounds[-1], np.float32)
    places = zip(tensors, itertools.pairwise(bounds), strict=True)
    views = [room[begin:end].reshape(tensor.shape) for tensor, (begin, end) in places]
    return room, tuple(tuple(views[first : first + _LAYERS]) for first in range(0, len(views), _LAYERS))


def _summed(parts: list[np.ndarray]) -> Tensor:
    """In the order of the parts, so that a run repeats to the bit."""
    return torch.from_numpy(sum(parts[1:], start=parts[0]))


def _by_nets(field: FusedField, parts: list[np.ndarray]) -> list[Tensor]:
    tensors = [tensor for net in field.nets for tensor in net]
    sums = _summed(parts).split([tensor.numel() for tensor in tensors])
    return [own.view(tensor.shape) for own, tensor in zip(sums, tensors, strict=True)]


def _scattered(
    kernel: Callable[..., None], field: FusedField, grids: Any, x: np.ndarray, arrays: list[tuple[np.ndarray, ...]]
) -> list[Tensor | None]:
    """Gradients by both tables, None where they are added to `rows`; a level owns its rows: levels run side by side."""
    found, tasks = list[Tensor | None](), list[tuple[Any, int]]()
    for table, rows, grid, own in zip((field.low, field.high), field.rows, grids, arrays, strict=True):
        by_table = torch.zeros_like(table) if rows is None else None
        values, marks = (by_table.numpy(), _NO_MARKS) if rows is None else (rows.values, rows.marks)  # type: ignore[union-attr]
        given = (x, *own, grid, values, marks)
        tasks += [(given, level) for level in range(len(grid[2]))]
        found.append(by_table)

    def part(begin: int, end: int) -> None:
        for given, level in tasks[begin:end]:
            kernel(*given, level, level + 1)

    in_parts(len(tasks), part, least=1)
    return found
