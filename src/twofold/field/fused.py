"""The two-branch grid field as one differentiable operation on CPUs; `fused_kernels` has the loops."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from twofold.field import fused_kernels as kernels
from twofold.field import grid_kernels
from twofold.field.grids import Lattices
from twofold.kernels.parallel import in_parts

_LAYERS = 6
"""Weight and bias of a net's three layers."""
Net = tuple[Tensor, Tensor, Tensor, Tensor, Tensor, Tensor]
"""Weight and bias of the first, second and last layer; the pose's part of the first bias included."""
Cotangents = tuple[Tensor | None, ...]


@dataclass(frozen=True)
class FusedField:
    """The parameters of a field with both branches at one pose, float32 on the CPU.

    Attributes:
        prior: signed distance to the body at the nodes of its lattices, metres; and, in a second column, how well the
            surface there was observed, which weakens the gate.
        low: feature table of the low branch.
        high: feature table of the high branch.
        lattices: of prior, low and high grid.
        nets: distance and colour network of the low branch, then of the high one.
        gate_width: metres; infinite for plain sums.
    """

    prior: Float[Tensor, "N P"]
    low: Float[Tensor, "L C"]
    high: Float[Tensor, "H C"]
    lattices: tuple[Lattices, Lattices, Lattices]
    nets: tuple[Net, Net, Net, Net]
    gate_width: float

    @torch.no_grad()
    def sdf(self, x: Float[Tensor, "S 3"]) -> Float[Tensor, "S"]:
        """Signed distance alone, metres; without gradients."""
        out = torch.empty(len(x))
        given = (_array(x), *self.arrays(), out.numpy())
        in_parts(len(x), lambda begin, end: kernels.distances(*given, begin, end))
        return out

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
        grids = tuple(
            (_array(table), *(_array(tensor) for tensor in (lattice.rows, lattice.place, lattice.shape)))
            for table, lattice in zip((self.prior, self.low, self.high), self.lattices, strict=True)
        )
        nets = tuple(tuple(_array(tensor) for tensor in net) for net in self.nets)
        return grids, nets, np.float32(self.gate_width)


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
        by_x, found = None, list[Tensor]()
        if by_g is not None:
            found.extend(_by_slopes(field, given, _array(by_g)))
        if by_s is not None:
            none = np.zeros((len(by_s), 3), np.float32)
            more = (*given, np.zeros((len(by_s), 3, 3), np.float32), np.zeros((3, 9), np.float32))
            cotangents = (_array(by_s), none[:, 0].copy(), none, none)
            by_x, _, *values = _by_values(field, more, (none, none), cotangents, ctx.needs_input_grad[1])
            found = [a + b for a, b in zip(values, found, strict=True)] if found else values
        return None, by_x, *(found or [None] * len(field.parameters()))


def _by_values(
    field: FusedField, given: Any, slopes: tuple[np.ndarray, np.ndarray], cotangents: tuple[np.ndarray, ...], by_x: bool
) -> list[Any]:
    """Gradients by points (where wanted), law, tables and nets from those by s, s1, c and c1."""
    count = len(given[0])
    by_low, by_high = (torch.empty(count, table.shape[1] * len(at.place)) for table, at in _grids(field))
    by_prior = torch.empty(count)
    stored = (by_low.numpy(), by_high.numpy(), by_prior.numpy())

    def part(begin: int, end: int) -> tuple[list[tuple[np.ndarray, ...]], np.ndarray]:
        by_nets, by_law = _zeros(field), np.zeros((3, 9), np.float32)
        kernels.backward(*given, *slopes, *cotangents, *stored, tuple(by_nets), by_law, begin, end)
        return by_nets, by_law

    parts = in_parts(count, part)
    points = _by_points(field, given[0], by_low, by_high, by_prior) if by_x else None
    tables = [
        _scattered(grid_kernels.scatter, table, at, given[0], u.numpy())
        for (table, at), u in zip(_grids(field), (by_low, by_high), strict=True)
    ]
    return [points, _summed([law for _, law in parts]), *tables, *_by_nets([nets for nets, _ in parts])]


def _by_slopes(field: FusedField, given: Any, by_g: np.ndarray) -> list[Tensor]:
    """Gradients by tables and nets from those by the distance's gradient."""
    count = len(by_g)
    low, high = (np.empty((count, table.shape[1] * len(at.place)), np.float32) for table, at in _grids(field))
    pushed = np.empty((count, 3), np.float32)

    def part(begin: int, end: int) -> list[tuple[np.ndarray, ...]]:
        by_nets = _zeros(field)
        kernels.gradient_backward(*given, by_g, low, high, pushed, tuple(by_nets), begin, end)
        return by_nets

    parts = in_parts(count, part)
    tables = [
        _scattered(grid_kernels.pull_scatter, table, at, given[0], cotangent, slope)
        for (table, at), cotangent, slope in zip(_grids(field), (low, high), (by_g, pushed), strict=True)
    ]
    return [*tables, *_by_nets(parts)]


def _array(tensor: Tensor) -> np.ndarray:
    return tensor.detach().contiguous().numpy()


def _grids(field: FusedField) -> tuple[tuple[Tensor, Lattices], tuple[Tensor, Lattices]]:
    return (field.low, field.lattices[1]), (field.high, field.lattices[2])


def _zeros(field: FusedField) -> list[tuple[np.ndarray, ...]]:
    """Room for the gradients of all nets."""
    return [tuple(np.zeros(tuple(tensor.shape), np.float32) for tensor in net) for net in field.nets]


def _summed(parts: list[np.ndarray]) -> Tensor:
    """In the order of the parts, so that a run repeats to the bit."""
    return torch.from_numpy(sum(parts[1:], start=parts[0]))


def _by_nets(parts: list[list[tuple[np.ndarray, ...]]]) -> list[Tensor]:
    return [_summed([part[net][k] for part in parts]) for net in range(4) for k in range(_LAYERS)]


def _scattered(kernel: Callable[..., None], table: Tensor, at: Lattices, *arrays: np.ndarray) -> Tensor:
    """Gradient by a table; a level owns its rows, so levels run side by side."""
    by_table = torch.zeros_like(table)
    given = (*arrays, *(_array(tensor) for tensor in (at.rows, at.place, at.shape)), by_table.numpy())
    in_parts(len(at.place), lambda begin, end: kernel(*given, begin, end), least=1)
    return by_table


def _by_points(field: FusedField, x: np.ndarray, low: Tensor, high: Tensor, prior: Tensor) -> Tensor:
    """Gradient by the points from those by all features."""
    total = torch.zeros(len(x), 3)
    # What was observed weakens the gate as a constant.
    prior = torch.nn.functional.pad(prior[:, None], (0, field.prior.shape[1] - 1))
    tables = (field.low, field.high, field.prior)
    lattices = (field.lattices[1], field.lattices[2], field.lattices[0])
    for table, at, cotangent in zip(tables, lattices, (low, high, prior), strict=True):
        out = torch.empty_like(total)
        arrays = (x, _array(table), cotangent.numpy(), *(_array(t) for t in (at.rows, at.place, at.shape)), out.numpy())
        in_parts(len(x), lambda begin, end, a=arrays: grid_kernels.pull(*a, begin, end))
        total += out
    return total
