"""The paper's figures from trained cells: branches, canonical space, ablations, geometry, extreme poses."""

import io
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TypeAlias

import numpy as np
import torch
from jaxtyping import UInt8
from matplotlib.figure import Figure

from twofold.capture.types import Capture, Frame
from twofold.capture.validate import read_mesh
from twofold.errors import TwofoldError
from twofold.evaluation import render_frame
from twofold.files import write_bytes
from twofold.methods.base import Avatar
from twofold.metrics.image import subject_box
from twofold.outputs.gallery import panels, save_png
from twofold.outputs.mesh import posed_surface
from twofold.outputs.mesh_images import mesh_image
from twofold.outputs.sheets import as_bytes, sheet
from twofold.outputs.views import orbit, pose_canonically, render_image
from twofold.reproduce.cells import CAPTURES, RUN
from twofold.reproduce.experiments import PlannedCell
from twofold.reproduce.pose_distance import PROTOCOL, binned
from twofold.training.run import load

Image: TypeAlias = UInt8[np.ndarray, "h w 3"]
SUBJECTS = 2
"""Subjects shown in a figure."""
SIZE = 256
"""Rows of images without a camera of their own, pixels."""


def make_figures(
    plans: Mapping[str, Sequence[PlannedCell]], out: Path, folder: Path,
    progress: Callable[[float, str], None] | None = None,
) -> list[Path]:  # fmt: skip
    """All figures for which there are cells, as PNG files.

    Args:
        plans: cells of each experiment.
        out: folder of the experiment.
        folder: for the figures.
        progress: called with the share that is done, 0..1, and the name of the figure.

    Returns:
        the files.

    Raises:
        TwofoldError: no cell is done, or a run is damaged.
    """
    done = {name: [place for place in plan if place.cell.results(out) is not None] for name, plan in plans.items()}
    if not any(done.values()):
        raise TwofoldError(
            f"{out} holds no finished cell of these settings; run `twofold reproduce ablation` (or another table) with "
            "the same options first."
        )
    shelf = _Shelf(out)
    every = list({place.cell.key: place for plan in done.values() for place in plan}.values())
    full = [place for place in every if place.row.printed in ("Ours", "[5, 10]")]
    jobs: dict[str, Callable[[], Image | bytes]] = {}
    if full:
        jobs["branches"] = lambda: branches(shelf, _few(full))
    for name in ("main", "ablation", "frequency"):
        if len({place.row.key for place in done.get(name, ())}) > 1:
            chosen = done[name]
            jobs[name] = lambda chosen=chosen: rows_beside_truth(shelf, chosen)
            jobs[f"{name}_canonical"] = lambda chosen=chosen: canonical(shelf, chosen)
            jobs[f"{name}_geometry"] = lambda chosen=chosen: geometry(shelf, chosen)
            jobs[f"{name}_extreme"] = lambda chosen=chosen: extreme_poses(chosen, out)
            jobs[f"{name}_worst"] = lambda chosen=chosen: worst(shelf, chosen)
    files: list[Path] = []
    for number, (name, job) in enumerate(jobs.items()):
        if progress:
            progress(number / len(jobs), name)
        made = job()
        files.append(folder / f"{name}.png")
        if isinstance(made, bytes):
            folder.mkdir(parents=True, exist_ok=True)
            write_bytes(files[-1], made)
        else:
            save_png(files[-1], made)
    return files


class _Shelf:
    """Avatars and captures of cells, read when they are asked for; the last capture is kept."""

    def __init__(self, out: Path) -> None:
        self.out = out
        self._capture: tuple[str, Capture] | None = None

    def avatar(self, place: PlannedCell) -> Avatar:
        return load(place.cell.folder(self.out) / RUN)[0]

    def capture(self, place: PlannedCell) -> Capture:
        if self._capture is None or self._capture[0] != place.subject:
            self._capture = place.subject, place.cell.source.capture(self.out / CAPTURES)
        return self._capture[1]


def branches(shelf: _Shelf, places: Sequence[PlannedCell]) -> Image:
    """A novel pose of each subject: ground truth, the full model, and what its two branches give."""
    rows: list[list[Image]] = []
    columns: list[str] = []
    for place in places:
        capture = shelf.capture(place)
        frame = _frames(capture)[-1]
        parts = panels(render_frame(shelf.avatar(place), capture, frame, True))
        box = subject_box(frame.mask(), margin=6)
        columns = ["ground truth", *parts]
        rows.append([part[box] for part in (_truth(capture, frame), *parts.values())])
    return sheet(rows, [place.subject for place in places], columns, height=SIZE)


def rows_beside_truth(shelf: _Shelf, places: Sequence[PlannedCell]) -> Image:
    """A novel view and a novel pose of each subject: ground truth, then every row of the table."""
    rows: list[list[Image | None]] = []
    labels: list[str] = []
    shown = _labels(places)
    for subject, own in _by_subject(places):
        capture = shelf.capture(own[0])
        avatars = {place.row.label: shelf.avatar(place) for place in own}
        for name, frame in zip(("novel view", "novel pose"), _frames(capture), strict=False):
            box = subject_box(frame.mask(), margin=6)
            cells: list[Image | None] = [_truth(capture, frame)[box]]
            for label in shown:
                avatar = avatars.get(label)
                seen = None if avatar is None else as_bytes(render_frame(avatar, capture, frame, True).color)[box]
                cells.append(seen)
            rows.append(cells)
            labels.append(f"{subject} {name}")
    return sheet(rows, labels, ["ground truth", *shown], height=SIZE)


