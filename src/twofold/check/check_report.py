"""The report and the numbers of a check: `index.html`, which needs nothing else, and `check.json`."""

import dataclasses
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from jaxtyping import Bool

from twofold.body.skeleton import shape_body
from twofold.capture.coverage import coverage_of
from twofold.capture.coverage_map import CAPTION as COVERAGE
from twofold.capture.coverage_map import coverage_map
from twofold.capture.types import Capture, spread
from twofold.check.body_pictures import overlay, views_of
from twofold.check.findings import Judgement, counted
from twofold.check.frame_measures import FrameFacts, side_of_faces
from twofold.check.measure import Facts
from twofold.check.motion_measures import LIMBS, STILL
from twofold.errors import TwofoldError
from twofold.files import json_text, write_together
from twofold.html.charts import SERIES, Bar, Curve, bars_svg, directions_svg, dots_svg
from twofold.html.page import KeyMetric, Table, embedded_image, render
from twofold.prepare.output.acceptance import MIN_IOU
from twofold.prepare.standing import UPRIGHT
from twofold.prepare.turning import SEEN, sides_seen

REPORT, NUMBERS = "index.html", "check.json"
WORST, EVEN = 6, 12
"""Overlays of the images with the lowest IoU, and of some of the others."""
VIEWED = 4
"""Frames that are shown from the side and from above."""
GOOD_IOU = 0.8
"""What the fits of real people that trained well reach on average."""
WORDS = {"good": "Good", "usable": "Usable", "not trainable": "Not trainable"}
SIDES: dict[str, Literal["left", "right"]] = {"left": "left", "right": "right"}


def require_no_file(folder: Path) -> None:
    """Refuses a place for the report that is a file or lies below one, before any work is done for it.

    Raises:
        TwofoldError: names the file.
    """
    for place in (folder, *folder.parents):
        if place.exists() and not place.is_dir():
            raise TwofoldError(f"{place} is a file, expected a folder for the report; choose another --out.")


def write_check(facts: Facts, capture: Capture, judgement: Judgement, folder: Path | str) -> Path:
    """Writes report and numbers into a folder, which is made where it is missing; returns the report's path.

    Raises:
        TwofoldError: the folder cannot be written.
    """
    folder = Path(folder)
    require_no_file(folder)
    measured = (json_text(numbers(facts, judgement)) + "\n").encode(errors="replace")
    write_together(folder, {NUMBERS: measured, REPORT: _page(facts, capture, judgement)})
    return folder / REPORT


def numbers(facts: Facts, judgement: Judgement) -> dict[str, Any]:
    """Verdict, findings and everything that was measured, as JSON holds it."""
    return {
        "verdict": judgement.level,
        "words": judgement.words,
        "findings": [dataclasses.asdict(finding) for finding in judgement.findings],
        **{field.name: _plain(getattr(facts, field.name)) for field in dataclasses.fields(facts)},
    }


def _plain(value: Any) -> Any:
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        fields = [f.name for f in dataclasses.fields(value) if f.name != "change"]
        return {name: _plain(getattr(value, name)) for name in fields}
    if isinstance(value, dict):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    if isinstance(value, frozenset):
        return sorted(value)
    if isinstance(value, float):
        return round(value, 5) if math.isfinite(value) else None  # which JSON cannot hold
    return str(value) if isinstance(value, Path) else value


def _page(facts: Facts, capture: Capture, judgement: Judgement) -> bytes:
    total = sum(facts.images.values())
    checked = f"{len(facts.frames)} of {total} images checked, " if len(facts.frames) < total else ""
    about = (
        f"{checked}{counted(total, 'image')}, {counted(len(facts.cameras), 'camera')}, {facts.fps:g} frames per second"
    )
    motion = facts.motion
    return render(
        "check.html",
        title=f"Check of {facts.name}",
        name=facts.name,
        subtitle=about,
        level=judgement.level,
        verdict=WORDS[judgement.level],
        words=_sentence(judgement),
        key_metrics=_key_metrics(facts),
        findings=judgement.findings,
        sheets=_sheets(facts, capture),
        agreement=_agreement(facts),
        directions={
            "svg": directions_svg("Sides of the body that training cameras see", _sectors(facts), motion.azimuths),
            "beside": f"{motion.seen:.0f} of 360 degrees",
        },
        limbs={
            "svg": bars_svg("How far limbs turn", _limbs(motion.ranges), 180, 45, "°"),
            "beside": counted(motion.poses, "different pose"),
        },
        coverage={
            "image": embedded_image(coverage_map(capture, coverage_of(capture)), COVERAGE, "jpeg"),
            "sentence": coverage_of(capture).sentence(),
        },
        cameras=_cameras(facts),
        credit=facts.credit,
    )


def _sentence(judgement: Judgement) -> str:
    """The verdict's words behind the large one."""
    levels = {level: sum(f.level == level for f in judgement.findings) for level in ("fault", "warning")}
    if judgement.level == "good":
        return judgement.words.split(": ", 1)[-1]
    if judgement.level == "usable":
        return f"with {counted(levels['warning'], 'warning')}."
    return f"as it is: {counted(levels['fault'], 'fault')} to fix first."


