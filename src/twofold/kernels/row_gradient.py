"""Gradients of tables of which a training step looks at few rows: kept between steps, and only those rows are visited.

A feature grid has millions of rows and a step touches some ten thousands. An ordinary gradient would be as large as the
table, filled with zeros and added up anew at each step.
"""

# pyright: reportMissingParameterType=false

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from twofold.kernels.lanes import LANES, fill, load, minus, over_root, scaled, scaled_plus, store, times_plus
from twofold.kernels.parallel import compiled, in_parts

NEVER, BEFORE, NOW = 0, 1, 2
"""A row that had no gradient yet; that had one in an earlier step; that has one in this step."""
_ZERO = np.float32(0)


@dataclass(frozen=True)
class RowGradient:
    """The gradient of a table, added up by compiled loops.

    Attributes:
        values: the gradient; zero in rows that are not marked `NOW`.
        marks: of each row `NEVER`, `BEFORE` or `NOW`.
    """

    values: Float[np.ndarray, "N C"]
    marks: np.ndarray

    @classmethod
    def of(cls, table: Float[Tensor, "N C"]) -> "RowGradient":
        """No gradient yet, for a table."""
        return cls(np.zeros(tuple(table.shape), np.float32), np.zeros(len(table), np.uint8))

    def add(self, gradient: Float[Tensor, "N C"]) -> None:
        """Adds an ordinary gradient."""
        values = gradient.detach().numpy()
        self.values[:] += values
        self.marks[values.any(1)] = NOW

    def know(self, squares: Float[Tensor, "N C"]) -> None:
        """Takes the rows that have had a gradient from Adam's mean squares; none has one now."""
        self.values[:] = 0
        self.marks[:] = np.where(squares.detach().numpy().any(1), BEFORE, NEVER)


@torch.no_grad()
def adam_rows(
    table: Float[Tensor, "N C"], first: Float[Tensor, "N C"], second: Float[Tensor, "N C"], gradient: RowGradient,
    rate: float, step: int, betas: tuple[float, float], epsilon: float,
) -> None:  # fmt: skip
    r"""A step of Adam for the rows that have, or had, a gradient; the gradient is zero afterwards.

    \[ m \leftarrow m + (1 - \beta_1)(g - m), \qquad v \leftarrow \beta_2 v + (1 - \beta_2) g^2, \qquad
    p \leftarrow p - \frac{\eta}{1 - \beta_1^t} \, \frac{m}{\sqrt{v} / \sqrt{1 - \beta_2^t} + \epsilon} \]

    (Kingma and Ba, 2015). For all other rows m and v are zero and nothing changes, so this is Adam, not an
    approximation of it.

    >>> table = torch.ones(2, 1)
    >>> gradient = RowGradient.of(table)
    >>> gradient.add(torch.tensor([[3.0], [0.0]]))
    >>> adam_rows(table, torch.zeros(2, 1), torch.zeros(2, 1), gradient, 0.5, 1, (0.9, 0.99), 1e-15)
    >>> table[:, 0], gradient.values[:, 0]
    (tensor([0.5000, 1.0000]), array([0., 0.], dtype=float32))

    Args:
        table: parameters; changed.
        first: mean of the gradients; changed.
        second: mean of their squares; changed.
        gradient: of this step.
        rate: learning rate.
        step: number of this step, from 1 on.
        betas: how much of the means is kept.
        epsilon: added to the root.
    """
    size, root = rate / (1 - betas[0] ** step), (1 - betas[1] ** step) ** 0.5
    numbers = (np.float32(value) for value in (size, 1 - betas[0], betas[1], 1 - betas[1], root, epsilon))
    arrays = [t.detach().numpy().reshape(1, -1) for t in (table, first, second)]
    given = (*arrays, gradient.values.reshape(1, -1), gradient.marks, table.shape[1], *numbers)
    blocks = -(-len(table) // LANES)
    in_parts(blocks, lambda begin, end: _adam_blocks(*given, begin, end), least=4096)


@compiled
def _adam_blocks(p, m, v, g, marks, width, size, rest1, beta2, rest2, root, epsilon, begin, end):  # noqa: ANN001, ANN202
    """Steps of the rows of some blocks of sixteen; all arrays but `marks` flat, [1 NC].

    Rows beside each other are nodes beside each other, which mostly all have a gradient or none. So a block is updated
    as a whole, which leaves its rows without one as they are.
    """
    scale = np.float32(1) / root
    for block in range(begin, end):
        first, last = block * LANES, min((block + 1) * LANES, marks.shape[0])
        mark = 0
        for row in range(first, last):
            mark |= marks[row]
        if mark == 0:
            continue
        if last - first == LANES:
            for at in range(first * width, last * width, LANES):
                slope = load(g, 0, at)
                mean = scaled_plus(rest1, minus(slope, load(m, 0, at)), load(m, 0, at))
                square = scaled_plus(beta2, load(v, 0, at), scaled(rest2, times_plus(slope, slope, fill(_ZERO))))
                store(m, 0, at, mean)
                store(v, 0, at, square)
                store(p, 0, at, scaled_plus(-size, over_root(mean, square, scale, epsilon), load(p, 0, at)))
                store(g, 0, at, fill(_ZERO))
        else:
            for at in range(first * width, last * width):
                m[0, at] += rest1 * (g[0, at] - m[0, at])
                v[0, at] = v[0, at] * beta2 + rest2 * g[0, at] * g[0, at]
                p[0, at] -= size * m[0, at] / (np.sqrt(v[0, at]) * scale + epsilon)
                g[0, at] = _ZERO
        for row in range(first, last):
            marks[row] = min(marks[row], BEFORE)
