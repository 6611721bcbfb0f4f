"""A table from its cells: Markdown and LaTeX to read, JSON with every number's origin, CSV with every image."""

import csv
import io
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, cast

from twofold.files import json_text, write_together
from twofold.reproduce.experiments import EXPERIMENTS, Column, PlannedCell, TableRow
from twofold.reproduce.printed import AVERAGE, NOTES, printed
from twofold.reproduce.summary import Value, marks, summarized

EXPLAINED = (
    "In parentheses: the paper's number, of its own subjects and full training. ± is the standard deviation over seeds "
    "of the mean over subjects. Best in bold and second best underlined, only where the difference to the next one is "
    "larger than both spreads; with one seed nothing is marked."
)


@dataclass(frozen=True)
class TableLine:
    """A line of a table.

    Attributes:
        subject: whose, or "" for the mean of all.
        row: how was trained.
        values: a column each.
        printed: the paper's numbers for each column; None where it has none.
    """

    subject: str
    row: TableRow
    values: tuple[Value, ...]
    printed: tuple[tuple[float | None, ...], ...]


@dataclass(frozen=True)
class FilledTable:
    """A table ready to be written.

    Attributes:
        name: of the experiment.
        title: above it.
        columns: metrics.
        lines: rows.
        notes: below it.
        cells: key, row, subject and seed of every cell, and whether it is done or why it failed.
        about: data, recipe and settings.
    """

    name: str
    title: str
    columns: tuple[Column, ...]
    lines: tuple[TableLine, ...]
    notes: tuple[str, ...]
    cells: tuple[dict[str, Any], ...]
    about: dict[str, Any]


def fill(name: str, planned: Sequence[PlannedCell], out: Path, about: dict[str, Any]) -> FilledTable:
    """The table of an experiment from the cells that are done; what is missing is said, not guessed.

    Args:
        name: of the experiment.
        planned: all its cells.
        out: folder of the experiment.
        about: data, recipe and settings, to be stored with the table.

    Raises:
        TwofoldError: a stored file is damaged.
    """
    experiment = EXPERIMENTS[name]
    results = {place.cell.key: place.cell.results(out) for place in planned}
    rows = list({place.row.key: place.row for place in planned}.values())
    subjects = list(dict.fromkeys(place.subject for place in planned))
    lines: list[TableLine] = []
    for group in [[subject] for subject in subjects] if experiment.by_subject else [subjects]:
        shown = group[0] if experiment.by_subject else AVERAGE
        filled = [
            [_value(column, [p for p in planned if p.row.key == row.key and p.subject in group], results)
             for column in experiment.columns]
            for row in rows
        ]  # fmt: skip
        for number, column in enumerate(experiment.columns):
            for values, mark in zip(filled, marks([values[number] for values in filled], column.better), strict=True):
                values[number] = replace(values[number], mark=mark)
        for row, values in zip(rows, filled, strict=True):
            paper = tuple(
                tuple(printed(name, shown, row.printed, c) for c in col.printed) for col in experiment.columns
            )
            lines.append(TableLine(shown, row, tuple(values), paper))
    cells = [
        {"key": p.cell.key, "row": p.row.label, "subject": p.subject, "seed": p.seed, "recipe": p.cell.recipe.name,
         "state": "done" if results[p.cell.key] is not None else p.cell.failure(out) or "not done",
         "made_with": (results[p.cell.key] or {}).get("made_with")}
        for p in planned
    ]  # fmt: skip
    missing = [cell for cell in cells if cell["state"] != "done"]
    notes = [EXPLAINED, *NOTES[name]]
    if missing:
        notes.insert(0, f"{len(missing)} of {len(cells)} cells are missing; numbers are of the others.")
        notes += [
            f"{c['row']}, {c['subject']}, seed {c['seed']}: {c['state']}" for c in missing if c["state"] != "not done"
        ]
    notes += _programs(cells)
    lacking = {v.note for line in lines for v in line.values if v.note}
    notes += [f"n/a: {note.removeprefix('n/a ').strip('()')}." for note in sorted(lacking)]
    return FilledTable(name, experiment.title, experiment.columns, tuple(lines), tuple(notes), tuple(cells), about)


