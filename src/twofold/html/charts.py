"""Charts as SVG, drawn with matplotlib; colours and fonts come from the page that they are put into.

The same data gives the same bytes: the salt of the ids is fixed, no date is stored, and the settings of the user's
matplotlib are not read.
"""

import io
import math
import re
from collections.abc import Generator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, Literal
from xml.etree import ElementTree

import matplotlib.style
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Circle, Ellipse, Patch, Polygon, Wedge
from matplotlib.ticker import FuncFormatter, LogLocator, MaxNLocator, NullLocator

BINS = 160
"""Curves with more points are drawn as the means of bins, over the range that each bin spans."""
SERIES = 5
"""Colours for curves; a sixth curve has the first one's again."""
NAMES = ("c0", "c1", "c2", "c3", "c4", "ink", "faint", "line", "accent", "bad", "left", "right", "trunk")
"""Colours of the page, custom properties of its style sheet."""
COLORS = {name: f"#0000{i + 1:02x}" for i, name in enumerate(NAMES)}
"""What stands for them while matplotlib draws; `_svg` puts `var(--c0)` and so on in their place."""
SETTINGS = {
    "svg.fonttype": "none",  # Text stays text: it is searched, read aloud, and takes the page's font.
    "svg.hashsalt": "twofold",
    "text.parse_math": False,  # A dollar sign in a name is a dollar sign.
    "font.family": "DejaVu Sans",  # Comes with matplotlib, so text is measured alike everywhere.
    "font.size": 13,
    "text.color": COLORS["faint"],
    "xtick.labelcolor": COLORS["faint"],
    "ytick.labelcolor": COLORS["faint"],
    "axes.labelcolor": COLORS["faint"],
    "grid.color": COLORS["line"],
    "lines.solid_capstyle": "round",
    "lines.solid_joinstyle": "round",
}


@dataclass(frozen=True)
class Curve:
    """Values over steps or seconds; what is not finite is left out."""

    name: str
    steps: Sequence[float] | Sequence[int]
    values: Sequence[float]


@dataclass(frozen=True)
class Chart:
    """Curves in one pair of axes, `logarithmic` in height where asked for."""

    title: str
    curves: tuple[Curve, ...]
    x_label: str = "step"
    logarithmic: bool = False


@dataclass(frozen=True)
class Bar:
    """One bar: its name, its length, the page's colour it has, and whether it is drawn pale."""

    name: str
    value: float
    color: Literal["left", "right", "trunk"]
    pale: bool = False


def curves_svg(chart: Chart) -> str:
    """Lines, 480 x 260 units; long ones as the means of bins over the band between their least and largest values.

    Each line is a group of class `curve`, each band one of class `band`.
    """
    curves = [_finite(curve, chart.logarithmic) for curve in chart.curves]
    if not any(len(points) for points in curves):
        return "<p>Nothing was recorded.</p>"
    with _axes(480, 260, (64, 26, 10, 40)) as (figure, axes):
        if chart.logarithmic:
            axes.set_yscale("log")
        for i, points in enumerate(curves):
            _curve(axes, points, COLORS[f"c{i % SERIES}"], chart.logarithmic)
        _ticks(axes, chart.logarithmic)
        axes.set_xlabel(chart.x_label, loc="right")
        return _svg(figure, chart.title, "curves")


def dots_svg(title: str, series: Sequence[Curve], bad_below: float, x_label: str = "frame") -> str:
    """Values up to 1 over frames, 1020 x 264 units: a dot for each with its numbers as a tooltip, a band for bad ones.

    The first four series have colours of their own, all others share the fifth.
    """
    values = [value for one in series for value in one.values]
    low = min(0.5, 0.1 * math.floor(10 * min(values)))
    with _axes(1020, 264, (40, 14, 12, 46)) as (figure, axes):
        axes.axhspan(low, bad_below, color=COLORS["bad"], alpha=0.09, linewidth=0, gid="class:bad")
        for i, one in enumerate(series):
            color = COLORS[f"c{min(i, SERIES - 1)}"]
            axes.plot(one.steps, one.values, color=color, linewidth=1, alpha=0.45, clip_on=False)
            axes.scatter(one.steps, one.values, s=18, color=color, linewidth=0, clip_on=False, gid=f"class:dots s{i}")
        axes.set_ylim(low, 1)
        first, last = axes.get_xlim()
        axes.set_xlim(first, max(last, first + 1))
        _ticks(axes, logarithmic=False, whole=True)
        axes.set_xlabel(x_label, loc="right")
        tooltips = [
            [f"{one.name} at {x:g}: {y:.2f}" for x, y in zip(one.steps, one.values, strict=True)] for one in series
        ]
        return _svg(figure, title, "dots-over-frames", tooltips)


