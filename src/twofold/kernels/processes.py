"""Sums over the processes that train together."""

from torch import Tensor, distributed


def summed_over_processes(values: Tensor) -> Tensor:
    """The sum over the processes that train together, in place and the same in each; of one process its own values."""
    if distributed.is_available() and distributed.is_initialized():
        distributed.all_reduce(values)
    return values
