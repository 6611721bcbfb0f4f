"""One HTML page that shows a run: figures, pictures, curves, tables, videos, and how to go on.

The page needs nothing else but its videos, which lie beside it: style and pictures are inside, there is no script, and
it follows the reader's choice of light or dark.
"""

import base64
import html
import io
import itertools
import math
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TypeAlias
from urllib.parse import quote

from PIL import Image

from twofold.errors import TwofoldError
from twofold.files import write_bytes
from twofold.outputs.charts import Chart, Curve, chart_svg
from twofold.outputs.sheets import Picture, as_bytes

__all__ = [
    "Chart", "Commands", "Curve", "Figure", "Row", "Section", "Table", "Verdict", "Video",
    "metrics_table", "number", "verdict", "write_report",
]  # fmt: skip

FILE_NAME = "report.html"
MISSING = "\N{EN DASH}"
"""Shown where there is no number."""


@dataclass(frozen=True)
class Verdict:
    """One of the large numbers at the top.

    Attributes:
        label: what it is.
        value: as it is to be read, "27.1".
        unit: behind the value.
        goal: what it should be, "at least 26 dB"; empty for none.
        met: whether it is.
    """

    label: str
    value: str
    unit: str = ""
    goal: str = ""
    met: bool | None = None


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
class Table:
    """Lines of text under headings; a line of a single cell is a heading within the table."""

    columns: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]


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
    shown = f"<div class=lead>{_film(lead) if isinstance(lead, Video) else _figure(lead)}</div>" if lead else ""
    tiles = "".join(map(_verdict, verdicts))
    body = (
        f"<header class={'split' if lead else 'plain'}><div class=title><p class=brand>{LOGO}twofold</p>"
        f"<h1>{_text(title)}</h1>{_paragraphs(subtitle)}<dl class=verdicts>{tiles}</dl></div>{shown}</header>"
        f"<main>{''.join(map(_section, sections))}</main><footer>{_paragraphs(credit)}</footer>"
    )
    head = (
        '<!doctype html><html lang=en><meta charset=utf-8><meta name=viewport content="width=device-width">'
        f'<meta name=color-scheme content="light dark"><title>{html.escape(title)}</title><style>{STYLE}</style>'
    )
    path = folder / FILE_NAME
    write_bytes(path, f"{head}<body>{body}</body></html>\n".encode())
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
    return f"<section><h2>{_text(section.heading)}</h2>{_paragraphs(section.text)}{''.join(boxes)}</section>"


def _part(part: Part) -> str:
    if isinstance(part, Row):
        label = f"<h3>{_text(part.label)}</h3>" if part.label else ""
        return f"{label}<div class=strip tabindex=0>{''.join(map(_figure, part.figures))}</div>"
    if isinstance(part, Video):
        return _film(part)
    if isinstance(part, Chart):
        return f"<figure>{_legend(part)}{chart_svg(part)}</figure>"
    if isinstance(part, Table):
        return _table(part)
    lines = [f"<div><p>{_text(what)}</p><pre>{html.escape(line)}</pre></div>" for line, what in part.lines]
    return "".join(lines)


def _verdict(v: Verdict) -> str:
    tone = "" if v.met is None else " class=met" if v.met else " class=missed"
    mark = "" if v.met is None else "✓ " if v.met else "✗ "
    goal = f"<dd class=goal>{mark}{html.escape(v.goal)}</dd>" if v.goal else ""
    unit = f" <small>{html.escape(v.unit)}</small>" if v.unit else ""
    return f"<div{tone}><dt>{_text(v.label)}</dt><dd class=value>{html.escape(v.value)}{unit}</dd>{goal}</div>"


def _figure(figure: Figure) -> str:
    caption = f"<figcaption>{_text(figure.caption)}</figcaption>" if figure.caption else ""
    source, (width, height) = _embedded(figure.picture)
    wide = " class=wide" if width > 1.2 * height else ""
    size = f"width={width} height={height}"
    return f'<figure{wide}><img src="{source}" {size} alt="{html.escape(figure.caption)}">{caption}</figure>'


def _film(video: Video) -> str:
    caption = f"<figcaption>{_text(video.caption)}</figcaption>" if video.caption else ""
    attributes = "controls autoplay loop muted playsinline"
    return f'<figure><video src="{quote(video.file)}" {attributes}></video>{caption}</figure>'