def bars_svg(title: str, bars: Sequence[Bar], end: int, every: int, unit: str) -> str:
    """Horizontal bars with their names and values, 440 units wide, over an axis from 0 to `end` with ticks."""
    height = 25 * len(bars) + 30
    with _axes(440, height, (130, 44, 4, 26)) as (figure, axes):
        for i, bar in enumerate(bars):
            long, alpha = max(min(bar.value, end), end / 200), 0.45 if bar.pale else 1
            axes.barh(
                i,
                long,
                0.64,
                color=COLORS[bar.color],
                alpha=alpha,
                linewidth=0,
                clip_on=False,
                zorder=2,
                gid="class:bar",
            )
            axes.annotate(f"{bar.value:.0f}{unit}", (long, i), (6, 0), textcoords="offset points", va="center")
        axes.set_ylim(len(bars) - 0.4, -0.6)
        axes.set_xlim(0, end)
        axes.set_yticks(range(len(bars)), [bar.name for bar in bars])
        marks = np.arange(0, end + every / 2, every).tolist()
        axes.set_xticks(marks, [f"{mark:g}{unit}" for mark in marks])
        axes.grid(axis="x")
        return _svg(figure, title, "bars")


def directions_svg(title: str, covered: Sequence[tuple[float, float]], marks: Sequence[float]) -> str:
    """A circle around a person seen from above, 300 x 256 units, with sectors covered and directions marked.

    Args:
        title: what the drawing shows.
        covered: where each covered sector begins and how wide it is, degrees; 0 is in front, 90 at the person's left.
        marks: directions, degrees.
    """
    with _axes(300, 256, (0, 0, 0, 0)) as (figure, axes):
        axes.set(xlim=(-150, 150), ylim=(-128, 128), xticks=[], yticks=[])
        axes.add_patch(Circle((0, 0), 96, fill=False, edgecolor=COLORS["line"], linewidth=2))
        for start, width in covered:
            # matplotlib counts counter-clockwise from the right; here front is below, the left at the right.
            sector = Wedge((0, 0), 96, start - 90, start - 90 + min(width, 359.999), gid="class:covered")
            axes.add_patch(_filled(sector, "accent", 0.2))
        axes.add_patch(_filled(Ellipse((0, 0), 60, 26), "faint"))
        axes.add_patch(_filled(Circle((0, -2), 11), "ink"))
        axes.add_patch(_filled(Polygon([(-4, -12), (0, -19), (4, -12)]), "ink"))
        for degrees in marks:
            axes.add_patch(_filled(Circle(_around(degrees, 96), 3, gid="class:mark"), "accent"))
        for degrees, word, across, upright in (
            (0, "front", "center", "top"), (90, "left", "left", "center"),
            (180, "back", "center", "bottom"), (270, "right", "right", "center"),
        ):  # fmt: skip
            axes.text(*_around(degrees, 106), word, ha=across, va=upright)
        return _svg(figure, title, "directions")


@contextmanager
def _axes(width: int, height: int, margins: tuple[int, int, int, int]) -> Generator[tuple[Figure, Axes]]:
    """A figure whose units are the drawing's, with axes inside the margins (left, right, top, bottom)."""
    left, right, top, bottom = margins
    with matplotlib.style.context(["default", SETTINGS]):
        figure = Figure((width / 72, height / 72), dpi=72, frameon=False)
        inside = (left / width, bottom / height, 1 - (left + right) / width, 1 - (top + bottom) / height)
        axes = figure.add_axes(inside, frameon=False)
        axes.tick_params(which="both", length=0, pad=8)
        axes.margins(0, 0.04)
        axes.set_axisbelow(True)
        axes.yaxis.set_gid("class:y-axis")
        yield figure, axes


