"""One cell of an experiment: a subject, a recipe and a seed, trained and measured in a folder of its own.

The folder's name is the hash of what decides the training, so tables share cells, and whatever is finished is never
made twice. `run_cell` needs nothing but that folder, so it can run in any process on any machine that sees it.
"""

import functools
import hashlib
import json
import os
import signal
import sys
import threading
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from twofold.errors import TwofoldError
from twofold.evaluation import require_meshes
from twofold.files import made_folder, write_json
from twofold.inputs import read_json
from twofold.kernels.runtime import tune_process
from twofold.methods.table import recipe_from_dict, recipe_to_dict
from twofold.provenance import program
from twofold.recipe import Recipe
from twofold.reproduce.measuring import Measures, measure_avatar
from twofold.reproduce.sources import FolderSource, Source, StudioSource
from twofold.training import loop
from twofold.training.lock import locked
from twofold.training.perceptual_loss import attach_perceptual
from twofold.training.run import RECIPE, choose_device, read_about

CELLS, CAPTURES = "cells", "captures"
"""Folders of an experiment."""
CELL, RUN, RESULTS, PROGRESS, FAILURE = "cell.json", "run", "results.json", "progress.json", "failure.json"
"""What a cell's folder holds: what it is, its run, what was measured, how far it is, why it failed."""
RATE = "rate.json"
"""Seconds a step of the last training there, kept until the results are."""
TRAINING_SHARE = 0.85
"""Of a cell's time, for progress; the rest is measuring."""
EVERY = 1.0
"""Seconds between two notes of progress."""


@dataclass(frozen=True)
class Cell:
    """What is trained and measured.

    Attributes:
        source: the subject.
        recipe: how; its seed is the cell's.
        measures: what is measured; no part of the hash, so changing it measures anew and trains nothing.
    """

    source: Source
    recipe: Recipe
    measures: Measures = Measures()

    @functools.cached_property
    def key(self) -> str:
        """Name of the folder: hash of all that decides the training. A recipe's name decides nothing."""
        trained = recipe_to_dict(self.recipe)
        del trained["name"]
        training = trained["training"]
        for silent in ("checkpoint_every", "preview_every"):
            del training[silent]
        text = json.dumps({"source": self.source.identity(), "recipe": trained}, sort_keys=True)
        return hashlib.sha256(text.encode()).hexdigest()[:16]

    def folder(self, out: Path) -> Path:
        """Its folder in an experiment's."""
        return out / CELLS / self.key

    def results(self, out: Path) -> dict[str, Any] | None:
        """What was measured, or None while that is not done.

        Raises:
            TwofoldError: the file is damaged.
        """
        file = self.folder(out) / RESULTS
        if not file.is_file():
            return None
        found = read_json(file)
        if not isinstance(found, dict):
            raise TwofoldError(f"{file} should hold an object; it is damaged, remove it and start again.")
        return found if found.get("measures") == asdict(self.measures) else None

    def failure(self, out: Path) -> str:
        """Why it failed when it was last tried; empty where it did not."""
        file = self.folder(out) / FAILURE
        if not file.is_file():
            return ""
        found = read_json(file)
        return str(found.get("failure", "damaged")) if isinstance(found, dict) else "damaged"

    def share(self, out: Path) -> tuple[float, str]:
        """How much of it is done, 0..1, and what is being done."""
        file = self.folder(out) / PROGRESS
        try:
            found = json.loads(file.read_text("utf-8")) if file.is_file() else {}
            return float(found.get("share", 0.0)), str(found.get("note", ""))
        except (OSError, ValueError, TypeError, AttributeError):
            return 0.0, ""  # A note that is being written; the next look reads it.


def store_cell(cell: Cell, out: Path) -> Path:
    """Writes what the cell is into its folder, for `run_cell`.

    Raises:
        TwofoldError: the folder cannot be written.
    """
    folder = cell.folder(out)
    with made_folder(folder):
        kind = type(cell.source).__name__
        write_json(
            folder / CELL,
            {"source": {"kind": kind, **asdict(cell.source)}, "recipe": recipe_to_dict(cell.recipe),
             "measures": asdict(cell.measures)},
        )  # fmt: skip
    return folder


