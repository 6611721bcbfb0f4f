"""The page and the numbers of a check: `index.html`, which needs nothing else, and `check.json`."""

import dataclasses
import html
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Int, UInt8
from PIL import Image, ImageOps
from scipy import ndimage

from twofold.body.skeleton import ShapedBody, shape_body
from twofold.capture.types import Capture, Frame, spread
from twofold.check.body_mask_overlap import BAD
from twofold.check.check_charts import agreement_svg, limbs_svg, sides_svg
from twofold.check.findings import Finding, Judgement, counted
from twofold.check.frame_measures import FrameFacts, look_at, read_bytes, side_of_faces
from twofold.check.measure import Facts
from twofold.check.rules import SEEN
from twofold.errors import TwofoldError
from twofold.files import plain_errors, write_bytes, write_json
from twofold.html.page import Table, Verdict, document, embedded, header, inline, paragraphs, table_html, tiles

PAGE, NUMBERS = "index.html", "check.json"
WORST, EVEN = 6, 12
"""Overlays of the worst pictures and of some in between."""
CELL = (270, 360)
"""Width and height of an overlay, pixels."""
TINTS = np.array([(72, 190, 130), (245, 140, 30), (40, 120, 250)], np.float32)
"""Trunk and head, left limbs, right limbs; told apart by colour-blind eyes, too."""
OUTLINE = (255, 255, 70)
"""Of the mask."""
GOOD_IOU = 0.8
"""What the fits of real people that trained well reach on average."""
MARKS = {"fault": "✗", "warning": "!", "note": "i"}
WORDS = {"good": "Good", "usable": "Usable", "waste": "Waste of time"}


def require_no_file(folder: Path) -> None:
    """Says no to a place for the page that is a file or lies below one, before any work is done for it.

    Raises:
        TwofoldError: names the file.
    """
    for place in (folder, *folder.parents):
        if place.exists() and not place.is_dir():
            raise TwofoldError(f"{place} is a file, expected a folder for the page; choose another --out.")


def write_check(facts: Facts, capture: Capture, judgement: Judgement, folder: Path | str) -> Path:
    """Writes page and numbers into a folder, which is made where it is missing; returns the page's path.

    Raises:
        TwofoldError: the folder cannot be written.
    """
    folder = Path(folder)
    require_no_file(folder)
    with plain_errors(folder):
        folder.mkdir(parents=True, exist_ok=True)
    write_json(folder / NUMBERS, numbers(facts, judgement))
    write_bytes(folder / PAGE, document(f"Check of {facts.name}", _body(facts, capture, judgement), STYLE))
    return folder / PAGE


def numbers(facts: Facts, judgement: Judgement) -> dict[str, Any]:
    """Verdict, findings and everything that was measured, as JSON holds it."""
    return {
        "verdict": judgement.level,
        "words": judgement.words,
        "findings": [dataclasses.asdict(finding) for finding in judgement.findings],
        **{field.name: _plain(getattr(facts, field.name)) for field in dataclasses.fields(facts)},
    }


def overlay(
    frame: Frame, shaped: ShapedBody, sides: Int[np.ndarray, "F"], cell: tuple[int, int] = CELL
) -> UInt8[np.ndarray, "h w 3"]:
    """The posed body tinted over the picture, left limbs orange and right ones blue, and the mask's outline.

    Args:
        frame: the picture.
        shaped: the person's body.
        sides: of its faces (`side_of_faces`).
        cell: width and height of the result, pixels; what the picture lacks is dark.
    """
    image, mask = read_bytes(frame)
    look = look_at(frame, shaped, mask, max(cell), cell[0] / cell[1])
    picture = look.window.image(image).astype(np.float32)
    flat = picture.reshape(-1, 3)
    pixel = look.hits.pixel.numpy()
    flat[pixel] = 0.5 * flat[pixel] + 0.5 * TINTS[sides[look.hits.face.numpy()]]
    shaded = 0.6 * picture
    picture = np.where(look.known[..., None], picture, shaded)
    edge = look.mask & ~np.asarray(ndimage.binary_erosion(look.mask, border_value=1), dtype=bool)
    picture[edge] = OUTLINE
    stored = Image.fromarray(picture.round().astype(np.uint8))
    return np.asarray(ImageOps.pad(stored, cell, color=(18, 20, 24)))


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
        return round(value, 5)
    return str(value) if isinstance(value, Path) else value


