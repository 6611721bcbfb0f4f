"""Compiled loops on several threads: the range is cut into as many parts as PyTorch uses threads."""

import inspect
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import lru_cache
from typing import Any

import numba
import torch


def compiled(function: Callable[..., Any]) -> Callable[..., Any]:
    """Compiles a loop over arrays; it lets go of the interpreter's lock, and the result is kept on disk.

    A function that another one wraps, as checks of shapes do in the tests, is compiled as it was written.
    """
    return numba.njit(cache=True, nogil=True)(inspect.unwrap(function))


@lru_cache(maxsize=4)
def _pool(threads: int) -> ThreadPoolExecutor:
    return ThreadPoolExecutor(threads, thread_name_prefix="twofold")


def in_parts(count: int, work: Callable[[int, int], object], least: int = 1024) -> list[object]:
    """Calls `work(begin, end)` on parts of 0..count, side by side; `work` must let go of the interpreter's lock.

    Args:
        count: size of the whole range.
        work: handles one part; parts must not write to the same memory.
        least: parts smaller than this are not worth a thread.

    Returns:
        what `work` gave for each part, in order.
    """
    threads = max(1, min(torch.get_num_threads(), count // max(least, 1)))
    if threads == 1:
        return [work(0, count)]
    bounds = [count * part // threads for part in range(threads + 1)]
    return list(_pool(threads).map(work, bounds[:-1], bounds[1:]))
