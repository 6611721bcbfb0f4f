"""Standard streams that are closed, full or no longer read never change what a program does."""

import contextlib
import os
import sys
from collections.abc import Generator
from typing import Any, final


@final
class _Forgiving:
    """A text stream whose writes always succeed; what it cannot take is lost, and so is all that follows."""

    def __init__(self, stream: Any) -> None:
        self._stream = stream

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)

    def write(self, text: str) -> int:
        """Writes what the stream takes; characters that it has no code for are written as escapes."""
        try:
            self._stream.write(text)
        except UnicodeEncodeError:
            coding = self._stream.encoding
            self.write(text.encode(coding, "backslashreplace").decode(coding))
        except (OSError, ValueError):  # a closed Python file raises ValueError
            self._let_go()
        return len(text)

    def flush(self) -> None:
        """Flushes, or lets go of a stream that cannot be."""
        try:
            self._stream.flush()
        except (OSError, ValueError):
            self._let_go()

    def _let_go(self) -> None:
        """Sends all that comes to nowhere: also what compiled code prints, and what Python flushes in the end."""
        with contextlib.suppress(OSError, ValueError, AttributeError):
            _to_nowhere(self._stream.fileno())
        with contextlib.suppress(OSError, ValueError):
            self._stream.flush()


def _to_nowhere(number: int) -> None:
    nowhere = os.open(os.devnull, os.O_RDWR)
    if nowhere != number:
        os.dup2(nowhere, number)
        os.close(nowhere)


def _open_streams() -> None:
    """Gives the numbers 0 to 2 to nowhere where they are closed, lest the next file that is opened gets one of them.

    It would then receive, among its own content, what anything prints.
    """
    for number in (0, 1, 2):
        try:
            os.fstat(number)
        except OSError:
            with contextlib.suppress(OSError):
                _to_nowhere(number)


@contextlib.contextmanager
def streams_that_never_fail() -> Generator[None, None, None]:
    """While the block lasts, and when Python ends after it, writing to standard output and error never raises."""
    _open_streams()
    before = sys.stdout, sys.stderr
    # Without a stream (`>&-`) Python has None there, which libraries that print do not expect.
    out, error = (_Forgiving(s if s is not None else open(os.devnull, "w", encoding="utf-8")) for s in before)  # noqa: SIM115
    sys.stdout, sys.stderr = out, error  # type: ignore[assignment]
    try:
        yield
    finally:
        out.flush()
        error.flush()
        sys.stdout, sys.stderr = before
