"""Drawings for the page of a check, as SVG; colours and fonts come from the page."""

import html
import math
from collections.abc import Sequence

import numpy as np

from twofold.check.body_mask_overlap import BAD
from twofold.check.frame_measures import FrameFacts
from twofold.check.motion_measures import LIMBS, STILL, sides_seen

WIDTH, HEIGHT, LEFT, RIGHT, TOP, BOTTOM = 1020, 250, 40, 14, 12, 34
SIDES = {"left": "left-limb", "right": "right-limb"}


def agreement_svg(frames: Sequence[FrameFacts]) -> str:
    """Silhouette IoU over time, a dot for each picture; the first five cameras have colours of their own."""
    names = list(dict.fromkeys(frame.camera for frame in frames))
    times = [frame.time for frame in frames]
    first, last = min(times), max(max(times), min(times) + 1)
    low = min(0.5, 0.1 * math.floor(10 * min(frame.iou for frame in frames)))

    def x(time: int) -> float:
        return LEFT + (time - first) / (last - first) * (WIDTH - LEFT - RIGHT)

    def y(iou: float) -> float:
        return HEIGHT - BOTTOM - (iou - low) / (1 - low) * (HEIGHT - TOP - BOTTOM)

    across, below = WIDTH - LEFT - RIGHT, y(low) - y(BAD)
    drawn = [f'<rect class="poor" x="{LEFT}" y="{y(BAD):.1f}" width="{across}" height="{below:.1f}"/>']
    for tenth in range(round(10 * low), 11, 1 if low > 0.35 else 2):
        drawn.append(f'<path class="grid" d="M{LEFT},{y(tenth / 10):.1f}H{WIDTH - RIGHT}"/>')
        drawn.append(
            f'<text x="{LEFT - 8}" y="{y(tenth / 10):.1f}" dy=".35em" text-anchor="end">{tenth / 10:.1f}</text>'
        )
    step = next(s * 10**p for p in range(9) for s in (1, 2, 5) if (last - first) / (s * 10**p) <= 10)
    for time in range(-(-first // step) * step, last + 1, step):
        drawn.append(f'<text x="{x(time):.1f}" y="{HEIGHT - BOTTOM + 20}" text-anchor="middle">{time}</text>')
    for i, name in enumerate(names):
        own = sorted((f for f in frames if f.camera == name), key=lambda f: f.time)
        line = " ".join(f"{x(f.time):.1f},{y(f.iou):.1f}" for f in own)
        drawn.append(f'<polyline class="c{min(i, 4)}" points="{line}"/>')
        drawn += [
            f'<circle class="c{min(i, 4)}" cx="{x(f.time):.1f}" cy="{y(f.iou):.1f}" r="2.6">'
            f"<title>{html.escape(name)} at {f.time}: {f.iou:.2f}</title></circle>"
            for f in own
        ]
    return _svg(WIDTH, HEIGHT, "Silhouette IoU over time", drawn)


def sides_svg(azimuths: Sequence[float]) -> str:
    """The body from above, and the directions that cameras see it from: degrees, 0 in front, 90 at its left."""
    size, middle, radius = 300, 150, 96

    def at(degrees: float | int, r: int) -> str:
        angle = math.radians(degrees)
        return f"{middle + r * math.sin(angle):.1f},{middle + r * math.cos(angle):.1f}"

    drawn = [f'<circle class="ring" cx="{middle}" cy="{middle}" r="{radius}"/>']
    seen = sides_seen(np.radians(np.array(azimuths, dtype=float)))
    edges = [d for d in range(360) if seen[d] and not seen[d - 1]]
    if seen.all():
        drawn.append(f'<circle class="seen" cx="{middle}" cy="{middle}" r="{radius}"/>')
    for start in edges:
        length = next(n for n in range(1, 361) if not seen[(start + n) % 360])
        large = int(length > 180)
        drawn.append(
            f'<path class="seen" d="M{middle},{middle}L{at(start, radius)}'
            f'A{radius},{radius} 0 {large} 0 {at(start + length, radius)}Z"/>'
        )
    drawn += [
        '<ellipse class="body" cx="150" cy="150" rx="30" ry="13"/><circle class="head" cx="150" cy="152" r="11"/>'
        '<path class="head" d="M146,162L150,169L154,162Z"/>'
    ]
    drawn += [
        f'<circle class="eye" cx="{p[0]}" cy="{p[1]}" r="3"/>' for a in azimuths for p in [at(a, radius).split(",")]
    ]
    for degrees, word, anchor in (
        (0, "front", "middle"),
        (90, "left", "start"),
        (180, "back", "middle"),
        (270, "right", "end"),
    ):
        px, py = at(degrees, radius + 14).split(",")
        drawn.append(f'<text x="{px}" y="{py}" dy=".35em" text-anchor="{anchor}">{word}</text>')
    return _svg(size, size, "Sides of the body that training cameras see", drawn)


def limbs_svg(ranges: Sequence[float]) -> str:
    """How far each limb turns between any two training moments, degrees."""
    row, left, width = 25, 112, 400
    height = row * len(LIMBS) + 26
    drawn: list[str] = []
    for degrees in (0, 45, 90, 135, 180):
        x = left + degrees / 180 * (width - left - 40)
        drawn.append(f'<path class="grid" d="M{x:.1f},4V{height - 22}"/>')
        drawn.append(f'<text x="{x:.1f}" y="{height - 6}" text-anchor="middle">{degrees}°</text>')
    for i, ((name, _), turn) in enumerate(zip(LIMBS, ranges, strict=True)):
        y, long = i * row + 6, min(turn, 180) / 180 * (width - left - 40)
        kind = SIDES.get(name.split()[0], "trunk") + (" still" if turn < STILL else "")
        drawn.append(f'<text x="{left - 8}" y="{y + 8}" dy=".35em" text-anchor="end">{name}</text>')
        drawn.append(f'<rect class="{kind}" x="{left}" y="{y}" width="{max(long, 1):.1f}" height="16" rx="3"/>')
        drawn.append(f'<text x="{left + long + 6:.1f}" y="{y + 8}" dy=".35em">{turn:.0f}°</text>')
    return _svg(width, height, "How far limbs turn", drawn)


def _svg(width: int, height: int, label: str, drawn: Sequence[str]) -> str:
    return f'<svg viewBox="0 0 {width} {height}" role="img" aria-label="{label}">{"".join(drawn)}</svg>'