def _legend(chart: Chart) -> str:
    names = [curve.name for curve in chart.curves] if len(chart.curves) > 1 else []
    spans = "".join(f"<span class=c{i % 5}>{_text(name)}</span>" for i, name in enumerate(names))
    return f"<figcaption><b>{_text(chart.title)}</b>{spans}</figcaption>"


def _embedded(picture: Path | Picture) -> tuple[str, tuple[int, int]]:
    """The picture as an address that holds it, and its width and height."""
    if isinstance(picture, Path):
        kinds = {".png": "png", ".jpg": "jpeg", ".jpeg": "jpeg", ".webp": "webp"}
        kind = kinds.get(picture.suffix.lower())
        if kind is None or not picture.is_file():
            problem = "is missing" if kind else f"is no {', '.join(kinds)}"
            raise TwofoldError(f"The report's picture {picture} {problem}.")
        content = picture.read_bytes()
        with Image.open(picture) as image:
            size = image.size
    else:
        kind, buffer, image = "png", io.BytesIO(), Image.fromarray(as_bytes(picture))
        image.save(buffer, "PNG", optimize=True)
        content, size = buffer.getvalue(), image.size
    return f"data:image/{kind};base64,{base64.b64encode(content).decode()}", size


def _table(table: Table) -> str:
    rows: list[str] = []
    for row in table.rows:
        if len(row) == 1:
            rows.append(f"<tr class=group><th colspan={len(table.columns)}>{_text(row[0])}</th></tr>")
        else:
            rows.append(f"<tr>{''.join(f'<td>{_text(cell)}</td>' for cell in row)}</tr>")
    head = "".join(f"<th>{_text(name)}</th>" for name in table.columns)
    return f"<table><thead><tr>{head}</tr></thead><tbody>{''.join(rows)}</tbody></table>"


def _text(text: str) -> str:
    """Escaped text with `code` and links."""
    escaped = re.sub(r"`([^`]+)`", r"<code>\1</code>", html.escape(text))
    return re.sub(r"https?://[^\s<]*[^\s<.,;:)]", r'<a href="\g<0>">\g<0></a>', escaped)


def _paragraphs(text: str) -> str:
    return "".join(f"<p>{_text(paragraph)}</p>" for paragraph in re.split(r"\n\s*\n", text.strip()) if paragraph)