def _body(facts: Facts, capture: Capture, judgement: Judgement) -> str:
    total = sum(facts.pictures.values())
    looked = f"{len(facts.frames)} of {total} pictures looked at, " if len(facts.frames) < total else ""
    cameras = counted(len(facts.cameras), "camera")
    about = f"{looked}{counted(total, 'picture')}, {cameras}, {facts.fps:g} moments a second"
    banner = (
        f"<div class='banner {judgement.level}'><b>{WORDS[judgement.level]}</b> "
        f"{inline(judgement.words.split(': ', 1)[-1] if judgement.level == 'good' else _sentence(judgement))}</div>"
    )
    top = header(facts.name, paragraphs(about) + banner + tiles(_tiles(facts)))
    sections = [
        _section("Findings", "", _findings(judgement.findings)),
        _section(
            "Bodies over pictures",
            "The posed body is tinted: <b class=left-limb>left limbs</b>, <b class=right-limb>right limbs</b>, "
            "<b class=trunk>trunk and head</b>. The <b class=outline>line</b> is the mask. Both should cover each "
            "other, and each limb lie on that of its own side.",
            _sheets(facts, capture),
        ),
        _section("Agreement", "", _agreement(facts)),
        _section("Motion", "", _motion(facts)),
        _section("Cameras", "", table_html(_cameras(facts))),
    ]
    return f"{top}<main>{''.join(sections)}</main><footer>{paragraphs(facts.credit)}</footer>"


def _sentence(judgement: Judgement) -> str:
    """The verdict's words behind the large one."""
    levels = {level: sum(f.level == level for f in judgement.findings) for level in ("fault", "warning")}
    if judgement.level == "usable":
        return f"with {counted(levels['warning'], 'warning')}."
    return f"to train on: {counted(levels['fault'], 'fault')} to mend first."


def _section(heading: str, text: str, content: str) -> str:
    return f"<section><h2>{heading}</h2>{f'<p>{text}</p>' if text else ''}{content}</section>"


def _tiles(facts: Facts) -> list[Verdict]:
    ious = np.array([f.iou for f in facts.frames])
    mean, bad = float(ious.mean()), int((ious < BAD).sum())
    return [
        Verdict("Body on mask", f"{mean:.2f}", "IoU", f"{GOOD_IOU:g} or more", mean >= GOOD_IOU),
        Verdict("Badly fitted", f"{bad}", f"of {len(ious)}", "none", bad == 0),
        Verdict("Sides seen", f"{facts.motion.seen:.0f}", "degrees", f"{SEEN:g} or more", facts.motion.seen >= SEEN),
        Verdict("Training pictures", f"{facts.pictures['train']}"),
        Verdict("Stature", f"{facts.stature:.2f}" if facts.stature < 100 else f"{facts.stature:.0f}", "m"),
    ]


def _findings(findings: Sequence[Finding]) -> str:
    if not findings:
        return "<p>Nothing to remark.</p>"
    items = "".join(
        f"<li class={f.level}><span class=mark>{MARKS[f.level]}</span><div><p>{inline(f.what)}."
        f"{f' <span class=where>{html.escape(f.where)}</span>' if f.where else ''}</p>"
        f"<p class=mend>{inline(f.mend)}</p></div></li>"
        for f in findings
    )
    return f"<ul class=findings>{items}</ul>"


def _sheets(facts: Facts, capture: Capture) -> str:
    frames = {(f.camera_name, f.time): f for split in capture.splits.values() for f in split}
    shaped = shape_body(capture.body, capture.betas)
    sides = side_of_faces(shaped)
    worst = sorted(facts.frames, key=lambda f: f.iou)[:WORST]
    even = spread([f for f in facts.frames if f not in worst], EVEN)

    def cells(chosen: Sequence[FrameFacts]) -> str:
        drawn: list[str] = []
        for f in chosen:
            source, (width, height) = embedded(overlay(frames[f.camera, f.time], shaped, sides), "jpeg")
            tone = " class=low" if f.iou < BAD else ""
            label = f"{html.escape(f.camera)} {f.time}"
            drawn.append(
                f"<figure><img src='{source}' width={width} height={height} alt='{label}' loading=lazy>"
                f"<figcaption>{label}<b{tone}>{f.iou:.2f}</b></figcaption></figure>"
            )
        return f"<div class=sheet>{''.join(drawn)}</div>"

    with torch.inference_mode():
        rest = f"<h3>In between</h3>{cells(even)}" if even else ""
        return f"<h3>Worst first</h3>{cells(worst)}{rest}"


def _agreement(facts: Facts) -> str:
    names = [camera.name for camera in facts.cameras]
    spans = [f"<span class=c{min(i, 4)}>{html.escape(name)}</span>" for i, name in enumerate(names[:4])]
    if len(names) > 4:
        spans.append(f"<span class=c4>{html.escape(names[4]) if len(names) == 5 else 'others'}</span>")
    legend = "".join(spans) if len(names) > 1 else ""
    return (
        f"<figure class=chart><figcaption><b>Silhouette IoU over moments</b>{legend}</figcaption>"
        f"{agreement_svg(facts.frames)}</figure>"
    )


