"""How long cells take: from what finished cells took here, else from what was measured once."""

from collections.abc import Sequence
from pathlib import Path
from statistics import median
from typing import cast

from twofold.inputs import read_json
from twofold.methods.base import MethodConfig
from twofold.reproduce.cells import CELLS, RESULTS, TRAINING_SHARE, Cell

RATES: dict[str, float] = {
    "demo": 0.05, "quick": 0.09, "fast": 1.18, "humannerf_fast": 0.25, "monohuman_fast": 0.38, "npc_fast": 0.35,
    "danbo_fast": 0.32, "pm_avatar_fast": 0.39, "vid2avatar_fast": 0.6, "vid2avatar_mask_fast": 0.2,
}  # fmt: skip
"""Seconds a step on one core, by the recipe's name, as far as they were measured; what is missing is unknown."""
WHERE = "measured on one core of an AMD EPYC"


def known_rates(out: Path) -> dict[str, float]:
    """Seconds a step of the cells that are done in this folder, by the recipe's name: the median.

    Raises:
        TwofoldError: a stored file is damaged.
    """
    found: dict[str, list[float]] = {}
    for file in sorted((out / CELLS).glob(f"*/{RESULTS}")):
        results = read_json(file)
        if isinstance(results, dict):
            rate = results.get("seconds", {}).get("seconds_per_step")
            if isinstance(rate, float):
                found.setdefault(str(results.get("recipe")), []).append(rate)
    return {name: median(rates) for name, rates in found.items()}


def expected_seconds(cell: Cell, rates: dict[str, float]) -> float | None:
    """Seconds from the beginning to the results; None where nobody has measured such a recipe.

    An ablation counts as its full model does until one has been measured.
    """
    name = cell.recipe.name
    rate = rates.get(name) or rates.get(name.partition(" ")[0]) or RATES.get(name) or RATES.get(name.partition(" ")[0])
    steps = cast(MethodConfig, cell.recipe.method).total_steps(cell.recipe.training)
    return None if rate is None else rate * steps / TRAINING_SHARE


def left(cell: Cell, out: Path, rates: dict[str, float]) -> float | None:
    """Seconds that are left of a cell; 0 where it is done, None where nobody knows."""
    if cell.results(out) is not None:
        return 0.0
    seconds = expected_seconds(cell, rates)
    return None if seconds is None else seconds * (1 - min(cell.share(out)[0], TRAINING_SHARE))


def hours(seconds: Sequence[float | None], workers: int) -> str:
    """A sum of durations over some workers, in words.

    >>> hours([7200.0, 1800.0], 2), hours([600.0, None], 1), hours([None], 1), hours([], 1)
    ('1.2 hours', 'at least 10 minutes', 'unknown', '0 minutes')
    """
    known = [s for s in seconds if s is not None]
    if seconds and not known:
        return "unknown"
    minutes = sum(known) / workers / 60
    words = f"{minutes:.0f} minutes" if minutes < 60 else f"{minutes / 60:.1f} hours"
    return f"at least {words}" if len(known) < len(seconds) else words
