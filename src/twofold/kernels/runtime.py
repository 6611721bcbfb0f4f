"""Settings of the process that cost nothing and pay a lot on CPUs; and methods that run compiled for a while."""

import contextlib
import ctypes
import os
import sys
from collections.abc import Generator, Sequence

from twofold.errors import TwofoldError

_M_TRIM_THRESHOLD, _M_TOP_PAD, _M_MMAP_MAX = -1, -2, -4


def flush_denormals() -> None:
    """Takes the smallest numbers for zero in this thread: products of them are a hundred times slower.

    Tails of the density and of softplus underflow all the time.
    """
    import numpy as np
    import torch

    # NumPy 1 measures its number types when they are first asked for, and warns where these numbers are.
    for kind in (np.float16, np.float32, np.float64, np.longdouble):
        np.finfo(kind)
    torch.set_flush_denormal(True)


def wait_passively() -> bool:
    """Tells OpenMP that waiting threads give up their core; tells whether that is still possible.

    It has to be called before torch is imported, which starts OpenMP. A setting of the user's stays.
    """
    if "torch" in sys.modules:
        return False
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
    return True


def tune_process() -> None:
    """Threads that wait give up their core, denormals are flushed, and freed memory is kept for the next step.

    Waiting: OpenMP's threads spin between two pieces of work. Where something else wants a core too, each spins while
    the other is not running, and small pieces take ten times as long. This can be set only before torch is loaded.
    Memory: glibc returns large blocks to the system and fetches them again zeroed, page by page, at every step.
    Call it before the first parallel operation; elsewhere than on Linux that part is left out.
    """
    wait_passively()
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


@contextlib.contextmanager
def compiled_methods(owner: object, names: Sequence[str]) -> Generator[bool, None, None]:
    """While the block lasts, these methods of one object run through torch.compile; tells whether there are any.

    Sizes may change from call to call; the first calls take minutes.

    Raises:
        TwofoldError: the compiler fails, most often because the machine has none for C++.
    """
    import torch

    for name in names:
        setattr(owner, name, torch.compile(getattr(owner, name), dynamic=True))
    try:
        yield bool(names)
    except Exception as error:
        if not type(error).__module__.startswith(("torch._dynamo", "torch._inductor")):
            raise
        said = str(error).strip().partition("\n")[0]
        raise TwofoldError(
            f"torch.compile does not work here ({said}); install a C++ compiler, or leave training.compile at never."
        ) from error
    finally:
        for name in names:
            delattr(owner, name)
