"""Runs of one capture side by side: measured in the same way, their images in one sheet, their metrics in one table."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

import torch
from jaxtyping import UInt8
from numpy import ndarray

from twofold.capture.types import Capture, Frame, spread
from twofold.errors import TwofoldError
from twofold.evaluation import measure_cost, measure_geometry, measure_split
from twofold.files import new_folder, write_bytes, write_json
from twofold.html.page import Table
from twofold.inputs import shown_path
from twofold.outputs.gallery import around_person, save_png
from twofold.outputs.sheets import as_bytes, sheet
from twofold.outputs.views import RenderedImage
from twofold.report.parts import CaptionedImage, Row, Section, number, write_report
from twofold.training.clock import read_spent
from twofold.training.run import CHECKPOINT, find_capture, load, read_about, read_recipe, require_same

RESULT = "comparison.json"
SPLITS = {"novel_view": "Novel views", "novel_pose": "Novel poses"}
ROWS = 3
"""Frames of a split that are shown, of different cameras where there are several."""
MISSING = "\N{EN DASH}"


@dataclass(frozen=True)
class ComparedMetric:
    """A column of the table.

    Attributes:
        title: with its unit.
        section: of the metrics.
        name: of the metric there.
        best: picks the best of several values; None where none is better.
    """

    title: str
    section: str
    name: str
    best: Callable[[list[float]], float] | None = None


COLUMNS = (
    ComparedMetric("novel view: box PSNR, dB", "novel_view", "psnr_box", max),
    ComparedMetric("novel view: box SSIM", "novel_view", "ssim_box", max),
    ComparedMetric("novel view: silhouette IoU", "novel_view", "silhouette_iou", max),
    ComparedMetric("novel pose: box PSNR, dB", "novel_pose", "psnr_box", max),
    ComparedMetric("novel pose: box SSIM", "novel_pose", "ssim_box", max),
    ComparedMetric("novel pose: silhouette IoU", "novel_pose", "silhouette_iou", max),
    ComparedMetric("Chamfer distance, cm", "geometry", "chamfer_cm", min),
    ComparedMetric("parameters", "cost", "parameters"),
    ComparedMetric("training, s", "cost", "training_seconds"),
    ComparedMetric("training, s of a processor", "cost", "training_processor_seconds"),
    ComparedMetric("an image, s", "cost", "frame_seconds"),
    ComparedMetric("an image, s of a processor", "cost", "frame_processor_seconds"),
)
"""Beside run, recipe and steps; a column that no run has is left out."""


@dataclass(frozen=True)
class ComparedRun:
    """A run with all that is shown of it.

    Attributes:
        name: of its folder.
        recipe: by which it was trained.
        steps: that it was trained for.
        metrics: by section, each with its protocol.
        images: for each split, one of each frame that is shown.
    """

    name: str
    recipe: str
    steps: int
    metrics: dict[str, dict[str, object]]
    images: dict[str, list[UInt8[ndarray, "_ _ 3"]]]


def common_capture(runs: Sequence[Path], given: Path | None = None) -> Path:
    """The capture that all runs were trained on.

    Args:
        runs: two or more folders.
        given: where that capture lies now, if it has moved.

    Raises:
        TwofoldError: there are fewer than two runs, one is named twice, or they were trained on different captures.
    """
    if len(runs) < 2:
        raise TwofoldError("twofold compare expects two runs or more; `twofold evaluate` measures a single one.")
    twice = [run for number, run in enumerate(runs) if run.resolve() in [other.resolve() for other in runs[:number]]]
    if twice:
        raise TwofoldError(f"{shown_path(twice[0])} is named twice; name each run once.")
    first, *others = [(run, find_stored(run)) for run in runs]
    for run, capture in others:
        if capture != first[1]:
            raise TwofoldError(
                f"{run} was trained on {capture}, but {first[0]} on {first[1]}; metrics of different captures or image "
                "sizes cannot be compared, so train both on one."
            )
    return find_capture(runs[0], given)


def find_stored(run: Path) -> Path:
    """Where the capture of a run lay when it was trained, whether or not it is there still."""
    return Path(str(read_about(run).get("capture")))


def measured(
    run: Path, capture: Capture, device: torch.device, most: int, meshes: int, progress: Callable[[], None]
) -> ComparedRun:
    """Loads a run, measures it and keeps the images that are shown.

    Args:
        run: folder.
        capture: of all runs.
        device: where it is rendered.
        most: images measured of each split, evenly spread.
        meshes: ground-truth meshes measured.
        progress: called after every image and mesh.

    Raises:
        TwofoldError: the run cannot be loaded, or was trained on something else.
    """
    require_same(run, capture, motion=True)
    avatar, steps = load(run, device)
    metrics: dict[str, dict[str, object]] = {}
    images: dict[str, list[UInt8[ndarray, "_ _ 3"]]] = {}

    for split in SPLITS:
        shown = shown_frames(capture, split, most)
        cut: dict[int, UInt8[ndarray, "_ _ 3"]] = {}

        def rendered(frame: Frame, image: RenderedImage, shown: list[Frame] = shown, cut: dict[int, Any] = cut) -> None:
            row = next((row for row, other in enumerate(shown) if other is frame), None)
            if row is not None:
                cut[row] = as_bytes(image.color)[around_person(frame.mask())]
            progress()

        if shown:
            metrics[split] = measure_split(avatar, capture, split, most, True, rendered)
            images[split] = [cut[row] for row in range(len(shown))]
    geometry = measure_geometry(avatar, capture, meshes, progress=progress) if meshes else {}
    if geometry:
        metrics["geometry"] = geometry
    metrics["cost"] = measure_cost(avatar, capture, read_spent(run / CHECKPOINT))
    return ComparedRun(run.resolve().name, read_recipe(run).name, steps, metrics, images)


def shown_frames(capture: Capture, split: str, most: int) -> list[Frame]:
    """Some of the frames of a split that are measured: evenly spread, each from another camera where there are several.

    Args:
        capture: of the runs.
        split: "novel_view" or "novel_pose".
        most: images measured of the split.
    """
    frames = spread(capture.splits.get(split, ()), most)
    cameras = sorted({frame.camera_name for frame in frames})
    chosen: list[Frame] = []
    for row in range(min(ROWS, len(frames))):
        own = [f for f in frames if f.camera_name == cameras[row % len(cameras)] and all(f is not c for c in chosen)]
        if own:
            chosen.append(own[round((row + 0.5) / ROWS * (len(own) - 1))])
    return chosen


def write_comparison(folder: Path, capture: Capture, runs: Sequence[ComparedRun], most: int) -> None:
    """Writes sheets (PNG), the table (JSON, Markdown) and a page (HTML), all or nothing.

    Args:
        folder: to make; an earlier comparison is replaced.
        capture: of all runs.
        runs: in the order of columns and lines.
        most: images measured of each split.

    Raises:
        TwofoldError: the folder holds something else, or cannot be written.
    """
    require_free_for_comparison(folder)
    background = torch.tensor(capture.background)
    table, protocol = comparison_table(runs), shared_protocol(runs)
    with new_folder(folder, replace=folder.exists()) as place:
        sections: list[Section] = []
        for split, heading in SPLITS.items():
            frames = shown_frames(capture, split, most)
            if not frames:
                continue
            truth = [as_bytes(f.composited(background))[around_person(f.mask())] for f in frames]
            rows = [[image, *(run.images[split][i] for run in runs)] for i, image in enumerate(truth)]
            labels = [f"{frame.camera_name} {frame.frame_index}" for frame in frames]
            save_png(
                place / f"{split}.png",
                sheet(rows, labels, ["ground truth", *(run.name for run in runs)], footer=capture.credit),
            )
            sections.append(Section(heading, "", (Row((CaptionedImage(place / f"{split}.png"),)),)))
        lines = [f"{name}: {text}" for name, text in protocol.items()]
        sections.append(Section("Metrics", "\n\n".join(lines), (table,)))
        data = [
            {"run": run.name, "recipe": run.recipe, "steps": run.steps, "metrics": cast(dict[str, Any], run.metrics)}
            for run in runs
        ]
        write_json(place / RESULT, {"capture": str(capture.folder), "runs": data})
        text = _markdown(capture, table, lines, [section.heading for section in sections[:-1]])
        write_bytes(place / "comparison.md", text.encode())
        write_report(place, f"{len(runs)} avatars of {capture.name}", sections, credit=capture.credit)


def require_free_for_comparison(folder: Path) -> None:
    """Refuses a folder that holds anything but an earlier comparison.

    Raises:
        TwofoldError: it does.
    """
    if folder.is_file() or (folder.is_dir() and any(folder.iterdir()) and not (folder / RESULT).is_file()):
        raise TwofoldError(f"{shown_path(folder)} holds something that is no comparison; choose another --out.")


def comparison_table(runs: Sequence[ComparedRun]) -> Table:
    """A line for each run; the best value of a column is marked with a star where several have one."""
    columns = [c for c in COLUMNS if any(_value(run, c) is not None for run in runs)]
    cells = [[run.name, run.recipe, number(run.steps)] for run in runs]
    for column in columns:
        values = [_value(run, column) for run in runs]
        known = [value for value in values if value is not None]
        best = column.best(known) if column.best and len(known) > 1 else None
        for line, value in zip(cells, values, strict=True):
            star = " *" if value is not None and value == best else ""
            line.append(MISSING if value is None else number(value) + star)
    return Table(("run", "recipe", "steps", *(c.title for c in columns)), tuple(tuple(line) for line in cells))


def _value(run: ComparedRun, column: ComparedMetric) -> float | int | None:
    value = run.metrics.get(column.section, {}).get(column.name)
    return value if isinstance(value, float | int) else None


def shared_protocol(runs: Sequence[ComparedRun]) -> dict[str, str]:
    """How the numbers of the table were measured; what differs between runs stands there for each."""
    told: dict[str, str] = {}
    for section in dict.fromkeys(section for run in runs for section in run.metrics):
        protocols = {run.name: _protocol(run.metrics.get(section, {})) for run in runs}
        wanted = {c.name for c in COLUMNS if c.section == section} | {
            "frames",
            "poses",
            "background",
            "surface",
            "moments",
        }
        for name in dict.fromkeys(name for protocol in protocols.values() for name in protocol if name in wanted):
            texts = {run: protocol[name] for run, protocol in protocols.items() if name in protocol}
            alike = len(set(texts.values())) == 1
            text = next(iter(texts.values())) if alike else "; ".join(f"{run}: {own}" for run, own in texts.items())
            told[f"{section.replace('_', ' ')}, {name.replace('_', ' ')}"] = text
    return told


def _protocol(metrics: Mapping[str, object]) -> dict[str, str]:
    protocol = metrics.get("protocol", {})
    return cast(dict[str, str], protocol) if isinstance(protocol, dict) else {}


def _markdown(capture: Capture, table: Table, protocol: Sequence[str], headings: Sequence[str]) -> str:
    rows = ["| " + " | ".join(cells) + " |" for cells in (table.columns, ["---"] * len(table.columns), *table.rows)]
    images = [f"## {heading}\n\n![{heading}]({split}.png)" for split, heading in SPLITS.items() if heading in headings]
    credit = [capture.credit] if capture.credit else []
    parts = [
        f"# Avatars of {capture.name}", "\n".join(rows), "A star marks the best value of a column.", *images,
        "## How it was measured", "\n".join(f"- {line}" for line in protocol), *credit,
    ]  # fmt: skip
    return "\n\n".join(parts) + "\n"


def pieces(capture: Capture, most: int, meshes: int) -> int:
    """How many images and meshes `measured` measures of a run."""
    images = sum(len(spread(capture.splits.get(split, ()), most)) for split in SPLITS)
    return images + len(spread(sorted(capture.meshes), meshes))
