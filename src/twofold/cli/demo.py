"""`twofold demo`: film a synthetic subject, train, measure, show. The whole idea in three minutes on two cores."""

import time
from collections.abc import Callable
from pathlib import Path

import torch

from twofold import __version__
from twofold.capture.folder import read_capture
from twofold.capture.layout import DESCRIPTION
from twofold.capture.types import Capture, Frame, spread
from twofold.errors import TwofoldError
from twofold.evaluation import evaluate, with_protocols
from twofold.files import plain_errors, write_json
from twofold.inputs import read_json
from twofold.methods.base import Avatar
from twofold.methods.factorized_recipes import demo_recipe
from twofold.metrics.image import to_8bit
from twofold.outputs.export.bake import BakeConfig
from twofold.outputs.export.write import ExportRequest, export, missing_packages
from twofold.outputs.gallery import comparison, motion_frames, orbit_frames, panels, save_png, scene_up
from twofold.outputs.sheets import sheet
from twofold.outputs.video import write_video
from twofold.outputs.views import orbit, pose_canonically, render_image
from twofold.recipe import Recipe
from twofold.report import (
    CaptionedImage,
    Chart,
    Commands,
    Curve,
    Row,
    Section,
    Video,
    key_metric,
    metrics_table,
    write_report,
)
from twofold.studio.generate import StudioConfig, make_studio
from twofold.training.lock import locked
from twofold.training.loop import Progress, train
from twofold.training.run import CHECKPOINT, RECIPE

SIZE, FRAMES, CAMERAS = 192, 50, 4
"""Of the demo's capture: 40 frames to train on, 10 with another motion, one camera to train on and three to test."""

MARK = "demo.json"
"""The file by which a demo knows its own folder."""

EXPORT = ExportRequest(("glb", "vrm"), BakeConfig(frames=24))
"""What the demo leaves for other programs, where the packages for it are installed."""


def run_demo(out: Path, seed: int, progress: Callable[[float, str], None]) -> Path:
    """Does it all.

    Args:
        out: folder to make; a demo that lies there is overwritten.
        seed: who is filmed.
        progress: called with the fraction that is done and what is being done.

    Returns:
        the page.

    Raises:
        TwofoldError: `out` holds something else, another demo is being made there, or it cannot be written.
    """
    config, recipe = StudioConfig(seed=seed, size=SIZE, frames=FRAMES, cameras=CAMERAS), demo_recipe(seed)
    _claim(out)
    with locked(out, "filled"):
        return _fill(out, seed, config, recipe, progress)


def _claim(out: Path) -> None:
    """Makes the folder and marks it as a demo's, so that the next demo knows what it may overwrite.

    Raises:
        TwofoldError: it holds anything that no demo has made, or cannot be written.
    """
    with plain_errors(out):
        found = {path.name for path in out.iterdir()} if out.exists() else set[str]()
        # A program that was killed while it wrote the mark leaves its beginning.
        marked = MARK in found or all(name.startswith(f".{Path(MARK).stem}.partial-") for name in found)
        if not marked:
            raise TwofoldError(
                f"{out} holds files, but no {MARK}, so no demo has made it; choose another --out, or empty it."
            )
        for part, file, own in (("capture", DESCRIPTION, "studio"), ("run", RECIPE, "demo")):
            if (out / part / file).exists() and _maker(read_json(out / part / file)) != own:
                raise TwofoldError(f"{out / part} is not what a demo has made; move it, or choose another --out.")
        out.mkdir(parents=True, exist_ok=True)
    write_json(out / MARK, {"made_by": "twofold demo", "version": __version__})


def _maker(stored: object) -> object:
    """Who has made a capture, by its description's notes; what a run is called, by its recipe."""
    notes = stored.get("notes", stored) if isinstance(stored, dict) else {}
    return notes.get("made_by", notes.get("name")) if isinstance(notes, dict) else None


def _fill(out: Path, seed: int, config: StudioConfig, recipe: Recipe, progress: Callable[[float, str], None]) -> Path:
    """Films, trains, measures and shows; returns the report."""
    begun = time.monotonic()
    seconds: dict[str, float] = {}

    def lap(name: str) -> None:
        seconds[name] = time.monotonic() - begun - sum(seconds.values())

    progress(0.0, "filming a synthetic subject")
    make_studio(
        config, out / "capture", lambda done: progress(0.12 * done, "filming a synthetic subject"), overwrite=True
    )
    capture = read_capture(out / "capture")
    lap("studio")

    run = out / "run"
    (run / CHECKPOINT).unlink(missing_ok=True)
    curve: list[tuple[int, float]] = []

    def on_step(step: Progress) -> None:
        if step.step % 20 == 0 or step.step == 1:
            curve.append((step.step, step.psnr))
        share = 0.12 + 0.62 * step.step / step.steps
        progress(share, f"training, step {step.step} of {step.steps}, {step.psnr:.1f} dB")

    avatar = train(capture, recipe, run, torch.device("cpu"), progress=on_step)
    lap("training")

    progress(0.74, "measuring")
    metrics = evaluate(avatar, capture, run, most=9, meshes=2)
    lap("evaluation")
    progress(0.82, "drawing")
    images = _images(avatar, capture, out)
    lap("pictures")
    if not missing_packages(EXPORT.config):
        export(avatar, capture, out, EXPORT, lambda done, note: progress(0.86 + 0.14 * done, note or "exporting"))
        lap("export")
    seconds["total"] = time.monotonic() - begun
    metrics["seconds"] = {**seconds, "protocol": "wall-clock time of the parts of this demo on this machine"}
    write_json(out / "metrics.json", metrics)
    page = _page(out, seed, metrics, curve, images)
    progress(1.0, "done")
    return page