def _value(column: Column, planned: list[PlannedCell], results: dict[str, dict[str, Any] | None]) -> Value:
    def number(place: PlannedCell) -> float | str | None:
        found = (results[place.cell.key] or {}).get(column.section)
        return found.get(column.metric) if isinstance(found, dict) else None

    return summarized({(place.subject, place.seed): number(place) for place in planned})


def _number(value: Value, digits: int, plus: str) -> str:
    if value.mean is None:
        return "n/a" if value.note else "-"
    spread = "" if value.spread is None else f" {plus} {value.spread:.{digits}f}"
    return f"{value.mean:.{digits}f}{spread}"


def _paper(numbers: tuple[float | None, ...], digits: int) -> str:
    known = [x for x in numbers if x is not None]
    return " / ".join(f"{x:.{min(digits, 3)}f}" for x in known)


def markdown(table: FilledTable) -> str:
    """The table with its notes as Markdown."""
    subjects = any(line.subject for line in table.lines)
    arrows = {"high": "↑", "low": "↓"}
    head = ["Subject"] * subjects + [""] + [f"{column.title} {arrows[column.better]}" for column in table.columns]
    body: list[list[str]] = [head, ["---"] * (1 + subjects) + ["---:"] * len(table.columns)]
    wraps = {"": "{}", "best": "**{}**", "second": "<u>{}</u>"}
    for line in table.lines:
        words = [line.subject] * subjects + [line.row.label]
        for value, column, paper in zip(line.values, table.columns, line.printed, strict=True):
            theirs = _paper(paper, column.digits)
            shown = wraps[value.mark].format(_number(value, column.digits, "±"))
            words.append(shown + (f" ({theirs})" if theirs else ""))
        body.append(words)
    rows = "\n".join(f"| {' | '.join(cell.replace('|', '/') for cell in words)} |" for words in body)
    about = _about(table.about)
    notes = "\n".join(f"- {note}" for note in table.notes)
    return f"# {table.title}\n\nMade by `twofold reproduce {table.name}`: {about}.\n\n{rows}\n\n{notes}\n"


def _about(about: Mapping[str, Any]) -> str:
    """Where a table comes from, for people.

    >>> _about({"data": "studio", "subjects": ["studio 101", "studio 102"], "seeds": 2, "settings": []})
    'data studio; subjects studio 101, studio 102; seeds 2'
    >>> _about({"measures": {"max_images": 30, "video": True, "weights": None}})
    'max_images 30, video True'
    """
    said: list[str] = []
    for name, value in about.items():
        if isinstance(value, Mapping):
            parts = cast("Mapping[str, Any]", value)
            said.append(", ".join(f"{key} {part}" for key, part in parts.items() if part not in (None, False)))
        elif isinstance(value, (list, tuple)) and value:
            said.append(f"{name} {', '.join(map(str, cast('Sequence[Any]', value)))}")
        elif value not in ((), [], None, ""):
            said.append(f"{name} {value}")
    return "; ".join(said)


_LATEX = {
    "\\": r"\textbackslash{}", "&": r"\&", "%": r"\%", "$": r"\$", "#": r"\#", "_": r"\_", "{": r"\{", "}": r"\}",
    "~": r"\textasciitilde{}", "^": r"\textasciicircum{}",
}  # fmt: skip
_LABELS = {
    "w/o {s1, c1}": r"w/o $\{s_1, c_1\}$", "w/o {s2, c2}": r"w/o $\{s_2, c_2\}$",
    "w/o L_com": r"w/o $\mathcal{L}_\mathrm{com}$", "Pose_lf": r"$\mathrm{Pose}_{lf}$", "V2A*": r"V2A$^*$",
    "V2A_mask": r"V2A$_{mask}$",
}  # fmt: skip


def escaped(text: str) -> str:
    r"""Text as LaTeX prints it.

    >>> escaped("50 % of CoreView_377")
    '50 \\% of CoreView\\_377'
    """
    return "".join(_LATEX.get(letter, letter) for letter in text)