LOGO = (
    "<svg viewBox='0 0 24 24' aria-hidden=true><path d='M3 5l9-3v17l-9 3z' opacity=.55 />"
    "<path d='M12 2l9 3v17l-9-3z'/></svg>"
)
STYLE = """
:root{--paper:#fbfbfa;--card:#fff;--ink:#1d2026;--faint:#636975;--line:#e3e4e6;--accent:#1f6f8b;--good:#1c7a4d;
--bad:#b3491b;--c0:#1f6f8b;--c1:#d1662a;--c2:#3d9a5f;--c3:#8a56b8;--c4:#7d838d}
@media(prefers-color-scheme:dark){:root{--paper:#14161a;--card:#1c1f25;--ink:#e9eaec;--faint:#9aa1ac;--line:#30343c;
--accent:#6fc1dc;--good:#62c794;--bad:#ef9a6b;--c0:#6fc1dc;--c1:#f0995f;--c2:#7fd09c;--c3:#c29be6;--c4:#a3a9b3}}
*{box-sizing:border-box}
body{margin:0;background:var(--paper);color:var(--ink);font:16px/1.55 system-ui,-apple-system,"Segoe UI",Roboto,
"Helvetica Neue",Arial,sans-serif;-webkit-text-size-adjust:100%}
header,main,footer{max-width:1120px;margin:auto;padding:0 28px}
header{padding-top:48px;padding-bottom:12px}
.split{display:grid;grid-template-columns:1fr minmax(240px,340px);gap:44px;align-items:center}
.brand{margin:0 0 10px;color:var(--accent);font-weight:600;letter-spacing:.02em;display:flex;gap:8px;align-items:center}
.brand svg{width:20px;fill:currentColor}
h1{font-size:clamp(28px,4.4vw,44px);line-height:1.12;letter-spacing:-.02em;margin:0 0 12px;text-wrap:balance}
h2{font-size:24px;letter-spacing:-.01em;line-height:1.2;margin:0 0 8px}
h3{font-size:15px;margin:22px 0 8px}
header p:not(.brand){color:var(--faint);margin:0 0 8px;max-width:62ch}
section{padding:36px 0 12px;border-top:1px solid var(--line);margin-top:36px}
section>p{max-width:72ch;margin:0 0 12px}
a{color:var(--accent)}
code,pre,td:first-child{font-family:ui-monospace,SFMono-Regular,Menlo,Consolas,"DejaVu Sans Mono",monospace;
font-size:.88em}
figure{margin:0;min-width:0}
img,video{display:block;width:100%;height:auto;border-radius:8px;background:#fff;outline:1px solid var(--line)}
figcaption{color:var(--faint);font-size:14px;line-height:1.4;margin-top:7px}
.verdicts{display:grid;grid-template-columns:repeat(auto-fit,minmax(148px,1fr));gap:12px;margin:26px 0 0}
.verdicts>div{background:var(--card);border:1px solid var(--line);border-radius:12px;padding:14px 16px}
.verdicts dt{color:var(--faint);font-size:14px;line-height:1.3}
.verdicts dd{margin:0}
.value{font-size:30px;font-weight:650;letter-spacing:-.02em;line-height:1.3;white-space:nowrap;
font-variant-numeric:tabular-nums}
.value small{font-size:15px;font-weight:400;letter-spacing:0;color:var(--faint)}
.goal{font-size:13px;color:var(--faint)}
.met .goal{color:var(--good)}.missed .goal{color:var(--bad)}
.strip{display:grid;grid-auto-flow:column;grid-auto-columns:minmax(0,1fr);gap:12px;margin:14px 0 6px;align-items:start}
.charts,.videos{display:grid;grid-template-columns:repeat(auto-fit,minmax(min(100%,420px),1fr));gap:22px;margin:16px 0}
.videos{grid-template-columns:repeat(auto-fill,minmax(min(100%,300px),1fr))}
.charts figure{background:var(--card);border:1px solid var(--line);border-radius:12px;padding:14px 16px 8px;
max-width:549px}
.charts figcaption{margin:0 0 6px;display:flex;gap:4px 16px;flex-wrap:wrap}
.charts b{color:var(--ink);font-weight:600;margin-right:auto}
.charts span::before{content:"";display:inline-block;width:12px;height:3px;border-radius:2px;background:var(--c);
margin-right:6px;vertical-align:middle}
.c0{--c:var(--c0)}.c1{--c:var(--c1)}.c2{--c:var(--c2)}.c3{--c:var(--c3)}.c4{--c:var(--c4)}
svg{overflow:visible}
svg text{font-size:13px;fill:var(--faint);font-variant-numeric:tabular-nums}
.grid{stroke:var(--line)}
polyline{fill:none;stroke:var(--c);stroke-width:2;stroke-linejoin:round;stroke-linecap:round}
.range{fill:var(--c);opacity:.16}
table{border-collapse:collapse;width:100%;margin:12px 0;font-size:15px}
th,td{text-align:left;padding:7px 14px 7px 0;border-bottom:1px solid var(--line);vertical-align:baseline}
thead th{color:var(--faint);font-weight:500;font-size:14px}
.group th{padding-top:20px;font-weight:600}
td:nth-child(2){font-variant-numeric:tabular-nums;font-weight:600;white-space:nowrap}
td:nth-child(3){color:var(--faint)}
.commandss p{margin:16px 0 4px}
pre{background:var(--card);border:1px solid var(--line);border-radius:8px;padding:11px 14px;margin:0;overflow-x:auto;
user-select:all}
footer{padding-top:28px;padding-bottom:48px;color:var(--faint);font-size:14px}
footer p{margin:0;max-width:80ch}
@media(max-width:760px){header,main,footer{padding-left:18px;padding-right:18px}header{padding-top:28px}
.split{grid-template-columns:1fr;gap:26px}.lead{max-width:420px}section{margin-top:22px;padding-top:26px}
.verdicts{grid-template-columns:1fr 1fr}.value{font-size:25px}svg text{font-size:17px}
.strip{grid-auto-columns:minmax(148px,1fr);overflow-x:auto;margin-left:-18px;margin-right:-18px;padding:2px 18px 6px}
.strip .wide{min-width:680px}.strip .wide:not(:only-child){min-width:260px}
thead{display:none}tr{display:grid;grid-template-columns:1fr auto;border-bottom:1px solid var(--line);padding:7px 0}
th,td{border:0;padding:0}td:nth-child(3){grid-column:1/-1;font-size:14px}.group{border:0;padding-top:18px}}
@media print{body{background:#fff}section,figure{break-inside:avoid}}
""".strip()
