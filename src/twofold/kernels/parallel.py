"""Compiled loops on several threads: the range is cut into as many parts as PyTorch uses threads."""

import contextlib
import inspect
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import lru_cache
from typing import Any, TypeVar, final

import numba
import torch
from numba.core.caching import FunctionCache

Result = TypeVar("Result")
_OPTIONS: dict[str, Any] = {"nogil": True, "no_cfunc_wrapper": True}
"""Without the interpreter's lock; nothing calls a loop from C."""
_PART_OPTIONS: dict[str, Any] = {**_OPTIONS, "no_cpython_wrapper": True}


def compiled(function: Callable[..., Any]) -> Callable[..., Any]:
    """Compiles a loop over arrays; it lets go of the interpreter's lock, and the result is kept on disk.

    A function that another one wraps, as checks of shapes do in the tests, is compiled as it was written.
    """
    return _kept(numba.njit(**_OPTIONS)(inspect.unwrap(function)))


def compiled_part(function: Callable[..., Any]) -> Callable[..., Any]:
    """Compiles what only other compiled loops call, without a way in from Python.

    That way takes longer to compile than many a loop, where arguments are tuples of arrays.
    """
    return _kept(numba.njit(**_PART_OPTIONS)(inspect.unwrap(function)))


def _kept(kernel: Any) -> Any:
    # Without any folder to keep results in, numba raises; compiling anew in each process takes some seconds.
    with contextlib.suppress(RuntimeError, OSError):
        kernel._cache = _Cache(kernel.py_func)
    return kernel


@final
class _Cache(FunctionCache):
    """Results kept on disk as far as that is possible; a cache that cannot be read or written is none."""

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        """The compiled function, or None where it has to be compiled."""
        try:
            return super().load_overload(sig, target_context)
        except Exception:  # A damaged cache fails in any way.
            return None

    def save_overload(self, sig: Any, data: Any) -> None:
        """Keeps it, unless the disk refuses."""
        try:
            super().save_overload(sig, data)
        except Exception:  # What cannot be kept, or read to add to it, is compiled again next time.
            self.disable()


@lru_cache(maxsize=4)
def _pool(threads: int) -> ThreadPoolExecutor:
    return ThreadPoolExecutor(threads, thread_name_prefix="twofold")


def in_parts(count: int, work: Callable[[int, int], Result], least: int = 1024) -> list[Result]:
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
