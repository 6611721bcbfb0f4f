"""The part of `docs/results.md` that says whether the factorization is worth it, from stored studies."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

from twofold.reproduce.summary import Difference, compared

FULL = ("Ours", "[6 cm, 1 cm] (full)", "[5, 10] (full)")
"""What the full model is called."""
COMPARED = (
    ("novel_pose.psnr_box", "high", "Novel pose, dB", "pose PSNR"),
    ("novel_view.psnr_box", "high", "Novel view, dB", "view PSNR"),
    ("novel_pose.gradient_error", "low", "Novel pose, gradient error x 1000", ""),
    ("geometry.chamfer_cm", "low", "Surface, mm", ""),
)
"""Metric, which way is better, what it is called, the paper's column."""
VERDICTS = {"better": "better than", "worse": "worse than", "undecided": "undecided against"}
SCALE = {"novel_pose.gradient_error": 1000.0, "geometry.chamfer_cm": 10.0}

Table = Callable[[Sequence[str], Iterable[Sequence[str]]], str]


def differences(study: Mapping[str, Any], metric: str, better: str) -> dict[str, Difference]:
    """How much better the full model is than each other row, in pairs of equal subject and seed."""
    rows = study["rows"]
    full = next((rows[name] for name in FULL if name in rows), {})
    found: dict[str, Difference] = {}
    for row, numbers in rows.items():
        if row in FULL or metric not in numbers or metric not in full:
            continue
        scale = SCALE.get(metric, 1.0)
        pairs = [{(where, 0): scale * x for where, x in part[metric].items()} for part in (full, numbers)]
        difference = compared(pairs[0], pairs[1], better)  # type: ignore[arg-type]
        if difference is not None:
            found[row] = difference
    return found


def answer(study: Mapping[str, Any]) -> str:
    """The first paragraph: in which orderings the full model wins by more than the noise, and what follows."""
    pose = differences(study, *COMPARED[0][:2])
    view = differences(study, *COMPARED[1][:2])
    pairs = min((d.pairs for d in pose.values()), default=0)
    said = [
        f"**Is the factorization worth it?** Measured on {_size(study)}, full model against each ablation in pairs of "
        f"equal subject and seed ({pairs} pairs)."
    ]
    if pairs < 2:
        said.append("A single training of each decides nothing; the numbers below are differences without a spread.")
        return " ".join(said)
    for name, found in (("novel poses", pose), ("novel views", view)):
        parts = [
            f"{word} {_listed([row for row, d in found.items() if d.verdict == verdict])}"
            for verdict, word in VERDICTS.items()
            if any(d.verdict == verdict for d in found.values())
        ]
        said.append(f"In {name} the full model is {'; '.join(parts)}.")
    alone = [d for row, d in pose.items() if row in ("w/o {s1, c1}", "w/o {s2, c2}")]
    both = [d.verdict == "better" for d in alone]
    if both and all(both):
        said.append("Two branches beat either one alone in novel poses, as the paper says.")
    elif any(d.verdict == "worse" for d in alone):
        said.append("A single branch does as well or better in novel poses: at this scale, no.")
    else:
        said.append("At this scale an advantage over both single branches is not shown beyond the noise.")
    return " ".join(said)


def against_methods(study: Mapping[str, Any]) -> str:
    """A sentence: which of the methods that the paper compares with the full model beats by more than the noise."""
    found = differences(study, *COMPARED[0][:2])
    verdicts = {verdict: [row for row, d in found.items() if d.verdict == verdict] for verdict in VERDICTS}
    parts = [f"{words} {_listed(verdicts[verdict])}" for verdict, words in VERDICTS.items() if verdicts[verdict]]
    if not parts:
        return ""
    minutes = study.get("minutes", {})
    (own,) = [minutes.get(row) for row in study["rows"] if row in FULL]
    spent = [minutes[row] for row in found if row in minutes]
    if own is None or len(spent) < len(found):
        trained = f"after {' or '.join(f'{count:,}' for count in sorted(set(study['steps'].values())))} steps each"
    else:
        trained = f"trained for {min(spent):.0f} to {max(spent):.0f} minutes of one core each (itself: {own:.1f})"
    return f" Of the other methods, {trained}, it is {'; '.join(parts)} in novel poses."


