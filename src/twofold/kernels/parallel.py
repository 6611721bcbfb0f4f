"""Compiled loops on as many threads as PyTorch uses: the range is cut into parts that threads take one by one."""

import contextlib
import inspect
import itertools
import sys
import threading
import time
from collections.abc import Callable, Generator, Iterable
from concurrent.futures import Future, ThreadPoolExecutor, wait
from contextvars import ContextVar
from functools import lru_cache
from pathlib import Path
from typing import Any, TypeVar, final

import numba
import torch
from numba.core.caching import FunctionCache

_PACKAGE = Path(__file__).parents[1]
Result = TypeVar("Result")
Item = TypeVar("Item")
_THREADS: ContextVar[int | None] = ContextVar("_THREADS", default=None)
"""How many threads share a range, where it is not PyTorch's number of threads."""
PARTS_EACH = 2
"""Parts for each thread: more even out better and cost more calls."""
_INSIDE = threading.local()
"""Tells whether this thread already handles a part: it does not share that out again."""
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
        """The compiled function, or None where it has to be compiled; said once where none is kept yet."""
        found = None
        with contextlib.suppress(Exception):  # A damaged cache fails in any way.
            found = super().load_overload(sig, target_context)
        if found is None:
            _announce(Path(self.cache_path))
        return found

    def save_overload(self, sig: Any, data: Any) -> None:
        """Keeps it, unless the disk refuses."""
        try:
            super().save_overload(sig, data)
        except Exception:  # What cannot be kept, or read to add to it, is compiled again next time.
            self.disable()


COMPILING = "Compiling loops for this processor, once: about a minute."
_announced = threading.Event()


def _announce(folder: Path) -> None:
    """Says on stderr that loops are compiled, once a process and only where no loop is kept on disk at all.

    Args:
        folder: where one loop would be kept: beside its source, or a folder of its package among those of others.
    """
    if _announced.is_set():
        return
    _announced.set()
    place = _PACKAGE if folder.is_relative_to(_PACKAGE) else folder.parent
    if next(place.rglob("*.nbi"), None) is None:
        print(COMPILING, file=sys.stderr, flush=True)


@contextlib.contextmanager
def one_thread_each() -> Generator[None]:
    """While the block lasts, each PyTorch operation takes one thread, and `in_parts` still cuts ranges as before.

    For thousands of small operations: sharing each of them out costs more than it saves.
    """
    threads = torch.get_num_threads()
    token = _THREADS.set(_threads())
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)
        _THREADS.reset(token)


def _threads() -> int:
    if getattr(_INSIDE, "part", False):
        return 1
    return _THREADS.get() or torch.get_num_threads()


@lru_cache(maxsize=4)
def _pool(threads: int) -> ThreadPoolExecutor:
    return ThreadPoolExecutor(threads, thread_name_prefix="twofold")


def in_parts(count: int, work: Callable[[int, int], Result], least: int = 1024, *, long: bool = False) -> list[Result]:
    """Calls `work(begin, end)` on parts of 0..count, side by side; `work` must let go of the interpreter's lock.

    There are more parts than threads, and each thread takes the next part when it is done with one: parts of unequal
    work, or a core that another process uses, keep nobody waiting for long. This thread takes parts like the others.
    Which thread takes a part changes nothing, so what is summed over the parts in order repeats to the bit.

    Where a part fails no further parts are begun; those that others have begun are waited for, and the first error is
    raised.

    Args:
        count: size of the whole range.
        work: handles one part; parts must not write to the same memory.
        least: parts smaller than this are not worth a thread.
        long: whether parts take seconds, or wait for files: they are then shared however busy other processes are.

    Returns:
        what `work` gave for each part, in order.
    """
    most = max(1, count // max(least, 1))
    threads = min(_threads(), most)
    if threads == 1:
        return [work(0, count)]
    parts = min(threads * PARTS_EACH, most)
    bounds = [count * part // parts for part in range(parts + 1)]
    results: list[Result | None] = [None] * parts
    following, busy, errors = itertools.count(), list[float](), list[BaseException]()

    def take() -> None:
        _INSIDE.part, begun = True, time.thread_time()
        try:
            while not errors and (part := next(following)) < parts:
                results[part] = work(bounds[part], bounds[part + 1])
        except BaseException as error:
            errors.append(error)
        finally:
            _INSIDE.part = False
            busy.append(time.thread_time() - begun)

    begun, helping = time.perf_counter(), long or _SHARING.pays()
    others: list[Future[None]] = []
    try:
        if helping:
            others += [_pool(threads - 1).submit(take) for _ in range(threads - 1)]
        take()
    except BaseException as error:  # An interrupt between two parts, or no room for a thread.
        errors.append(error)
        raise
    finally:
        # Threads that have not begun would find nothing left to do.
        wait([other for other in others if not other.cancel()])
    if errors:
        raise errors[0]
    if helping and not long:
        _SHARING.note(time.perf_counter() - begun, sum(busy))
    return results  # type: ignore[return-value]


@final
class _Sharing:
    """Whether other threads shorten the work at present, or only wait for cores that other processes keep busy.

    A thread that is stopped within a part holds up all the others for milliseconds, a dozen times a training step.
    Parts are the same either way, so results are.
    """

    def __init__(self) -> None:
        """Nothing is known yet."""
        self.ratio, self.alone_until = START, 0.0

    def pays(self) -> bool:
        """Whether work is to be shared now."""
        return time.perf_counter() >= self.alone_until

    def note(self, seconds: float, busy: float) -> None:
        """Adds what one call showed.

        Args:
            seconds: how long it took.
            busy: for how long processors worked for it, all threads together, seconds.
        """
        if busy < SHORT:
            return
        # Of a work that was held up once it counts that sharing gained nothing, not for how long it was held up.
        self.ratio += (min(seconds / busy, 1.0) - self.ratio) / RECENT
        if self.ratio > NO_GAIN:
            self.ratio, self.alone_until = START, time.perf_counter() + PAUSE


SHORT, RECENT, START, NO_GAIN, PAUSE = 1.5e-3, 8, 0.7, 0.95, 2.0
"""Work that is long enough to judge by, seconds; over about how many works the ratio of time to processor time is
averaged, from where it starts, above which threads do not pay, and for how many seconds work is then not shared."""
_SHARING = _Sharing()


def ahead(items: Iterable[Item]) -> Generator[Item]:
    """The items in order; while one is used, the next is made in another thread.

    Only that one is kept beside the one in use. What making an item raises is raised here, when it is its turn.

    >>> list(ahead(n * n for n in range(3)))
    [0, 1, 4]
    """
    source, end = iter(items), object()

    def following() -> Item | object:
        return next(source, end)

    with ThreadPoolExecutor(1, thread_name_prefix="ahead") as thread:
        coming = thread.submit(following)
        while (item := coming.result()) is not end:
            coming = thread.submit(following)
            # Passed on without a name of its own here, so that it is gone when its user is done with it.
            held = [item]
            del item
            yield held.pop()  # pyright: ignore[reportReturnType]
