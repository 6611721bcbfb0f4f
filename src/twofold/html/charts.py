"""Curves over training as SVG; colours and fonts come from the page that they are put into."""

import html
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

WIDTH, HEIGHT, LEFT, RIGHT, TOP, BOTTOM = 480, 260, 54, 26, 10, 40
"""Size of a drawing and its margins, in its own units."""
BINS = 160
"""Curves with more points are drawn as the means of bins, over the range that each bin spans."""


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


def chart_svg(chart: Chart) -> str:
    """The drawing: lines of the classes c0..c4 in turn, ranges of the class `range`, lines of the grid `grid`."""
    curves = [_points(curve, chart.logarithmic) for curve in chart.curves]
    everything = np.concatenate([np.empty((0, 2)), *curves])
    if not len(everything):
        return "<p>Nothing was recorded.</p>"
    (x_low, y_low), (x_high, y_high) = everything.min(0), everything.max(0)
    spare = 0.04 * (y_high - y_low) or 0.5
    low, high = np.array([x_low, y_low - spare]), np.array([max(x_high, x_low + 1), y_high + spare])

    def place(points: np.ndarray) -> np.ndarray:
        x, y = ((points - low) / (high - low)).T
        return np.stack([LEFT + x * (WIDTH - LEFT - RIGHT), HEIGHT - BOTTOM - y * (HEIGHT - TOP - BOTTOM)], -1)

    drawn: list[str] = []
    for value, label in axis_ticks(low[1], high[1], chart.logarithmic):
        y = place(np.array([[low[0], value]]))[0, 1]
        drawn.append(f'<path class="grid" d="M{LEFT},{y:.1f}H{WIDTH - RIGHT}"/>')
        drawn.append(f'<text x="{LEFT - 8}" y="{y:.1f}" dy=".35em" text-anchor="end">{label}</text>')
    for value, label in axis_ticks(low[0], high[0]):
        x = place(np.array([[value, low[1]]]))[0, 0]
        drawn.append(f'<text x="{x:.1f}" y="{HEIGHT - BOTTOM + 18}" text-anchor="middle">{label}</text>')
    for i, points in enumerate(curves):
        bins = np.array_split(points, min(len(points), BINS)) if len(points) else []
        means = np.array([b.mean(0) for b in bins]).reshape(-1, 2)
        if len(points) > BINS:
            upper, lower = (np.array([f(b[:, 1]) for b in bins]) for f in (np.max, np.min))
            outline = np.concatenate([np.stack([means[:, 0], upper], -1), np.stack([means[:, 0], lower], -1)[::-1]])
            drawn.append(f'<polygon class="c{i % 5} range" points="{_listed(place(outline))}"/>')
        drawn.append(f'<polyline class="c{i % 5}" points="{_listed(place(means))}"/>')
    drawn.append(f'<text x="{WIDTH - RIGHT}" y="{HEIGHT - 4}" text-anchor="end">{html.escape(chart.x_label)}</text>')
    opening = f'<svg viewBox="0 0 {WIDTH} {HEIGHT}" role="img" aria-label="{html.escape(chart.title)}">'
    return f"{opening}{''.join(drawn)}</svg>"


def axis_ticks(low: float, high: float, logarithmic: bool = False) -> list[tuple[float, str]]:
    """Round positions between two ends of an axis, and what to write there.

    >>> axis_ticks(0.0, 3000.0)[:3]
    [(0.0, '0'), (500.0, '500'), (1000.0, '1,000')]

    Args:
        low: lower end, its decimal logarithm where the axis is logarithmic.
        high: upper end, likewise.
        logarithmic: labels are powers of ten of the positions.
    """
    if logarithmic and high - low > 0.7:
        steps = (1,) if high - low > 2.5 else (1, 2, 5)
        marks = [s * 10.0**e for e in range(math.floor(low), math.ceil(high) + 1) for s in steps]
        return [(math.log10(m), f"{m:g}") for m in marks if low <= math.log10(m) <= high]
    rough = (high - low) / 6
    power = 10.0 ** math.floor(math.log10(rough))
    step = next(s * power for s in (1, 2, 2.5, 5, 10) if s * power >= 0.999 * rough)
    values = [i * step for i in range(math.ceil(low / step), math.floor(high / step) + 1)]
    return [(v, _label(10**v, 4) if logarithmic else _label(v, 10)) for v in values]


def _label(value: float, digits: int) -> str:
    """A number short enough for an axis: 0.005, 2,500, 20k, 1.5M."""
    for unit, name in ((1e6, "M"), (1e4, "k")):
        if abs(value) >= unit:
            return f"{value / (1e6 if name == 'M' else 1e3):,.{digits}g}{name}"
    return f"{value:,.{digits}g}"


def _points(curve: Curve, logarithmic: bool) -> np.ndarray:
    """(step, value or its logarithm) of what can be drawn."""
    points = np.array([curve.steps, curve.values], dtype=float).T.reshape(-1, 2)
    points = points[np.isfinite(points).all(1)]
    if logarithmic:
        points = points[points[:, 1] > 0]
        points[:, 1] = np.log10(points[:, 1])
    return points


def _listed(points: np.ndarray) -> str:
    return " ".join(f"{x:.1f},{y:.1f}" for x, y in points)