def section(study: Mapping[str, Any], table: Table) -> str:
    """A table of differences with the paper's beside them, and the PSNR by distance from the training poses."""
    columns = [entry for entry in COMPARED if differences(study, *entry[:2])]
    lengths = _lengths(study)
    head = ["Full model against", *(["Training"] if lengths else []), *[title for _, _, title, _ in columns]]
    rows: list[list[str]] = []
    others = [row for row in study["rows"] if row not in FULL]
    for row in others:
        words = [row, *([lengths[row]] if lengths else [])]
        for metric, better, _, column in columns:
            found = differences(study, metric, better).get(row)
            words.append("-" if found is None else _words(found, _papers(study, row, column)))
        rows.append(words)
    paper = ""
    if any(_papers(study, row, column) is not None for row in others for *_, column in columns):
        paper = f"; in parentheses the paper's difference {_papers_subjects(study)}"
    bins = study["extreme"]["bins"]
    head_extreme = ["Row", *[f"bin {number + 1}" for number in range(max(map(len, bins.values()), default=0))]]
    extreme = [
        [row, *[f"{value:.2f} ± {error:.2f} dB at {away:.1f}°" for away, value, error, _ in points]]
        for row, points in bins.items()
    ]
    return (
        f"By how much the full model is better (a negative number: worse): mean of the pairs ± their standard "
        f"deviation, pairs won; bold where the mean exceeds two standard errors{paper}. "
        f"{_size(study, capital=True)}.{_full_length(lengths)}\n\n{table(head, rows)}\n"
        f"PSNR over the box in novel poses, by the distance to the nearest training pose (bins of equally many frames, "
        f"mean ± standard error over images):\n\n{table(head_extreme, extreme)}"
    )


def _lengths(study: Mapping[str, Any]) -> dict[str, str]:
    """Steps and processor minutes of each row's training, where rows differ in their steps; else nothing."""
    steps, minutes = study["steps"], study.get("minutes", {})
    if len(set(steps.values())) < 2:
        return {}
    return {
        row: f"{count:,} steps" + (f", {minutes[row]:.1f} min" if row in minutes else "")
        for row, count in steps.items()
    }


def _full_length(lengths: Mapping[str, str]) -> str:
    return "".join(f" Training of the full model: {lengths[row]}." for row in FULL if row in lengths)


def _papers_subjects(study: Mapping[str, Any]) -> str:
    return "over its subjects" if study.get("experiment") == "main" else "on its subject 394"


def _words(difference: Difference, paper: float | None) -> str:
    spread = "" if difference.deviation is None else f" ± {difference.deviation:.2f}"
    text = f"{difference.mean:+.2f}{spread}"
    text = f"**{text}**" if difference.verdict != "undecided" else text
    return f"{text}, {difference.wins} of {difference.pairs}" + ("" if paper is None else f" ({paper:+.2f})")


def _papers(study: Mapping[str, Any], row: str, column: str) -> float | None:
    printed = study["printed"]
    full = next((printed[name] for name in FULL if name in printed), {})
    theirs = [part.get(column, [None])[0] for part in (full, printed.get(row, {}))]
    return None if None in theirs else theirs[0] - theirs[1]


def _size(study: Mapping[str, Any], capital: bool = False) -> str:
    about = study["about"]
    seeds, subjects = about["seeds"], len(about["subjects"])
    steps = sorted(set(study["steps"].values()))
    settings = f", {', '.join(f'`{s}`' for s in about['settings'])}" if about["settings"] else ""
    size = f" of {about['size']} x {about['size']}" if about.get("size") else ""
    text = (
        f"{subjects} held-out synthetic subject{'s' * (subjects > 1)}{size}, {seeds} seed{'s' * (seeds > 1)} each"
        f"{_fewer_seeds(study)}, "
        f"recipe `{about['recipe']}`{f' with {steps[0]} steps' if len(steps) == 1 else ''}{settings}"
    )
    return text[0].upper() + text[1:] if capital else text


def _fewer_seeds(study: Mapping[str, Any]) -> str:
    """Which rows were trained with fewer seeds than the full model, in parentheses."""

    def pairs(row: str) -> int:
        return max((len(numbers) for numbers in study["rows"][row].values()), default=0)

    most = max((pairs(row) for row in study["rows"] if row in FULL), default=0)
    fewer: dict[int, list[str]] = {}
    for row in study["rows"]:
        if pairs(row) < most:
            fewer.setdefault(pairs(row), []).append(row)
    said = [f"{_listed(rows)} {count} of {most} trainings" for count, rows in sorted(fewer.items())]
    return f" ({'; '.join(said)})" if said else ""


def _listed(names: Sequence[str]) -> str:
    return names[0] if len(names) == 1 else f"{', '.join(names[:-1])} and {names[-1]}"
