"""The time that a training took, as it stands in the head of a checkpoint."""

import math
import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from safetensors import SafetensorError, safe_open

WALL, PROCESSOR = "seconds", "processor_seconds"
"""Names in the head."""


@dataclass(frozen=True)
class Spent:
    """Time that a training took, in all its sessions together.

    Attributes:
        seconds: on the clock.
        processor: seconds of all cores together, of the leading process.
    """

    seconds: float = 0.0
    processor: float = 0.0

    def as_text(self) -> dict[str, str]:
        """For the head of a checkpoint.

        >>> Spent(1.25, 2.0).as_text()
        {'seconds': '1.250', 'processor_seconds': '2.000'}
        """
        return {WALL: f"{self.seconds:.3f}", PROCESSOR: f"{self.processor:.3f}"}

    @staticmethod
    def of_text(about: Mapping[str, str]) -> "Spent | None":
        """What `as_text` gave; None where it is not there or makes no sense.

        >>> Spent.of_text({"seconds": "1.25", "processor_seconds": "2"})
        Spent(seconds=1.25, processor=2.0)
        """
        try:
            seconds, processor = float(about[WALL]), float(about[PROCESSOR])
        except (KeyError, ValueError):
            return None
        return (
            Spent(seconds, processor) if math.isfinite(seconds + processor) and min(seconds, processor) >= 0 else None
        )


def read_spent(checkpoint: Path) -> Spent | None:
    """The time that a training has taken up to its checkpoint; None where the file does not say it."""
    try:
        with safe_open(checkpoint, framework="pt") as stored:
            return Spent.of_text(stored.metadata() or {})
    except (SafetensorError, OSError):
        return None


class Clock:
    """Measures a training over all its sessions: runs from its making on, and adds what a continued run has taken."""

    def __init__(self, checkpoint: Path | None) -> None:
        """Starts. `checkpoint` is that of the run which is continued; None for a new one."""
        self._before = (read_spent(checkpoint) if checkpoint else None) or Spent()
        self._begun = time.perf_counter(), time.process_time()

    def spent(self) -> Spent:
        """The time up to now."""
        wall, processor = time.perf_counter() - self._begun[0], time.process_time() - self._begun[1]
        return Spent(self._before.seconds + wall, self._before.processor + processor)