def canonical(shelf: _Shelf, places: Sequence[PlannedCell]) -> Image:
    """Front and back in canonical space, and those of the pose-independent branch where there is one."""
    _, own = next(_by_subject(places))
    capture = shelf.capture(own[0])
    background = torch.tensor(capture.background)
    rows: list[list[Image | None]] = [[], [], [], []]
    for place in own:
        avatar = shelf.avatar(place)
        posed = pose_canonically(avatar)
        for number, camera in enumerate(orbit(posed, SIZE, 2)):
            image = render_image(avatar, posed, camera, background)
            rows[number].append(as_bytes(image.color))
            rows[2 + number].append(None if image.base_opacity is None else as_bytes(image.base))
    names = ["front", "back", "front, base", "back, base"]
    kept = [number for number in range(4) if any(cell is not None for cell in rows[number])]
    return sheet([rows[i] for i in kept], [names[i] for i in kept], [place.row.label for place in own])


def geometry(shelf: _Shelf, places: Sequence[PlannedCell]) -> Image:
    """Surfaces in a novel pose, shaded: the true one where it is known, then every row's."""
    rows: list[list[Image | None]] = []
    labels: list[str] = []
    shown = _labels(places)
    for subject, own in _by_subject(places):
        capture = shelf.capture(own[0])
        frame = _frames(capture)[-1]
        box = subject_box(frame.mask(), margin=6)
        true = capture.meshes.get(frame.frame_index)
        cells: list[Image | None] = [None if true is None else _clay(frame, *read_mesh(true))[box]]
        for label in shown:
            place = next((place for place in own if place.row.label == label), None)
            if place is None:
                cells.append(None)
                continue
            avatar = shelf.avatar(place)
            vertices, faces = posed_surface(avatar, avatar.pose(frame.pose, frame.translation), 0.008)
            cells.append(_clay(frame, vertices.cpu(), faces.cpu())[box])
        rows.append(cells)
        labels.append(subject)
    return sheet(rows, labels, ["ground truth", *shown], height=SIZE)


def worst(shelf: _Shelf, places: Sequence[PlannedCell]) -> Image:
    """Where each row breaks: its novel pose with the lowest PSNR over the box, below the ground truth."""
    rows: list[list[Image | None]] = [[], []]
    names: list[str] = []
    for label in _labels(places):
        found = [
            (image["psnr_box"], place, image)
            for place in places
            if place.row.label == label
            for image in (place.cell.results(shelf.out) or {})["images"]
            if image["split"] == "novel_pose"
        ]
        if not found:
            continue
        value, place, image = min(found, key=lambda item: item[0])
        capture = shelf.capture(place)
        frame = next(
            f
            for f in capture.splits["novel_pose"]
            if (f.camera_name, f.frame_index) == (image["camera"], image["frame"])
        )
        box = subject_box(frame.mask(), margin=6)
        rows[0].append(_truth(capture, frame)[box])
        rows[1].append(as_bytes(render_frame(shelf.avatar(place), capture, frame, True).color)[box])
        names.append(f"{label} {value:.1f} dB, {image['pose_distance']:.0f}°")
    return sheet(rows, ["ground truth", "avatar"], names, height=SIZE)


def extreme_poses(places: Sequence[PlannedCell], out: Path) -> bytes:
    """PSNR over the box against the distance of the test pose from the nearest training pose, a curve a row; PNG."""
    figure = Figure(figsize=(7, 4.2), layout="constrained")
    axes = figure.add_subplot()
    for label in _labels(places):
        images = [
            image
            for place in places
            if place.row.label == label
            for image in (place.cell.results(out) or {})["images"]
            if image["split"] == "novel_pose"
        ]
        points = binned([i["pose_distance"] for i in images], [i["psnr_box"] for i in images])
        if points:
            x, y, error, _ = zip(*points, strict=True)
            axes.errorbar(x, y, error, marker="o", markersize=4, capsize=3, linewidth=1.3, label=label)
    axes.set_xlabel("distance to the nearest training pose, degrees a joint")
    axes.set_ylabel("PSNR over the subject's box, dB")
    axes.set_title("Novel poses; bars: standard error over images", fontsize="medium")
    axes.grid(alpha=0.3)
    axes.legend(fontsize="small")
    data = io.BytesIO()
    figure.savefig(data, format="png", dpi=110, metadata={"Description": PROTOCOL})
    return data.getvalue()


def _labels(places: Sequence[PlannedCell]) -> list[str]:
    return list(dict.fromkeys(place.row.label for place in places))


def _by_subject(places: Sequence[PlannedCell]) -> Iterator[tuple[str, list[PlannedCell]]]:
    """The first subjects with their cells of the first seed that each row has."""
    for subject in list(dict.fromkeys(place.subject for place in places))[:SUBJECTS]:
        own = [place for place in places if place.subject == subject]
        yield subject, list({place.row.key: place for place in reversed(own)}.values())[::-1]


def _few(places: Sequence[PlannedCell]) -> list[PlannedCell]:
    return [own[0] for _, own in _by_subject(places)]


def _frames(capture: Capture) -> list[Frame]:
    """A frame from the middle of each split that is measured, else of the training images."""
    splits = [capture.splits.get(split, ()) for split in ("novel_view", "novel_pose")]
    found = [frames[len(frames) // 2] for frames in splits if frames]
    return found or [capture.train[len(capture.train) // 2]]


def _truth(capture: Capture, frame: Frame) -> Image:
    return as_bytes(frame.composited(torch.tensor(capture.background)))


def _clay(frame: Frame, vertices: torch.Tensor, faces: torch.Tensor) -> Image:
    color, opacity = mesh_image(frame.camera, vertices, faces)
    return as_bytes(color + (1 - opacity[..., None]))
