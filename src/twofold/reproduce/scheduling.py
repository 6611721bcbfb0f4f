"""All cells of an experiment: what is left to do, which share of it is ours, and doing it."""

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from twofold.errors import TwofoldError
from twofold.reproduce.cells import TRAINING_SHARE, Cell, store_cell
from twofold.reproduce.executors import Executor, Job

POLL = 0.5
"""Seconds between two looks at the cells at work."""


@dataclass(frozen=True)
class Outcome:
    """What became of the cells.

    Attributes:
        done: keys of those whose results are there, those from before included.
        failed: key and reason of the others that were tried.
    """

    done: tuple[str, ...]
    failed: Mapping[str, str]


def distinct(cells: Sequence[Cell]) -> list[Cell]:
    """Each cell once, in order: tables share cells."""
    return list({cell.key: cell for cell in cells}.values())


def shard(cells: Sequence[Cell], which: str | None) -> list[Cell]:
    """The i-th of n parts of the cells; parts are disjoint and give all cells together.

    Args:
        cells: distinct ones.
        which: "i/n", i from 1; None for all.

    Raises:
        TwofoldError: it does not name a part.
    """
    if which is None:
        return list(cells)
    number, slash, count = which.partition("/")
    valid = bool(slash) and number.isascii() and number.isdigit() and count.isascii() and count.isdigit()
    if not valid or not 1 <= int(number) <= int(count):
        raise TwofoldError(f"--shard should be i/n with i from 1 to n, such as 2/4; it is {which}.")
    # By key, not by place in the list: every machine finds the same parts, whatever it has already done.
    ordered = sorted(cells, key=lambda cell: cell.key)
    mine = {cell.key for cell in ordered[int(number) - 1 :: int(count)]}
    return [cell for cell in cells if cell.key in mine]


def run_cells(
    cells: Sequence[Cell], out: Path, executor: Executor, progress: Callable[[float, str], None] | None = None,
    names: Mapping[str, str] | None = None, weights: Mapping[str, float] | None = None,
) -> Outcome:  # fmt: skip
    """Does all cells that are not done; one that fails is noted and stops no other.

    Args:
        cells: distinct ones.
        out: folder of the experiment.
        executor: where they run.
        progress: called with the share of the work that is done, 0..1, and what is at work.
        names: of cells by key, for `progress`.
        weights: expected seconds of cells by key, so that the share counts a long cell for more; even without.

    Raises:
        TwofoldError: the folder cannot be written, or a stored file is damaged.
        KeyboardInterrupt: passed on after the cells at work have stored their state.
    """
    done = [cell.key for cell in cells if cell.results(out) is not None]
    waiting = [cell for cell in cells if cell.key not in done]
    weigh = {cell.key: (weights or {}).get(cell.key, 1.0) for cell in waiting}
    # What an earlier run has done counts neither as work nor as speed.
    before = {cell.key: min(cell.share(out)[0], TRAINING_SHARE) for cell in waiting}
    total = sum(weight * (1 - before[key]) for key, weight in weigh.items())
    failed: dict[str, str] = {}
    at_work: dict[str, tuple[Cell, Job]] = {}
    ended = 0.0
    try:
        while waiting or at_work:
            while waiting and len(at_work) < executor.at_once:
                cell = waiting.pop(0)
                at_work[cell.key] = cell, executor.start(store_cell(cell, out))
            for key, (cell, job) in list(at_work.items()):
                if not job.finished():
                    continue
                del at_work[key]
                ended += weigh[key] * (1 - before[key])
                if cell.results(out) is not None:
                    done.append(key)
                else:
                    failed[key] = cell.failure(out) or job.failure() or "it left no results"
            if progress:
                shares = {key: cell.share(out) for key, (cell, _) in at_work.items()}
                part = sum(weigh[key] * max(share - before[key], 0) for key, (share, _) in shares.items())
                notes = [f"{(names or {}).get(key, key)}: {note}" for key, (_, note) in shares.items() if note][:2]
                count = f"{len(done)} of {len(cells)} cells" + (f", {len(failed)} failed" if failed else "")
                progress(min((ended + part) / total, 1.0) if total else 1.0, "; ".join([count, *notes]))
            if at_work:
                time.sleep(POLL)
    except KeyboardInterrupt:
        _stop_all(at_work)
        raise
    return Outcome(tuple(done), failed)


def _stop_all(at_work: dict[str, tuple[Cell, Job]]) -> None:
    """Asks all cells at work to store their state, and waits until they have."""
    for _, job in at_work.values():
        job.stop()
    while any(not job.finished() for _, job in at_work.values()):
        time.sleep(0.1)
