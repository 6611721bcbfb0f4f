"""From the cells' metrics to the numbers of a table: mean, spread over seeds, which are best, which orderings hold."""

import math
import statistics
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

Mark = Literal["", "best", "second"]
Better = Literal["high", "low"]


@dataclass(frozen=True)
class Value:
    """A number of a table.

    Attributes:
        mean: over seeds of the mean over subjects; None where nothing was measured.
        spread: standard deviation over seeds of the mean over subjects; None for a single seed.
        seeds: how many.
        subjects: how many.
        missing: cells that have no such number.
        note: in its place, such as which file of weights it lacks.
        mark: see `marked`.
    """

    mean: float | None
    spread: float | None = None
    seeds: int = 0
    subjects: int = 0
    missing: int = 0
    note: str = ""
    mark: Mark = ""


def summarized(numbers: Mapping[tuple[str, int], float | str | None]) -> Value:
    r"""Mean and spread of one metric of one row.

    $$m = \frac{1}{K} \sum_k \bar x_k, \qquad
    s = \sqrt{\frac{1}{K - 1} \sum_k (\bar x_k - m)^2}, \qquad \bar x_k = \frac{1}{|P_k|} \sum_{p \in P_k} x_{pk}$$

    with seeds $k$ and subjects $p$. A seed of which a subject is missing is left out, as its mean would be of other
    subjects; where no seed is whole, the mean is over what there is and has no spread.

    Args:
        numbers: of each subject and seed that was planned: a number, None where it is missing, or a sentence that says
            why there is none.

    >>> value = summarized({("a", 0): 1.0, ("b", 0): 3.0, ("a", 1): 2.0, ("b", 1): 6.0})
    >>> value.mean, round(value.spread, 3)  # 2 and 4
    (3.0, 1.414)
    """
    subjects = {subject for subject, _ in numbers}
    known = {key: float(x) for key, x in numbers.items() if isinstance(x, int | float)}
    missing = len(numbers) - len(known)
    if not known:
        notes = [x for x in numbers.values() if isinstance(x, str)]
        return Value(None, missing=missing, note=notes[0] if notes else "")
    seeds = sorted({seed for _, seed in numbers})
    whole = [seed for seed in seeds if all((subject, seed) in known for subject in subjects)]
    if not whole:
        mean = statistics.fmean(known.values())
        return Value(mean, None, len({s for _, s in known}), len({p for p, _ in known}), missing)
    means = [statistics.fmean(known[subject, seed] for subject in subjects) for seed in whole]
    spread = statistics.stdev(means) if len(means) > 1 else None
    return Value(statistics.fmean(means), spread, len(means), len(subjects), missing)


def marks(values: Sequence[Value], better: Better) -> list[Mark]:
    """Which numbers of a column are the best and the second best.

    A number is marked only if it is better than the next one by more than the larger of their two spreads. So without
    several seeds nothing is marked, nor is a row with missing cells; the second is marked only behind a best one.

    >>> marks([Value(30.0, 0.1), Value(29.5, 0.1), Value(29.0, 0.2)], "high")
    ['best', 'second', '']
    >>> marks([Value(30.0, 0.1), Value(29.5, 0.6), Value(28.0, 0.2)], "high")
    ['', '', '']
    """
    sign = 1 if better == "high" else -1
    found: list[Mark] = [""] * len(values)
    whole = [i for i, value in enumerate(values) if value.mean is not None and value.missing == 0]
    ranked = sorted(whole, key=lambda i: -sign * (values[i].mean or 0.0))
    names: tuple[Mark, Mark] = ("best", "second")
    for place, name in enumerate(names):
        if place + 1 >= len(ranked) or not _clearly(values[ranked[place]], values[ranked[place + 1]]):
            break
        found[ranked[place]] = name
    return found


def _clearly(first: Value, second: Value) -> bool:
    """Whether two numbers differ by more than the larger of their spreads."""
    if first.mean is None or second.mean is None or first.spread is None or second.spread is None:
        return False
    return abs(first.mean - second.mean) > max(first.spread, second.spread)


@dataclass(frozen=True)
class Difference:
    """How much better one row is than another, over the subjects and seeds that both have.

    Attributes:
        mean: of the differences of pairs; positive where the first row is better.
        deviation: standard deviation of these differences, None for a single pair.
        pairs: how many.
        wins: pairs in which the first row is better.
    """

    mean: float
    deviation: float | None
    pairs: int
    wins: int

    @property
    def verdict(self) -> Literal["better", "worse", "undecided"]:
        r"""Whether the mean difference exceeds twice its standard error, $2 s / \sqrt{n}$."""
        if self.deviation is None or abs(self.mean) <= 2 * self.deviation / math.sqrt(self.pairs):
            return "undecided"
        return "better" if self.mean > 0 else "worse"


def compared(
    first: Mapping[tuple[str, int], float], second: Mapping[tuple[str, int], float], better: Better
) -> Difference | None:
    """The difference of two rows in pairs of equal subject and seed; None where they have none in common.

    >>> compared({("a", 0): 2.0, ("a", 1): 3.0}, {("a", 0): 1.0, ("a", 1): 2.5, ("b", 0): 9.0}, "high")
    Difference(mean=0.75, deviation=0.3535533905932738, pairs=2, wins=2)
    """
    sign = 1 if better == "high" else -1
    differences = [sign * (first[key] - second[key]) for key in sorted(first.keys() & second.keys())]
    if not differences:
        return None
    deviation = statistics.stdev(differences) if len(differences) > 1 else None
    wins = sum(difference > 0 for difference in differences)
    return Difference(statistics.fmean(differences), deviation, len(differences), wins)
