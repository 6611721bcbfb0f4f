"""Settings of the process that cost nothing and pay a lot on CPUs."""

import ctypes
import os
import sys

_M_TRIM_THRESHOLD, _M_TOP_PAD, _M_MMAP_MAX = -1, -2, -4


def flush_denormals() -> None:
    """Takes the smallest numbers for zero in this thread: products of them are a hundred times slower.

    Tails of the density and of softplus underflow all the time.
    """
    import numpy as np
    import torch

    # NumPy 1 measures its number types when they are first asked for, and wonders aloud where these numbers are.
    for kind in (np.float16, np.float32, np.float64, np.longdouble):
        np.finfo(kind)
    torch.set_flush_denormal(True)


def tune_process() -> None:
    """Flushes denormals and keeps freed memory for the next step.

    Memory: glibc returns large blocks to the system and fetches them again zeroed, page by page, at every step.
    Call it before the first parallel operation; elsewhere than on Linux only the first half applies.
    """
    flush_denormals()
    if sys.platform != "linux" or "MALLOC_" in "".join(os.environ) or "GLIBC_TUNABLES" in os.environ:
        return
    try:
        libc = ctypes.CDLL("libc.so.6")
    except OSError:
        return  # Another C library, with an allocator of its own.
    libc.mallopt(_M_MMAP_MAX, 0)
    libc.mallopt(_M_TRIM_THRESHOLD, 2**31 - 1)
    libc.mallopt(_M_TOP_PAD, 64 * 2**20)
