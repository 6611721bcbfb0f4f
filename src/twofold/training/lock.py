"""One process at a time works in a folder; the lock ends with its process, however that ends."""

import contextlib
import os
import sys
from collections.abc import Generator
from pathlib import Path

from twofold.errors import TwofoldError
from twofold.files import plain_errors

if sys.platform == "win32":
    import msvcrt
else:
    import errno
    import fcntl

LOCK = ".lock"
"""In the folder, while somebody works there."""


@contextlib.contextmanager
def locked(folder: Path, doing: str = "trained") -> Generator[None, None, None]:
    """While the block lasts, no other process can lock this folder, which must exist.

    The system holds the lock and gives it back when the process ends or is killed. Where a file system knows no locks,
    there is none.

    Args:
        folder: to work in.
        doing: what happens there, for the sentence that the others get.

    Raises:
        TwofoldError: another process has locked it; or the folder cannot be written.
    """
    path = folder / LOCK
    handle = _taken(path)
    if handle is None:
        raise TwofoldError(
            f"{folder} is being {doing} by another process right now; wait until it ends, or choose another "
            "folder with --out."
        )
    try:
        yield
    finally:
        if sys.platform != "win32":  # where an open file cannot be removed
            path.unlink(missing_ok=True)
        os.close(handle)


def require_unlocked(folder: Path, doing: str = "trained") -> None:
    """Refuses a folder in which another process is at work, before any work is done for it.

    Raises:
        TwofoldError: see `locked`.
    """
    if (folder / LOCK).exists():
        with locked(folder, doing):
            pass


def _taken(path: Path) -> int | None:
    """The file, open and locked; None where another process holds it."""
    while True:
        with plain_errors(path):
            handle = os.open(path, os.O_RDWR | os.O_CREAT, 0o666)
        try:
            if not _lock(handle):
                os.close(handle)
                return None
            # Whoever held it before may have removed the file between our opening and locking it.
            if path.exists() and os.path.samestat(os.stat(path), os.fstat(handle)):
                return handle
        except FileNotFoundError:
            pass
        except BaseException:
            os.close(handle)
            raise
        os.close(handle)


def _lock(handle: int) -> bool:
    """Whether the open file could be locked, or cannot be locked at all."""
    if sys.platform == "win32":
        try:
            msvcrt.locking(handle, msvcrt.LK_NBLCK, 1)
        except OSError:
            return False
        return True
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError as error:
        return error.errno not in (errno.EWOULDBLOCK, errno.EACCES)
    return True