def _images(avatar: Avatar, capture: Capture, out: Path) -> list[Path]:
    folder = out / "pictures"
    save_png(folder / "novel_view.png", comparison(avatar, capture, _one_each(capture.splits["novel_view"])))
    save_png(folder / "novel_pose.png", comparison(avatar, capture, _one_each(capture.splits["novel_pose"])))
    background = torch.tensor(capture.background)
    posed = pose_canonically(avatar)
    parts = [panels(render_image(avatar, posed, camera, background)) for camera in orbit(posed, 256, 2)]
    save_png(folder / "canonical.png", sheet([list(p.values()) for p in parts], ["front", "back"], list(parts[0])))
    frame = capture.train[0]
    turning = orbit_frames(avatar, avatar.pose(frame.pose, frame.translation), capture, 256, 24, scene_up(capture))
    write_video(folder / "orbit.mp4", (to_8bit(image.color).numpy() for image in turning), 12)
    write_video(folder / "novel_pose.mp4", motion_frames(avatar, capture, "novel_pose", 192), 6)
    return [
        folder / name for name in ("novel_view.png", "novel_pose.png", "canonical.png", "orbit.mp4", "novel_pose.mp4")
    ]


def _one_each(frames: tuple[Frame, ...]) -> list[Frame]:
    """One frame of each camera, in frames spread over the split."""
    cameras = sorted({frame.camera_name for frame in frames})
    chosen = []
    for number, camera in enumerate(cameras):
        own = [frame for frame in frames if frame.camera_name == camera]
        chosen.append(own[round((number + 0.5) / len(cameras) * (len(own) - 1))])
    return chosen or spread(frames, 3)


def _page(out: Path, seed: int, metrics: dict[str, object], curve: list[tuple[int, float]], images: list[Path]) -> Path:
    by_name = {path.stem if path.suffix == ".png" else path.name: path for path in images}
    steps, values = [step for step, _ in curve], [value for _, value in curve]
    shown = "Ground truth, the avatar, its pose-independent base, the pose-dependent residual, normals, opacity."
    sections = [
        Section(
            "Novel views",
            f"One camera trained the avatar. These are frames of the same motion, seen by the other three. {shown}",
            (Row((CaptionedImage(by_name["novel_view"]),)),),
        ),
        Section(
            "Novel poses",
            f"Another motion of the same subject, seen by the same held-out cameras. {shown}",
            (
                Row((CaptionedImage(by_name["novel_pose"]),)),
                Video("pictures/novel_pose.mp4", "The avatar and its base."),
            ),
        ),
        Section(
            "The canonical avatar",
            "All frames share one canonical space; the low-frequency branch holds what is the same in all of them, the "
            "high-frequency branch what changes with the pose.",
            (Row((CaptionedImage(by_name["canonical"]),)), Video("pictures/orbit.mp4", "Orbit.")),
        ),
        Section("Training", "", (Chart("PSNR of each step's rays, dB", (Curve("PSNR", steps, values),)),)),
        Section("All metrics, and how they were measured", "", (metrics_table(with_protocols(metrics)),)),
        Section(
            "Next",
            "",
            (
                Commands(
                    (
                        (f"twofold render {out / 'run'}", "more images of this avatar"),
                        (f"twofold export {out / 'run'} --motion dance", "a rigged character that dances, for Blender"),
                        ("twofold studio mine --seed 7", "record another synthetic subject"),
                        ("twofold train mine", "train on it"),
                    )
                ),
            ),
        ),
    ]
    key_metrics = [
        key_metric(metrics, "novel_view.psnr_box", "novel view", "dB", at_least=26),
        key_metric(metrics, "novel_pose.psnr_box", "novel pose", "dB", at_least=24),
        key_metric(metrics, "geometry.chamfer_cm", "surface error", "cm", at_most=1.0),
        key_metric(metrics, "seconds.total", "time", "s", at_most=180),
    ]
    return write_report(
        out,
        "An animatable avatar from one camera",
        sections,
        f"Synthetic subject {seed}: {FRAMES * 4 // 5} training images of {SIZE} x {SIZE}, recipe quick.",
        key_metrics,
        Video("pictures/orbit.mp4"),
    )
