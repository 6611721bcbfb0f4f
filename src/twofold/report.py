"""One HTML page that shows a run: figures, pictures, curves, tables, videos, and how to go on.

The page needs nothing else but its videos, which lie beside it: style and pictures are inside, there is no script, and
it follows the reader's choice of light or dark.
"""

import html
import itertools
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TypeAlias
from urllib.parse import quote

from twofold.errors import TwofoldError
from twofold.files import write_bytes
from twofold.html.charts import Chart, Curve, chart_svg
from twofold.html.page import Table, Verdict, document, embedded, header, inline, paragraphs, table_html, tiles
from twofold.outputs.sheets import Picture, as_bytes

__all__ = [
    "Chart", "Commands", "Curve", "Figure", "Row", "Section", "Table", "Verdict", "Video",
    "metrics_table", "number", "verdict", "write_report",
]  # fmt: skip

FILE_NAME = "report.html"
MISSING = "\N{EN DASH}"
"""Shown where there is no number."""


@dataclass(frozen=True)
class Figure:
    """A picture, put into the page, with a caption: a file (PNG, JPEG, WebP) or colours."""

    picture: Path | Picture
    caption: str = ""


@dataclass(frozen=True)
class Row:
    """Pictures to be compared side by side; on a phone they scroll sideways together."""

    figures: tuple[Figure, ...]
    label: str = ""


@dataclass(frozen=True)
class Video:
    """A film in the page's folder or below, named by its path from there."""

    file: str
    caption: str = ""


@dataclass(frozen=True)
class Commands:
    """Lines for a terminal, each with what it does."""

    lines: tuple[tuple[str, str], ...]


Part: TypeAlias = Row | Video | Chart | Table | Commands


@dataclass(frozen=True)
class Section:
    """A heading, text (blank lines part paragraphs, `code` in backticks, addresses become links), and what it shows."""

    heading: str
    text: str = ""
    parts: tuple[Part, ...] = ()


def write_report(
    folder: Path,
    title: str,
    sections: Sequence[Section],
    subtitle: str = "",
    verdicts: Sequence[Verdict] = (),
    lead: Figure | Video | None = None,
    credit: str = "",
) -> Path:
    """Writes `report.html` into a folder and returns its path.

    Args:
        folder: exists; the videos lie in it.
        title: of the page.
        sections: in order.
        subtitle: one line under the title: capture, recipe, time.
        verdicts: the numbers to see first.
        lead: a picture or film beside the title.
        credit: whom to name; at the foot.

    Raises:
        TwofoldError: a video or picture is missing, or the page cannot be written.
    """
    films = [p for s in sections for p in s.parts if isinstance(p, Video)]
    for film in [*films, *([lead] if isinstance(lead, Video) else [])]:
        if not (folder / film.file).is_file():
            raise TwofoldError(f"The report's video {folder / film.file} is missing; render it first.")
    shown = (_film(lead) if isinstance(lead, Video) else _figure(lead)) if lead else ""
    body = (
        f"{header(title, paragraphs(subtitle) + tiles(verdicts), shown)}"
        f"<main>{''.join(map(_section, sections))}</main><footer>{paragraphs(credit)}</footer>"
    )
    path = folder / FILE_NAME
    write_bytes(path, document(title, body))
    return path


def verdict(
    metrics: Mapping[str, object],
    key: str,
    label: str,
    unit: str = "",
    at_least: float | int | None = None,
    at_most: float | int | None = None,
) -> Verdict:
    """The verdict on one number of a metrics file, named by its dotted key; a dash where it was not measured."""
    value = _found(metrics, key)
    sign, goal = ("≥", at_least) if at_least is not None else ("≤", at_most)
    wanted = "" if goal is None else f"goal {sign} {goal:g} {unit}".strip()
    if not isinstance(value, int | float) or not math.isfinite(value):
        return Verdict(label, MISSING, "", wanted, None if goal is None else False)
    met = None if goal is None else (value >= goal if at_least is not None else value <= goal)
    return Verdict(label, f"{value:.{0 if abs(value) >= 100 else 2}f}", unit, wanted, met)


