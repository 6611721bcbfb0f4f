"""One HTML page that shows a run: metrics, images, curves, tables, videos, and how to go on.

The page is one file: style, images, videos and the interactive character are inside, and nothing is loaded from
anywhere. It follows the reader's choice of light or dark.
"""

import itertools
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeAlias

from twofold.files import write_bytes
from twofold.html.charts import Chart, Curve, curves_svg
from twofold.html.interactive import InteractiveCharacter, client_script, content_policy, script_credit
from twofold.html.page import EmbeddedImage, KeyMetric, Table, embedded_image, embedded_video, render
from twofold.outputs.sheets import SheetImage, as_bytes

__all__ = [
    "CaptionedImage", "Chart", "Commands", "Curve", "InteractiveCharacter", "KeyMetric", "Row", "Section", "Table",
    "Video",
    "key_metric", "metrics_table", "number", "write_report",
]  # fmt: skip

FILE_NAME = "report.html"
MISSING = "\N{EN DASH}"
"""Shown where there is no number."""


@dataclass(frozen=True)
class CaptionedImage:
    """An image, put into the page, with a caption: a file (PNG, JPEG, WebP) or colours.

    Colours are stored as JPEG where `small`, and exactly otherwise.
    """

    image: Path | SheetImage
    caption: str = ""
    small: bool = False


@dataclass(frozen=True)
class Row:
    """Images to be compared side by side; on a phone they scroll sideways together, or stand below each other."""

    images: tuple[CaptionedImage, ...]
    label: str = ""
    wrapped: bool = False


@dataclass(frozen=True)
class Video:
    """A video (MP4), put into the page: a `Path` as it is, or a name (`str`) in the page's folder."""

    file: str | Path
    caption: str = ""
    size: tuple[int, int] | None = None
    """Width and height, pixels, so that the page keeps the place before the video is there."""


@dataclass(frozen=True)
class Commands:
    """Lines for a terminal, each with what it does."""

    lines: tuple[tuple[str, str], ...]


Part: TypeAlias = Row | Video | Chart | Table | Commands | InteractiveCharacter
BOXES: dict[type, str] = {
    Row: "rows", Video: "videos", Chart: "charts", Table: "tables", Commands: "commands",
    InteractiveCharacter: "characters",
}  # fmt: skip
"""What a template calls a group of parts of one kind."""


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
    key_metrics: Sequence[KeyMetric] = (),
    lead: CaptionedImage | Video | None = None,
    credit: str = "",
) -> Path:
    """Writes `report.html` into a folder and returns its path.

    Args:
        folder: exists; videos may lie in it.
        title: of the page.
        sections: in order; at most one of their parts is an interactive character.
        subtitle: one line under the title: capture, recipe, time.
        key_metrics: the numbers to see first.
        lead: an image or video beside the title.
        credit: whom to name; at the foot.

    Raises:
        TwofoldError: a video or image is missing, or the page cannot be written.
    """
    interactive = any(isinstance(part, InteractiveCharacter) for section in sections for part in section.parts)
    script = client_script() if interactive else None
    content = render(
        "report.html",
        title=title,
        subtitle=subtitle,
        key_metrics=key_metrics,
        lead=None if lead is None else _shown(lead, folder),
        lead_is_video=isinstance(lead, Video),
        sections=[
            {"heading": section.heading, "text": section.text, "boxes": _boxes(section.parts, folder)}
            for section in sections
        ],
        credit=f"{credit}\n\n{script_credit()}" if interactive else credit,
        script=script,
        policy=content_policy(script),
    )
    path = folder / FILE_NAME
    write_bytes(path, content)
    return path


def key_metric(
    metrics: Mapping[str, object],
    key: str,
    label: str,
    unit: str = "",
    at_least: float | int | None = None,
    at_most: float | int | None = None,
) -> KeyMetric:
    """One number of a metrics file beside its goal, named by its dotted key; a dash where it was not measured."""
    value = _found(metrics, key)
    sign, goal = ("≥", at_least) if at_least is not None else ("≤", at_most)
    wanted = "" if goal is None else f"goal {sign} {goal:g} {unit}".strip()
    if not isinstance(value, int | float) or not math.isfinite(value):
        return KeyMetric(label, MISSING, "", wanted, None if goal is None else False)
    met = None if goal is None else (value >= goal if at_least is not None else value <= goal)
    return KeyMetric(label, f"{value:.{0 if abs(value) >= 100 else 2}f}", unit, wanted, met)


def metrics_table(metrics: Mapping[str, object]) -> Table:
    """Every number of a metrics file with its protocol, section by section; lists (of single images) are left out.

    >>> metrics_table({"novel_view": {"psnr": {"value": 30.0, "protocol": "whole image"}, "images": 6}}).rows
    (('Novel view',), ('psnr', '30.00', 'whole image'), ('images', '6', ''))
    """
    return Table(("metric", "value", "how it was measured"), tuple(_metric_rows(metrics, "")))


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


def _boxes(parts: Sequence[Part], folder: Path) -> list[dict[str, Any]]:
    """Parts of one kind that follow each other share a box, so that charts stand side by side."""
    return [
        {"kind": BOXES[kind], "parts": [_shown(part, folder) for part in group]}
        for kind, group in itertools.groupby(parts, type)
    ]


def _shown(part: Part | CaptionedImage, folder: Path) -> object:
    """What the template shows of a part: its images and videos embedded, its curves drawn."""
    if isinstance(part, CaptionedImage):
        return _embedded(part)
    if isinstance(part, Video):
        path = folder / part.file if isinstance(part.file, str) else part.file
        return embedded_video(path, part.caption, part.size)
    if isinstance(part, Row):
        return {"label": part.label, "wrapped": part.wrapped, "images": [_embedded(image) for image in part.images]}
    if isinstance(part, Chart):
        legend = [curve.name for curve in part.curves] if len(part.curves) > 1 else []
        return {"title": part.title, "svg": curves_svg(part), "legend": legend}
    return part


def _embedded(image: CaptionedImage) -> EmbeddedImage:
    content = image.image if isinstance(image.image, Path) else as_bytes(image.image)
    return embedded_image(content, image.caption, "jpeg" if image.small else "png")