def _key_metrics(facts: Facts) -> list[KeyMetric]:
    ious = np.array([f.iou for f in facts.frames])
    mean, bad = float(ious.mean()), int((ious < MIN_IOU).sum())
    return [
        KeyMetric("Body on mask", f"{mean:.2f}", "IoU", f"{GOOD_IOU:g} or more", mean >= GOOD_IOU),
        KeyMetric("Badly fitted", f"{bad}", f"of {len(ious)}", "none", bad == 0),
        KeyMetric("Sides seen", f"{facts.motion.seen:.0f}", "degrees", f"{SEEN:g} or more", facts.motion.seen >= SEEN),
        KeyMetric("Coverage", f"{100 * facts.coverage:.0f}", "% of the surface"),
        KeyMetric("Training images", f"{facts.images['train']}"),
        KeyMetric("Height", f"{facts.stature:.2f}" if facts.stature < 100 else f"{facts.stature:.0f}", "m"),
    ]


def _sheets(facts: Facts, capture: Capture) -> list[dict[str, Any]]:
    frames = {(f.camera_name, f.frame_index): f for split in capture.splits.values() for f in split}
    shaped = shape_body(capture.body, capture.betas)
    sides = side_of_faces(shaped)
    worst = sorted(facts.frames, key=lambda f: f.iou)[:WORST]
    hidden = sorted((f for f in facts.frames if f.ignored > 0 and f not in worst), key=lambda f: -f.ignored)[:WORST]
    even = spread([f for f in facts.frames if f not in worst and f not in hidden], EVEN)

    def shown(f: FrameFacts) -> dict[str, Any]:
        pixels = overlay(frames[f.camera, f.frame_index], shaped, sides)
        return {
            "image": embedded_image(pixels, f"{f.camera} {f.frame_index}", "jpeg"),
            "iou": f.iou,
            "low": f.iou < MIN_IOU,
        }

    def viewed(f: FrameFacts) -> list[dict[str, Any]]:
        views = views_of(frames[f.camera, f.frame_index], shaped, sides, facts.standing.floor)
        names = {words: f"{f.camera} {f.frame_index}{words}" for words in views}
        return [{"image": embedded_image(pixels, names[words], "jpeg")} for words, pixels in views.items()]

    with torch.inference_mode():
        return [
            {
                "heading": "From the side and from above",
                "words": "No camera shows these. From the side the filming camera stands at the left, and the line is "
                f"the floor; from above it stands at the bottom. {facts.standing.sentence()}",
                "overlays": [view for f in _viewed(facts) for view in viewed(f)],
            },
            {"heading": "Lowest IoU", "overlays": [shown(f) for f in worst]},
            {"heading": "Most ignored, as hidden by held objects", "overlays": [shown(f) for f in hidden]},
            {"heading": "Others, evenly spread", "overlays": [shown(f) for f in even]},
        ]


def _viewed(facts: Facts) -> list[FrameFacts]:
    """Frames to show from the side: evenly spread, and the one that leans most where it was looked at."""
    if facts.standing.upright < UPRIGHT:
        return []
    leaning = [f for f in facts.frames if f.frame_index == facts.standing.leaning_most][:1]
    return [*spread([f for f in facts.frames if f not in leaning], VIEWED - len(leaning)), *leaning]


def _agreement(facts: Facts) -> dict[str, Any]:
    """The silhouette IoU of each camera over its frames."""
    series: dict[str, list[FrameFacts]] = {camera.name: [] for camera in facts.cameras}
    for frame in sorted(facts.frames, key=lambda f: f.frame_index):
        series[frame.camera].append(frame)
    curves = [Curve(name, [f.frame_index for f in own], [f.iou for f in own]) for name, own in series.items() if own]
    names = [curve.name for curve in curves]
    legend = names if len(names) <= SERIES else [*names[: SERIES - 1], "others"]
    svg = dots_svg("Silhouette IoU over frames", curves, MIN_IOU)
    return {"svg": svg, "legend": legend if len(names) > 1 else []}


def _sectors(facts: Facts) -> list[tuple[float, float]]:
    """Start and width, degrees, of each sector around the body that a training camera sees well."""
    return sectors(sides_seen(np.radians(np.array(facts.motion.azimuths, dtype=float))))


def sectors(seen: Bool[np.ndarray, "360"]) -> list[tuple[float, float]]:
    """Start and width of each run of degrees that are seen, around the circle.

    >>> around = np.zeros(360, bool)
    >>> around[[0, 1, 2, 359]] = True
    >>> sectors(around)
    [(359.0, 4.0)]
    """
    if seen.all():
        return [(0.0, 360.0)]
    starts = [d for d in range(360) if seen[d] and not seen[d - 1]]
    return [(float(d), float(next(n for n in range(1, 361) if not seen[(d + n) % 360]))) for d in starts]


def _limbs(ranges: Sequence[float]) -> list[Bar]:
    """How far each limb turns between any two training frames; pale where it hardly does."""
    return [
        Bar(name, turn, SIDES.get(name.split()[0], "trunk"), turn < STILL)
        for (name, _), turn in zip(LIMBS, ranges, strict=True)
    ]


def _cameras(facts: Facts) -> Table:
    return Table(
        ("camera", "mean IoU", "images checked", "field of view", "distance", "principal point"),
        tuple(
            (
                camera.name,
                f"{camera.iou:.2f}",
                f"{camera.looked_at} of {camera.images}",
                f"{camera.view_angle:.1f}°",
                f"{camera.distance:.2f} m",
                f"{camera.off_center:.1%} off centre",
            )
            for camera in facts.cameras
        ),
    )