def metrics_table(metrics: Mapping[str, object]) -> Table:
    """Every number of a metrics file with its protocol, section by section; lists (of single pictures) are left out.

    >>> metrics_table({"novel_view": {"psnr": {"value": 30.0, "protocol": "whole picture"}, "pictures": 6}}).rows
    (('Novel view',), ('psnr', '30.00', 'whole picture'), ('pictures', '6', ''))
    """
    return Table(("number", "value", "how it was measured"), tuple(_metric_rows(metrics, "")))


def number(value: float | int) -> str:
    """A number with as many digits as help.

    >>> [number(v) for v in (27.123, 0.97034, 1728, 151.26, 0.00002)]
    ['27.12', '0.9703', '1,728', '151.3', '2.0e-05']
    """
    if isinstance(value, int) or abs(value) >= 1000:
        return f"{value:,.0f}"
    if 0 < abs(value) < 1e-3:
        return f"{value:.1e}"
    return f"{value:.{1 if abs(value) >= 100 else 2 if abs(value) >= 1 else 4}f}"


def _found(metrics: Mapping[str, object], key: str) -> object:
    value: object = metrics
    for name in [*key.split("."), "value"]:
        if isinstance(value, Mapping):
            value = value.get(name)
        elif name != "value":
            return None
    return value


def _metric_rows(metrics: Mapping[str, object], heading: str) -> Iterator[tuple[str, ...]]:
    """Plain values first, under their section's heading, then the sections within."""
    sections = {k: v for k, v in metrics.items() if isinstance(v, Mapping) and "value" not in v}
    plain = {k: v for k, v in metrics.items() if k not in sections and not isinstance(v, list)}
    if plain and heading:
        yield (heading,)
    for key, entry in plain.items():
        value, protocol = (entry["value"], entry.get("protocol", "")) if isinstance(entry, Mapping) else (entry, "")
        shown = number(value) if isinstance(value, float) or type(value) is int else value
        yield key, MISSING if shown is None else str(shown), str(protocol)
    for key, entry in sections.items():
        name = key.replace("_", " ").capitalize()
        yield from _metric_rows(entry, f"{heading}, {name.lower()}" if heading else name)


def _section(section: Section) -> str:
    """Parts of one kind that follow each other share a box, so that charts stand side by side."""
    boxes = [
        f"<div class={kind.__name__.lower()}s>{''.join(map(_part, parts))}</div>"
        for kind, parts in itertools.groupby(section.parts, type)
    ]
    return f"<section><h2>{inline(section.heading)}</h2>{paragraphs(section.text)}{''.join(boxes)}</section>"


def _part(part: Part) -> str:
    if isinstance(part, Row):
        label = f"<h3>{inline(part.label)}</h3>" if part.label else ""
        return f"{label}<div class=strip tabindex=0>{''.join(map(_figure, part.figures))}</div>"
    if isinstance(part, Video):
        return _film(part)
    if isinstance(part, Chart):
        return f"<figure>{_legend(part)}{chart_svg(part)}</figure>"
    if isinstance(part, Table):
        return table_html(part)
    lines = [f"<div><p>{inline(what)}</p><pre>{html.escape(line)}</pre></div>" for line, what in part.lines]
    return "".join(lines)


def _figure(figure: Figure) -> str:
    caption = f"<figcaption>{inline(figure.caption)}</figcaption>" if figure.caption else ""
    picture = figure.picture if isinstance(figure.picture, Path) else as_bytes(figure.picture)
    source, (width, height) = embedded(picture)
    wide = " class=wide" if width > 1.2 * height else ""
    size = f"width={width} height={height}"
    return f'<figure{wide}><img src="{source}" {size} alt="{html.escape(figure.caption)}">{caption}</figure>'


def _film(video: Video) -> str:
    caption = f"<figcaption>{inline(video.caption)}</figcaption>" if video.caption else ""
    attributes = "controls autoplay loop muted playsinline"
    return f'<figure><video src="{quote(video.file)}" {attributes}></video>{caption}</figure>'


def _legend(chart: Chart) -> str:
    names = [curve.name for curve in chart.curves] if len(chart.curves) > 1 else []
    spans = "".join(f"<span class=c{i % 5}>{inline(name)}</span>" for i, name in enumerate(names))
    return f"<figcaption><b>{inline(chart.title)}</b>{spans}</figcaption>"
