"""Where people read: progress with an honest end, the result, and what to do next."""

import os
import time
from collections.abc import Callable, Generator
from contextlib import contextmanager
from datetime import timedelta

from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from twofold.errors import TwofoldError

ALONE = os.environ.get("RANK", "0") == "0"
"""Of several processes that train together, the first one speaks for all."""
LINE_EVERY = 30.0
"""Seconds after which progress is told anew where standard error is no terminal, and at every tenth of the way."""


def console() -> Console:
    """Standard error, as it is now."""
    return Console(stderr=True, highlight=False, markup=False, quiet=not ALONE)


@contextmanager
def bar(title: str) -> Generator[Callable[[float, str], None], None, None]:
    """A progress bar, or a line now and then where nobody watches a terminal.

    The function it gives takes the share that is done and a word about it.
    """
    columns = (TextColumn("{task.description}"), BarColumn(), TextColumn("{task.percentage:>3.0f} %"))
    out = console()
    with Progress(
        *columns, TimeElapsedColumn(), TextColumn("left"), TimeRemainingColumn(), TextColumn("{task.fields[note]}"),
        console=out, refresh_per_second=4, speed_estimate_period=60, disable=not out.is_terminal,
    ) as progress:  # fmt: skip
        task = progress.add_task(title, total=1.0, note="")
        told, last = 0, time.monotonic()

        def show(done: float, note: str) -> None:
            nonlocal told, last
            progress.update(task, completed=done, note=note)
            tenths, now = int(10 * done), time.monotonic()
            if out.is_terminal or (tenths == told and now - last < LINE_EVERY):
                return
            told, last = tenths, now
            left = progress.tasks[0].time_remaining
            parts = [f"{100 * done:.0f} %", *([f"{timedelta(seconds=int(left))} left"] if left else []), note]
            out.print(f"{title}: {', '.join(filter(None, parts))}", soft_wrap=True)

        yield show


def say(result: str, following: str) -> None:
    """The last line of every command: where the result is and what to run next."""
    console().print(f"{result} Next: {following}", soft_wrap=True)


def within(**options: tuple[int | None, int, int | None]) -> None:
    """Refuses options (value, least, most or None for no limit) that are too small or too large.

    Raises:
        TwofoldError: names the first one and its limits.
    """
    for name, (value, least, most) in options.items():
        if value is not None and (value < least or (most is not None and value > most)):
            limits = f"at least {least}" if most is None else f"{least} to {most}"
            raise TwofoldError(f"--{name} should be {limits}; it is {value}.")
