"""Search trees for nearest points."""

import contextlib
import sys
from collections.abc import Generator

import numpy as np
import torch
from jaxtyping import Float
from scipy.spatial import KDTree


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
