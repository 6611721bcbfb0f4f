"""Settings of the process that cost nothing and pay a lot on CPUs."""

import ctypes
import os
import sys

_M_TRIM_THRESHOLD, _M_TOP_PAD, _M_MMAP_MAX = -1, -2, -4


def tune_process() -> None:
    """Flushes denormals and keeps freed memory for the next step.

    Denormals: tails of the density and of softplus underflow, and a product of denormals is a hundred times slower.
    Memory: glibc returns large blocks to the system and fetches them again zeroed, page by page, at every step.
    Call it before the first parallel operation; elsewhere than on Linux only the first half applies.
    """
    import torch

    torch.set_flush_denormal(True)
    if sys.platform != "linux" or "MALLOC_" in "".join(os.environ) or "GLIBC_TUNABLES" in os.environ:
        return
    try:
        libc = ctypes.CDLL("libc.so.6")
    except OSError:
        return  # Another C library, with an allocator of its own.
    libc.mallopt(_M_MMAP_MAX, 0)
    libc.mallopt(_M_TRIM_THRESHOLD, 2**31 - 1)
    libc.mallopt(_M_TOP_PAD, 64 * 2**20)