def read_cell(folder: Path) -> Cell:
    """What `store_cell` wrote.

    Raises:
        TwofoldError: it is missing or damaged.
    """
    file = folder / CELL
    stored = read_json(file)
    try:
        if not isinstance(stored, dict):
            raise TypeError("no object")
        source = dict(stored["source"])
        kind = {"StudioSource": StudioSource, "FolderSource": FolderSource}[source.pop("kind")]
        return Cell(kind(**source), recipe_from_dict(stored["recipe"], str(file)), Measures(**stored["measures"]))
    except (KeyError, TypeError, ValueError) as error:
        raise TwofoldError(f"{file} is damaged; remove {folder} and start `twofold reproduce` again.") from error


def run_cell(folder: str, threads: int | None = None, work: "Work | None" = None) -> None:
    """Does a cell, or goes on with it; whatever fails is written to its folder and not raised.

    Args:
        folder: of the cell.
        threads: of this process; None leaves what is set.
        work: what is done; by default `train_and_measure`.

    Raises:
        KeyboardInterrupt: passed on after the training has stored its state.
    """
    place = Path(folder)
    (place / FAILURE).unlink(missing_ok=True)
    try:
        tune_process()
        if threads is not None:
            import torch

            torch.set_num_threads(threads)
        with locked(place):
            (work or train_and_measure)(place)
    except Exception as error:
        sentence = str(error) if isinstance(error, TwofoldError) else f"{type(error).__name__}: {error}"
        write_json(place / FAILURE, {"failure": sentence})


Work = Callable[[Path], None]
"""What happens in a cell's folder until its results lie there."""


def train_and_measure(folder: Path) -> None:
    """Trains the cell's avatar, from its checkpoint where there is one, measures it, and stores the results.

    Raises:
        TwofoldError: the capture is faulty, the training diverges, the disk refuses.
    """
    cell = read_cell(folder)
    note = _Notes(folder)
    note(0.0, "capture")
    capture = cell.source.capture(folder.parent.parent / CAPTURES)
    if cell.measures.max_meshes:
        require_meshes(capture, cell.measures.max_meshes)
    device = choose_device("auto")
    run = folder / RUN
    begun = time.monotonic(), time.process_time()
    first: list[int] = []
    rate: dict[str, float] = {}

    def watch(progress: loop.Progress) -> None:
        if not first:
            first.append(progress.step)
        note(TRAINING_SHARE * progress.step / progress.steps, f"step {progress.step} of {progress.steps}")
        made = progress.step - first[0] + 1
        rate["seconds_per_step"] = (time.monotonic() - begun[0]) / made
        rate["processor_seconds_per_step"] = (time.process_time() - begun[1]) / made

    avatar = loop.train(capture, cell.recipe, run, device, (run / RECIPE).is_file(), watch, attach_perceptual).eval()
    if rate:
        write_json(folder / RATE, rate)
    measuring = time.monotonic()
    found = measure_avatar(
        avatar, capture, cell.measures, lambda done: note(TRAINING_SHARE + (1 - TRAINING_SHARE) * done, "measuring")
    )
    known = read_json(folder / RATE) if (folder / RATE).is_file() else {}
    seconds = (known if isinstance(known, dict) else {}) | {"measuring": time.monotonic() - measuring}
    about = {"recipe": cell.recipe.name, "seed": cell.recipe.seed, "subject": cell.source.name}
    about["made_with"] = program(read_about(run))
    write_json(folder / RESULTS, about | {"seconds": seconds, "measures": asdict(cell.measures)} | found)
    note(1.0, "done", force=True)


class _Notes:
    """Progress in a file, now and then; it is not worth a flush to the disk."""

    def __init__(self, folder: Path) -> None:
        self._file, self._last = folder / PROGRESS, -EVERY

    def __call__(self, share: float, note: str, force: bool = False) -> None:
        now = time.monotonic()
        if force or now - self._last >= EVERY:
            self._last = now
            beside = self._file.with_suffix(".partial")
            beside.write_text(json.dumps({"share": share, "note": note}), "utf-8")
            os.replace(beside, self._file)


def in_own_process(folder: str, threads: int | None, work: Work | None, parent: int) -> None:
    """`run_cell` in a process of its own: a terminal's Ctrl-C goes to the parent alone, which passes it on once.

    When the parent is gone, the cell stores its state and ends, too.
    """
    if sys.platform != "win32":
        os.setsid()

    def follow() -> None:
        while os.getppid() == parent:
            time.sleep(1.0)
        os.kill(os.getpid(), signal.SIGINT)

    try:
        if sys.platform != "win32":
            signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})
        threading.Thread(target=follow, daemon=True).start()
        run_cell(folder, threads, work)
    except KeyboardInterrupt:
        sys.exit(130)