def latex(table: FilledTable) -> str:
    """The table as LaTeX with the package booktabs; notes stand above it as comments."""
    subjects = any(line.subject for line in table.lines)
    arrows = {"high": r"$\uparrow$", "low": r"$\downarrow$"}
    head = [""] * (1 + subjects) + [f"{escaped(column.title)}{arrows[column.better]}" for column in table.columns]
    wraps = {"": "{}", "best": r"\textbf{{{}}}", "second": r"\underline{{{}}}"}
    rows: list[str] = []
    last = ""
    for line in table.lines:
        if rows and line.subject != last:
            rows.append(r"\midrule")
        label = _LABELS.get(line.row.label, escaped(line.row.label))
        words = [escaped(line.subject if line.subject != last else "")] * subjects + [label]
        last = line.subject
        for value, column, paper in zip(line.values, table.columns, line.printed, strict=True):
            theirs = _paper(paper, column.digits)
            shown = wraps[value.mark].format(_number(value, column.digits, r"$\pm$"))
            words.append(shown + (rf" {{\scriptsize ({theirs})}}" if theirs else ""))
        # Braces in front: a line that begins with a bracket would be taken for the argument of the one before.
        rows.append("{}" + " & ".join(words) + r" \\")
    comments = "".join(f"% {note}\n" for note in table.notes)
    columns = "l" * (1 + subjects) + "r" * len(table.columns)
    lines = [rf"\begin{{tabular}}{{{columns}}}", r"\toprule", " & ".join(head) + r" \\", r"\midrule", *rows]
    return comments + "\n".join([*lines, r"\bottomrule", r"\end{tabular}"]) + "\n"


def as_json(table: FilledTable) -> dict[str, Any]:
    """The table as data: each number with its spread, count, mark and the paper's numbers, and every cell's key."""
    lines = [
        {
            "subject": line.subject, "row": line.row.label,
            "values": {
                column.title: {**asdict(value), "printed": list(paper)}
                for column, value, paper in zip(table.columns, line.values, line.printed, strict=True)
            },
        }
        for line in table.lines
    ]  # fmt: skip
    columns = [asdict(column) for column in table.columns]
    return {
        "experiment": table.name, "title": table.title, "about": table.about, "columns": columns, "lines": lines,
        "notes": list(table.notes), "cells": list(table.cells),
    }  # fmt: skip


def _programs(cells: Sequence[Mapping[str, Any]]) -> list[str]:
    """A note where trainings of the cells began with different versions of the program.

    >>> _programs([{"state": "done", "made_with": "0.1.0"}] * 2)
    []
    >>> (note,) = _programs([{"state": "done", "made_with": "0.1.0"}, {"state": "done", "made_with": "0.2.0"}])
    >>> note.partition("; ")[0]
    'Cells were trained with different versions of twofold: 0.1.0 (1), 0.2.0 (1)'
    """
    names = [cell["made_with"] for cell in cells if cell["state"] == "done"]
    counts = Counter(name if isinstance(name, str) else "an unknown one" for name in names)
    if len(counts) < 2:
        return []
    told = ", ".join(f"{name} ({count})" for name, count in sorted(counts.items()))
    return [
        f"Cells were trained with different versions of twofold: {told}; to train one again, delete its folder "
        "cells/KEY (keys are in the table's JSON)."
    ]


def image_rows(planned: Sequence[PlannedCell], out: Path) -> list[dict[str, Any]]:
    """A row for each measured image: row, subject, seed, cell, then what `measuring` stored of it."""
    rows: list[dict[str, Any]] = []
    for place in planned:
        about = {"row": place.row.label, "subject": place.subject, "seed": place.seed, "cell": place.cell.key}
        rows += [about | image for image in (place.cell.results(out) or {}).get("images", [])]
    return rows


def csv_text(rows: Sequence[dict[str, Any]]) -> str:
    """Rows as CSV; columns are those of all rows in the order of their first appearance."""
    names = list(dict.fromkeys(name for row in rows for name in row))
    text = io.StringIO()
    writer = csv.DictWriter(text, names, lineterminator="\n")
    writer.writeheader()
    writer.writerows(
        {name: f"{value:.6g}" if isinstance(value, float) else value for name, value in row.items()} for row in rows
    )
    return text.getvalue()


def write_table(table: FilledTable, rows: Sequence[dict[str, Any]], folder: Path, stem: str) -> Path:
    """Writes STEM.md, .tex, .json and .csv, all or none; returns the first.

    Raises:
        TwofoldError: the folder cannot be written.
    """
    contents = {
        f"{stem}.md": markdown(table), f"{stem}.tex": latex(table), f"{stem}.json": json_text(as_json(table)) + "\n",
        f"{stem}.csv": csv_text(rows),
    }  # fmt: skip
    write_together(folder, {name: text.encode() for name, text in contents.items()})
    return folder / f"{stem}.md"
