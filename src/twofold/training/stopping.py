"""Ctrl-C during a training."""

import contextlib
import math
import signal
import threading
import time
from collections.abc import Callable, Generator
from types import FrameType


@contextlib.contextmanager
def asked_to_stop() -> Generator[Callable[[], bool], None, None]:
    """Ctrl-C as a question that the loop asks between steps, so that no step is ever half applied.

    A second Ctrl-C interrupts at once, as usual, but only a second later: `torchrun` passes on what the terminal has
    sent already. Outside the main thread, signals are somebody else's.
    """
    asked = math.inf

    def note(number: int, stack: FrameType | None) -> None:
        nonlocal asked
        if time.monotonic() - asked >= 1:
            signal.default_int_handler(number, stack)
        asked = min(asked, time.monotonic())

    if threading.current_thread() is not threading.main_thread():
        yield lambda: False
        return
    before = signal.signal(signal.SIGINT, note)
    try:
        yield lambda: asked < math.inf
    finally:
        signal.signal(signal.SIGINT, before)
