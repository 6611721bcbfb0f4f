"""Adam for tables of which each row has means of its own, in one loop: only rows that a step sees are visited.

Such tables are small, and a step mostly sees one of their rows. In PyTorch, finding that row and moving it takes
ninety operations a table, and their overhead outweighs all arithmetic.
"""

# pyright: reportMissingParameterType=false

import math

import numpy as np
from jaxtyping import Float
from torch import Tensor

from twofold.kernels.parallel import compiled

_ZERO, _ONE, _TWO = np.float32(0), np.float32(1), np.float32(2)
_LEAST_RATIO = np.float32(1e-6)
_NO_SUMS = np.zeros((2, 0), np.float32)


def visited_rows(
    table: Float[Tensor, "rows *numbers"], first: Float[Tensor, "rows *numbers"],
    second: Float[Tensor, "rows *numbers"], gradient: Float[Tensor, "rows *numbers"], visits: Float[Tensor, "rows"],
    sums: Float[Tensor, "2 *entries"] | None, rate: float, betas: tuple[float, float], epsilon: float,
    shrinkage: float, pooled: float,
) -> None:  # fmt: skip
    r"""A step of Adam for the rows whose gradient is not all zero, each with its own number $n$ of visits.

    \[ n \leftarrow n + 1, \qquad m \leftarrow \beta_1 m + (1 - \beta_1) g, \qquad
    v \leftarrow \beta_2 v + (1 - \beta_2) g^2, \qquad
    \Delta = \frac{m}{1 - \beta_1^n} \Big/ \Big( \sqrt{\frac{v}{1 - \beta_2^n}} + \epsilon \Big) \]

    Without sums, $p \leftarrow p - \eta \Delta$. With them steps shrink, by the noise $s_n$ of the mean and the share
    $\kappa$ of signal, one for each entry of a row, which sums $(a, b)$ over recent visits of all rows tell:

    \[ (a, b) \leftarrow \Big( 1 - \min\Big( 1, \frac{b'}{N} \Big) \Big) (a, b) + (a', b'), \qquad
    \kappa = \frac{a}{b + 1}, \qquad
    p \leftarrow p - \eta \max\Big( 0, 1 - \frac{c}{1 + \kappa (1 / s_n - 1)} \Big) \Delta \]

    where $a'$ and $b'$ sum $w (\Delta^2 - s_n) / (1 - s_n)$ and $w = (s_\infty / s_n)^2$ over the numbers that have had
    a gradient, of all rows of this step with two visits or more, and are divided by the numbers of an entry. The
    equations and their reasons are those of `noise_share`, `signal_sums` and `shrink` in `twofold.training.row_adam`.

    >>> import torch
    >>> table = torch.ones(2, 1)
    >>> means, gradient = (torch.zeros(2, 1), torch.zeros(2, 1)), torch.tensor([[3.0], [0.0]])
    >>> visits = torch.zeros(2)
    >>> visited_rows(table, *means, gradient, visits, None, 0.5, (0.9, 0.99), 1e-15, 0.0, 64.0)
    >>> table[:, 0], visits
    (tensor([0.5000, 1.0000]), tensor([1., 0.]))

    Args:
        table: parameters; entries of a row, if it has any, come before the numbers of each, and a table of one
            dimension has rows of one number. Changed, as are the next two, `visits` and `sums`; all are contiguous.
        first: mean of the gradients.
        second: mean of their squares.
        gradient: of this step, in any order in memory.
        visits: $n$ of each row.
        sums: $(a, b)$ of each entry; None where steps do not shrink.
        rate: $\eta$.
        betas: how much of the means is kept.
        epsilon: added to the root.
        shrinkage: $c$.
        pooled: $N$, visits over which the share is averaged.
    """
    size = table.shape
    shape = (size[0], math.prod(size[1:-1]), size[-1] if len(size) > 1 else 1)
    p, m, v = (tensor.detach().numpy().reshape(shape) for tensor in (table, first, second))
    g = np.ascontiguousarray(gradient.detach().numpy()).reshape(shape)
    pool = _NO_SUMS if sums is None else sums.numpy().reshape(2, shape[1])
    beta1, beta2 = betas
    numbers = (rate, beta1, 1 - beta1, beta2, 1 - beta2, epsilon, (1 - beta1) / (1 + beta1), shrinkage, pooled)
    _visit(p, m, v, g, visits.numpy().reshape(len(p)), pool, *map(np.float32, numbers))


@compiled
def _visit(p, m, v, g, visits, sums, rate, beta1, rest1, beta2, rest2, epsilon, least, shrinkage, pooled):  # noqa: ANN001, ANN202
    """The step of `visited_rows`; tables are [rows entries numbers], and sums have no entries where nothing shrinks.

    `np.divide` gives what PyTorch gives where 0 is divided by 0; the operator would raise.
    """
    rows, entries, numbers = g.shape
    flat = g.reshape(rows, entries * numbers)
    seen, count = np.empty(rows, np.int64), 0
    for row in range(rows):
        found = False
        for at in range(flat.shape[1]):
            found |= flat[row, at] != _ZERO
        if found:
            seen[count] = row
            count += 1
    shrinks = sums.shape[1] > 0
    steps, noise = np.empty((count, entries, numbers), np.float32), np.empty(count, np.float32)
    new, known = np.zeros((2, sums.shape[1]), np.float32), False
    for which in range(count):
        row = seen[which]
        visits[row] += _ONE
        times = visits[row]
        bias1, bias2 = _ONE - beta1**times, _ONE - beta2**times
        s = np.divide(least * (_ONE - beta1 ** (_TWO * times)), bias1 * bias1)
        noise[which] = s
        tells = shrinks and times >= _TWO
        known |= tells
        ratio = np.divide(least, s)
        for entry in range(entries):
            for k in range(numbers):
                slope = g[row, entry, k]
                m[row, entry, k] = beta1 * m[row, entry, k] + rest1 * slope
                v[row, entry, k] = beta2 * v[row, entry, k] + rest2 * (slope * slope)
                root = np.sqrt(np.divide(v[row, entry, k], bias2)) + epsilon
                step = np.divide(np.divide(m[row, entry, k], bias1), root)
                steps[which, entry, k] = step
                if tells:
                    weight = ratio * ratio if step != _ZERO else _ZERO
                    new[0, entry] += weight * np.divide(step * step - s, _ONE - s)
                    new[1, entry] += weight
    # Of all rows of this step before any of them moves.
    if known:
        for entry in range(entries):
            signal, weight = new[0, entry] / np.float32(numbers), new[1, entry] / np.float32(numbers)
            kept = _ONE - weight / pooled
            # Not `max`, here and below: what is no number has to stay so.
            kept = _ZERO if kept < _ZERO else kept
            sums[0, entry] = sums[0, entry] * kept + signal
            sums[1, entry] = sums[1, entry] * kept + weight
    for which in range(count):
        row = seen[which]
        for entry in range(entries):
            factor = _ONE
            if shrinks:
                share = np.divide(sums[0, entry], sums[1, entry] + _ONE)
                ratio = _ONE + share * (np.divide(_ONE, noise[which]) - _ONE)
                ratio = _LEAST_RATIO if ratio < _LEAST_RATIO else ratio
                factor = _ONE - np.divide(shrinkage, ratio)
                factor = _ZERO if factor < _ZERO else factor
            for k in range(numbers):
                p[row, entry, k] -= rate * (steps[which, entry, k] * factor)
