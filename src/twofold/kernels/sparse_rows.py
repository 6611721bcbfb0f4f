"""Weighted sums of table rows: one primitive behind skinning and feature grids.

`out[s] = sum_k weights[s, k] * table[index[s, k]]` is the product of a sparse matrix with the table, and its gradient
the product with the transpose. Autograd's own gradient scatters row by row; on a CPU SciPy's transposed product is five
to ten times faster, and it sums in a fixed order, so a run repeats to the bit.
"""

from typing import Any

import numpy as np
import scipy.sparse
import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn import functional as F


class _WeightedRows(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, table: Tensor, index: Tensor, weights: Tensor) -> Tensor:  # type: ignore[override]
        ctx.save_for_backward(index, weights)
        ctx.rows = table.shape[0]
        if index.shape[1] == 1:
            return table[index[:, 0]] * weights
        return F.embedding_bag(index, table, mode="sum", per_sample_weights=weights)

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, None, None]:  # type: ignore[override]
        index, weights = ctx.saved_tensors
        return scatter_rows(gradient, index, weights, ctx.rows), None, None


def scatter_rows(
    values: Float[Tensor, "S C"], index: Int[Tensor, "S K"], weights: Float[Tensor, "S K"], rows: int
) -> Float[Tensor, "rows C"]:
    """The transpose of `weighted_rows`: each value added, weighted, to the K rows that it came from."""
    if values.is_cuda:
        spread = (weights[..., None] * values[:, None]).flatten(0, 1)
        return torch.zeros(rows, values.shape[1], dtype=values.dtype, device=values.device).index_add_(
            0, index.flatten(), spread
        )
    samples, k = index.shape
    matrix = scipy.sparse.csr_matrix(
        (weights.numpy().ravel(), index.numpy().ravel(), np.arange(0, samples * k + 1, k, dtype=np.int32)),
        shape=(samples, rows),
    )
    return torch.from_numpy(np.ascontiguousarray(matrix.T @ values.contiguous().numpy()))


def weighted_rows(
    table: Float[Tensor, "N C"], index: Int[Tensor, "S K"], weights: Float[Tensor, "S K"]
) -> Float[Tensor, "S C"]:
    """Weighted sum of K table rows for each sample.

    Differentiable by `table` only: `index` and `weights` count as constants.

    >>> weighted_rows(torch.tensor([[1.0], [10.0]]), torch.tensor([[0, 1]]), torch.tensor([[0.5, 0.2]]))
    tensor([[2.5000]])
    """
    return _WeightedRows.apply(table, index, weights.detach())  # type: ignore[return-value]