def _motion(facts: Facts) -> str:
    motion = facts.motion
    poses = counted(motion.poses, "different pose")
    return (
        f"<div class=pair><figure class=chart><figcaption><b>Sides that training cameras see</b>"
        f"{motion.seen:.0f} of 360 degrees</figcaption>{sides_svg(motion.azimuths)}</figure>"
        f"<figure class=chart><figcaption><b>How far limbs turn</b>{poses}</figcaption>"
        f"{limbs_svg(motion.ranges)}</figure></div>"
    )


def _cameras(facts: Facts) -> Table:
    return Table(
        ("camera", "mean IoU", "pictures", "view angle", "distance", "principal point"),
        tuple(
            (
                camera.name,
                f"{camera.iou:.2f}",
                f"{camera.looked_at} of {camera.pictures}",
                f"{camera.view_angle:.1f}°",
                f"{camera.distance:.2f} m",
                f"{camera.off_center:.1%} off the middle",
            )
            for camera in facts.cameras
        ),
    )


STYLE = """
:root{--warn:#a87400;--left:#d9741a;--right:#2a6fdb;--trunk:#2f9e6b}
@media(prefers-color-scheme:dark){:root{--warn:#e8b84a;--left:#f5a04d;--right:#6fa8ff;--trunk:#62c794}}
.banner{font-size:19px;padding:13px 18px;border-radius:12px;margin:18px 0 0;color:var(--ink);position:relative;
overflow:hidden;border:1px solid var(--tone)}
.banner::before{content:"";position:absolute;inset:0;background:var(--tone);opacity:.13}
.banner b{font-size:22px;margin-right:4px;color:var(--tone)}
.good{--tone:var(--good)}.usable{--tone:var(--warn)}.waste{--tone:var(--bad)}
.findings{list-style:none;margin:12px 0;padding:0;display:grid;gap:10px}
.findings li{display:grid;grid-template-columns:30px 1fr;gap:12px;background:var(--card);border:1px solid var(--line);
border-left:4px solid var(--tone);border-radius:10px;padding:12px 16px}
.findings p{margin:0;max-width:84ch}.findings .mend{color:var(--faint);margin-top:3px}
.where{font-family:ui-monospace,SFMono-Regular,Menlo,Consolas,"DejaVu Sans Mono",monospace;font-size:.84em;
color:var(--faint)}
.mark{width:26px;height:26px;border-radius:50%;color:var(--paper);background:var(--tone);font-weight:700;display:grid;
place-items:center;font-size:15px}
.fault{--tone:var(--bad)}.warning{--tone:var(--warn)}.note{--tone:var(--faint)}
.sheet{display:grid;grid-template-columns:repeat(6,1fr);gap:12px}
.sheet figcaption{display:flex;justify-content:space-between;gap:8px;font-size:13px;font-variant-numeric:tabular-nums}
.sheet figcaption b{color:var(--ink);font-weight:600}.sheet figcaption .low{color:var(--bad)}
b.left-limb{color:var(--left)}b.right-limb{color:var(--right)}b.trunk{color:var(--trunk)}
b.outline{background:#ffff46;color:#222;border-radius:4px;padding:0 5px}
rect.left-limb{fill:var(--left)}rect.right-limb{fill:var(--right)}rect.trunk{fill:var(--trunk)}rect.still{opacity:.45}
.chart{background:var(--card);border:1px solid var(--line);border-radius:12px;padding:14px 16px 10px;margin:14px 0}
.chart figcaption{margin:0 0 8px;display:flex;gap:4px 16px;flex-wrap:wrap}
.chart figcaption b{color:var(--ink);font-weight:600;margin-right:auto}
.chart figcaption span::before{content:"";display:inline-block;width:12px;height:3px;border-radius:2px;
background:var(--c);margin-right:6px;vertical-align:middle}
.chart polyline{stroke-width:1;opacity:.45}.chart circle{fill:var(--c)}
.poor{fill:var(--bad);opacity:.09}
.chart svg{display:block;width:100%}
.pair{display:grid;grid-template-columns:minmax(0,3fr) minmax(0,4fr);gap:18px}.pair .chart svg{max-height:330px}
.chart .ring{fill:none;stroke:var(--line);stroke-width:2}.chart .seen{fill:var(--accent);opacity:.2}
.chart .body{fill:var(--faint)}.chart .head{fill:var(--ink)}.chart .eye{fill:var(--accent)}
td:nth-child(3){color:inherit}
@media(max-width:760px){.pair{grid-template-columns:1fr}.sheet{grid-template-columns:repeat(3,1fr)}
.banner{font-size:17px}.banner b{font-size:19px}}
""".strip()
