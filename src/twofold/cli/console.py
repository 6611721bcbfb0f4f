"""Where people read: progress with an honest end, the result, and what to do next."""

import os
import signal
import threading
import time
from collections import deque
from collections.abc import Callable, Generator
from contextlib import contextmanager
from datetime import timedelta
from types import FrameType
from typing import final

from rich.console import Console
from rich.progress import BarColumn, Progress, ProgressColumn, Task, TextColumn, TimeElapsedColumn
from rich.text import Text

from twofold.errors import TwofoldError

ALONE = os.environ.get("RANK", "0") == "0"
"""Of several processes that train together, the first one speaks for all."""
LINE_EVERY = 30.0
"""Seconds after which progress is written again where standard error is no terminal, and at every tenth of the way."""

WINDOW = 60.0
"""Seconds of the past that say how fast it goes, at least; of a long work, its later half."""


@final
class TimeLeft(ProgressColumn):
    """How long it still takes, seconds: at the speed of the near past up to now.

    Since the time that has passed without any news counts as well, what stands still takes ever longer, and does not
    stay "1 second left".
    """

    def __init__(self) -> None:
        super().__init__()
        self._past: deque[tuple[float, float]] = deque()
        self._done = 0.0

    def note(self, done: float) -> None:
        """Takes down the share that is done."""
        now = time.monotonic()
        self._done = done
        begun = self._past[0][0] if self._past else now
        if not self._past or now - self._past[-1][0] >= max(0.5, (now - begun) / 500):
            self._past.append((now, done))
        while len(self._past) > 2 and self._past[1][0] <= now - max(WINDOW, (now - begun) / 2):
            self._past.popleft()

    def restart(self) -> None:
        """Measures the speed anew from here, such as after the process was stopped for a while (Ctrl-Z)."""
        self._past.clear()
        self.note(self._done)

    def seconds(self) -> float | None:
        """Seconds left; None while nobody knows."""
        if not self._past:
            return None
        then, share = self._past[0]
        if self._done <= share or self._done >= 1:
            return None
        return (1 - self._done) * (time.monotonic() - then) / (self._done - share)

    def render(self, task: Task) -> Text:
        """For the bar."""
        left = self.seconds()
        return Text("" if left is None else f"{timedelta(seconds=round(left))} left")


def console() -> Console:
    """Standard error, as it is now."""
    return Console(stderr=True, highlight=False, markup=False, quiet=not ALONE)


@contextmanager
def _when_continued(restart: Callable[[], None]) -> Generator[None, None, None]:
    """Calls a function whenever the stopped process goes on (`fg`, SIGCONT), where there is such a signal."""
    if not hasattr(signal, "SIGCONT") or threading.current_thread() is not threading.main_thread():
        yield
        return
    before = signal.getsignal(signal.SIGCONT)

    def continued(number: int, frame: FrameType | None) -> None:
        restart()
        if callable(before):
            before(number, frame)

    signal.signal(signal.SIGCONT, continued)
    try:
        yield
    finally:
        signal.signal(signal.SIGCONT, signal.SIG_DFL if before is None else before)


@contextmanager
def bar(title: str) -> Generator[Callable[[float, str], None], None, None]:
    """A progress bar, or a line now and then where nobody watches a terminal.

    The function it gives takes the share that is done and a word about it.
    """
    left = TimeLeft()
    columns = (TextColumn("{task.description}"), BarColumn(), TextColumn("{task.percentage:>3.0f} %"))
    out = console()
    display = Progress(
        *columns, TimeElapsedColumn(), left, TextColumn("{task.fields[note]}"),
        console=out, refresh_per_second=4, disable=not out.is_terminal,
    )  # fmt: skip
    with display, _when_continued(left.restart):
        task = display.add_task(title, total=1.0, note="")
        reported, last = 0, time.monotonic()

        def progress(done: float, note: str) -> None:
            nonlocal reported, last
            display.update(task, completed=done, note=note)
            left.note(done)
            tenths, now = int(10 * done), time.monotonic()
            if out.is_terminal or (tenths == reported and now - last < LINE_EVERY):
                return
            reported, last = tenths, now
            seconds = left.seconds()
            parts = [f"{100 * done:.0f} %", *([f"{timedelta(seconds=round(seconds))} left"] if seconds else []), note]
            out.print(f"{title}: {', '.join(filter(None, parts))}", soft_wrap=True)

        yield progress


def say(result: str, following: str) -> None:
    """The last line of every command: where the result is and what to run next."""
    console().print(f"{result} Next: {following}", soft_wrap=True)


def tell(note: str) -> None:
    """A line about what was found or done, between others."""
    console().print(note, soft_wrap=True)


def within(**options: tuple[int | None, int, int | None]) -> None:
    """Refuses options (value, least, most or None for no limit) that are too small or too large.

    Raises:
        TwofoldError: names the first one and its limits.
    """
    for name, (value, least, most) in options.items():
        if value is not None and (value < least or (most is not None and value > most)):
            limits = f"at least {least}" if most is None else f"{least} to {most}"
            raise TwofoldError(f"--{name.replace('_', '-')} should be {limits}; it is {value}.")
