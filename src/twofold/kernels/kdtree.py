"""Search trees for nearest points."""

import contextlib
import sys
from collections.abc import Generator

import numpy as np
import torch
from jaxtyping import Float, Int
from scipy.spatial import KDTree

from twofold.kernels.parallel import in_parts


@contextlib.contextmanager
def denormals_kept() -> Generator[None, None, None]:
    """Lets this thread tell the smallest numbers from zero for a while, whatever it did before."""
    flushed = sys.float_info.min * sys.float_info.epsilon * 1.0 == 0.0
    torch.set_flush_denormal(False)
    try:
        yield
    finally:
        torch.set_flush_denormal(flushed)


def search_tree(points: Float[np.ndarray, "n d"], quick: bool = False) -> KDTree:
    """SciPy's tree, built safely: where the smallest numbers count as zero, it splits a cell of zeros without end.

    A cell's upper half is to begin at the number next to zero, which then equals zero, so that it holds the whole cell
    again. Recursion of that kind does not raise; it kills the process.

    Args:
        points: what to search among.
        quick: built in less time, searched in a little more.
    """
    with denormals_kept():
        return KDTree(points, balanced_tree=not quick, compact_nodes=not quick)


def query_nearest(
    tree: KDTree, points: Float[np.ndarray, "n d"], k: int
) -> tuple[Float[np.ndarray, "n k"], Int[np.ndarray, "n k"]]:
    """Distances to the k nearest points of the tree and their indices, nearest first, on PyTorch's number of threads.

    SciPy's own threads (`workers`) are left to themselves when Ctrl-C arrives: they go on while the interpreter takes
    the tree away below them, and the process ends in a segmentation fault. Ours are waited for.

    Args:
        tree: see `search_tree`; holds at least k points.
        points: to find the neighbours of.
        k: how many.
    """
    distance, index = np.empty((len(points), k)), np.empty((len(points), k), np.int64)

    def search(begin: int, end: int) -> None:
        found = tree.query(points[begin:end], k=k)  # one column comes without its axis
        distance[begin:end], index[begin:end] = (np.reshape(part, (-1, k)) for part in found)

    in_parts(len(points), search)
    return distance, index