def _curve(axes: Axes, points: np.ndarray, color: str, logarithmic: bool) -> None:
    """One line; through the means of bins, over a band, where it has many points."""
    if not len(points):
        return
    bins = np.array_split(points, min(len(points), BINS))
    steps = [b[:, 0].mean() for b in bins]
    # On a logarithmic axis the middle of what is seen is the mean of logarithms.
    means = [np.exp(np.log(b[:, 1]).mean()) if logarithmic else b[:, 1].mean() for b in bins]
    if len(points) > BINS:
        low, high = ([f(b[:, 1]) for b in bins] for f in (np.min, np.max))
        axes.fill_between(steps, low, high, color=color, alpha=0.16, linewidth=0, clip_on=False, gid="class:band")
    marker = "o" if len(means) == 1 else ""
    axes.plot(steps, means, color=color, linewidth=2, marker=marker, markersize=4, clip_on=False, gid="class:curve")


def _ticks(axes: Axes, logarithmic: bool, whole: bool = False) -> None:
    axes.xaxis.set_major_locator(MaxNLocator(7, steps=[1, 2, 2.5, 5, 10], integer=True, min_n_ticks=1))
    if logarithmic:
        low, high = axes.get_ylim()
        axes.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0) if high < 300 * low else (1.0,), numticks=9))
    else:
        axes.yaxis.set_major_locator(MaxNLocator(6, steps=[1, 2, 2.5, 5, 10]))
    axes.yaxis.set_minor_locator(NullLocator())
    axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:.0f}" if whole else short(value)))
    axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: short(value)))
    axes.grid(axis="y")


def short(value: float | int) -> str:
    """A number short enough for an axis.

    >>> [short(v) for v in (0.000025, 0.005, 2500.0, 20000.0, 1500000.0)]
    ['2.5e-05', '0.005', '2,500', '20k', '1.5M']
    """
    if 0 < abs(value) < 1e-3:
        return f"{value:.3g}" if abs(value) < 1e-4 else f"{value:g}"
    for unit, name in ((1e6, "M"), (1e4, "k")):
        if abs(value) >= unit:
            return f"{value / (1e6 if name == 'M' else 1e3):,.6g}{name}"
    return f"{value:,.6g}"


def _finite(curve: Curve, logarithmic: bool) -> np.ndarray:
    """(step, value) of what can be drawn."""
    points = np.array([curve.steps, curve.values], dtype=float).T.reshape(-1, 2)
    points = points[np.isfinite(points).all(1)]
    return points[points[:, 1] > 0] if logarithmic else points


def _filled(patch: Patch, color: str, alpha: float = 1.0) -> Patch:
    patch.set(facecolor=COLORS[color], linewidth=0, alpha=alpha)
    return patch


def _around(degrees: float | int, radius: int) -> tuple[float, float]:
    angle = math.radians(degrees)
    return radius * math.sin(angle), -radius * math.cos(angle)


def _svg(figure: Figure, label: str, kind: str, tooltips: Sequence[Sequence[str]] = ()) -> str:
    """The drawing as an element to be put into a page.

    Ids that nothing refers to are taken out, for a page holds several drawings; the others are made from what they
    stand for, so the same id twice means the same thing. "class:a b" as an artist's id becomes its classes.
    """
    stored = io.StringIO()
    figure.savefig(stored, format="svg", metadata=dict.fromkeys(("Creator", "Date", "Format", "Type")))
    root = ElementTree.fromstring(stored.getvalue())
    referred = set(re.findall(r"""(?:url\(|href=")#([^)"]+)""", stored.getvalue()))
    for element in root.iter():
        _cleaned(element, referred)
    for i, texts in enumerate(tooltips):
        (group,) = (g for g in root.iter("g") if g.get("class") == f"dots s{i}")
        for mark, text in zip(group.iter("use"), texts, strict=True):
            ElementTree.SubElement(mark, "title").text = text
    view = root.attrib["viewBox"]
    root.attrib.clear()
    root.attrib.update({"viewBox": view, "class": kind, "role": "img", "aria-label": label})
    return ElementTree.tostring(root, encoding="unicode")


def _cleaned(element: Any, referred: set[str]) -> None:
    """Without namespaces, with the page's colours, and with an id only where it is referred to."""
    element.tag = element.tag.rpartition("}")[2]
    for name, value in list(element.attrib.items()):
        del element.attrib[name]
        plain = name.rpartition("}")[2]
        if plain == "id" and value.startswith("class:"):
            element.set("class", value.removeprefix("class:"))
        elif plain == "style":
            style = re.sub(r"font-family: [^;]*; ", "", value)
            element.set(plain, re.sub(r"#0000([0-9a-f]{2})", lambda m: f"var(--{NAMES[int(m[1], 16) - 1]})", style))
        elif plain != "id" or value in referred:
            element.set(plain, value)
    element.tail = None
    if element.tag != "text":
        element.text = None
