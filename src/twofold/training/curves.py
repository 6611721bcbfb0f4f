"""Losses over time: a small table, and the same for TensorBoard."""

import csv
import importlib
import io
import os
import time
from pathlib import Path
from typing import Any

from tensorboard.summary.writer.record_writer import RecordWriter

from twofold.errors import TwofoldError
from twofold.files import write_atomically
from twofold.inputs import read_text
from twofold.training.run import CURVES

# Their classes are made when they are imported, so a type checker does not see them.
event_pb2: Any = importlib.import_module("tensorboard.compat.proto.event_pb2")
summary_pb2: Any = importlib.import_module("tensorboard.compat.proto.summary_pb2")

_MAX_BYTES = 256 * 2**20
"""Of a table; a million rows of ten values have half as many."""


def read_curves(folder: Path) -> list[dict[str, float]]:
    """The points of a run's table, each with its "step" and values by name.

    Raises:
        TwofoldError: it is missing or damaged.
    """
    file = folder / CURVES
    try:
        lines = io.StringIO(read_text(file, _MAX_BYTES), newline="")
        rows = [{k: float(v) for k, v in row.items() if v} for row in csv.DictReader(lines)]
        if any("step" not in row for row in rows):
            raise KeyError("step")
    except (ValueError, TypeError, KeyError, csv.Error):
        raise TwofoldError(f"{file} is damaged; remove it and resume again.") from None
    return rows


class Curves:
    """Losses over time, as a table that is written whole before every checkpoint, and for TensorBoard.

    TensorBoard's own writer has a thread that prints a traceback of its own when the disk is full. Here its events are
    written at once, so that whoever adds a point meets the error.
    """

    def __init__(self, folder: Path, start: int) -> None:
        """Continues the table of an interrupted run up to `start`.

        Raises:
            TwofoldError: that table is damaged.
            OSError: the disk refuses.
        """
        self.file = folder / CURVES
        self.rows: list[dict[str, float]] = []
        if start and self.file.is_file():
            self.rows = [row for row in read_curves(folder) if row["step"] <= start]
        board = folder / "tensorboard"
        board.mkdir(exist_ok=True)
        events = board / f"events.out.tfevents.{time.time_ns()}.{os.getpid()}"
        self._records = RecordWriter(events.open("wb"))
        self._event(event_pb2.Event(file_version="brain.Event:2"))
        # From this step on, what an interrupted run wrote after its checkpoint is not shown.
        began = event_pb2.SessionLog(status=event_pb2.SessionLog.START)
        self._event(event_pb2.Event(step=start + 1, session_log=began))

    def add(self, row: dict[str, float]) -> None:
        """Appends one point: its "step" and values by name.

        Raises:
            OSError: the disk refuses.
        """
        self.rows.append(row)
        values = [
            summary_pb2.Summary.Value(tag=name, simple_value=value) for name, value in row.items() if name != "step"
        ]
        self._event(event_pb2.Event(step=int(row["step"]), summary=summary_pb2.Summary(value=values)))

    def save(self) -> None:
        """Writes the table.

        Raises:
            TwofoldError: the disk refuses.
        """
        names = list(dict.fromkeys(name for row in self.rows for name in row))
        text = io.StringIO()
        writer = csv.DictWriter(text, names)
        writer.writeheader()
        writer.writerows(self.rows)
        with write_atomically(self.file) as beside:
            beside.write_text(text.getvalue(), encoding="utf-8")

    def close(self) -> None:
        """Ends TensorBoard's file."""
        self._records.close()

    def _event(self, event: Any) -> None:
        event.wall_time = time.time()
        self._records.write(event.SerializeToString())
        self._records.flush()
