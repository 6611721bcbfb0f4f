"""`twofold demo`: film a synthetic subject, train, measure, show. The whole idea in minutes on two cores."""

import shlex
import time
from collections.abc import Callable
from pathlib import Path

import torch

from twofold import __version__
from twofold.capture.folder import read_capture
from twofold.capture.layout import DESCRIPTION
from twofold.capture.types import Capture
from twofold.errors import TwofoldError
from twofold.evaluation import evaluate
from twofold.files import plain_errors, write_json
from twofold.inputs import read_json
from twofold.methods.base import Avatar
from twofold.methods.factorized_recipes import demo_recipe
from twofold.outputs.export.bake_cache import open_cache
from twofold.outputs.export.options import ExportOptions
from twofold.outputs.export.write import write_character
from twofold.outputs.gallery import comparison_sheet, save_png
from twofold.recipe import Recipe
from twofold.report.page_character import PageCharacter, builtin_motions, lacking, page_character
from twofold.report.page_images import (
    SPLITS,
    HeldOut,
    canonical_images,
    canonical_row,
    one_each,
    write_novel_poses,
    write_orbit,
)
from twofold.report.parts import key_metric
from twofold.report.run_page import PageImages, PageTexts, shareable, write_page
from twofold.studio.generate import StudioConfig, make_studio
from twofold.training.lock import locked
from twofold.training.loop import Progress, train
from twofold.training.run import CHECKPOINT, RECIPE

SIZE, FRAMES, CAMERAS = 192, 50, 4
"""Of the demo's capture: 40 frames to train on, 10 with another motion, one camera to train on and three to test."""

PAGE_FRAMES = 3
"""Held-out frames of each split on the page."""

MARK = "demo.json"
"""The file by which a demo knows its own folder."""


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

    def on_step(step: Progress) -> None:
        share = 0.12 + 0.6 * step.step / step.steps
        progress(share, f"training, step {step.step} of {step.steps}, {step.psnr:.1f} dB")

    avatar = train(capture, recipe, run, torch.device("cpu"), progress=on_step)
    lap("training")

    progress(0.72, "measuring")
    rendered: list[HeldOut] = []
    metrics = evaluate(
        avatar, capture, run, most=9, meshes=2,
        rendered=lambda split, frame, image: rendered.append(HeldOut(split, frame, image)),
    )  # fmt: skip
    lap("evaluation")
    missing, character = lacking(avatar), None
    if not missing:
        character = page_character(
            avatar, capture, builtin_motions(avatar), cache=open_cache(run, capture),
            progress=lambda done, note: progress(0.8 + 0.12 * done, note or "baking"),
        )  # fmt: skip
        write_character(character.baked, character.character, out, ("glb", "vrm"), ExportOptions())
    lap("export")
    progress(0.92, "rendering")
    images = _images(avatar, capture, out / "pictures", rendered, character)
    lap("images")
    seconds["total"] = time.monotonic() - begun
    metrics["seconds"] = {**seconds, "protocol": "wall-clock time of the parts of this demo on this machine"}
    write_json(out / "metrics.json", metrics)
    page = write_page(out, run, capture, metrics, images, _texts(out, seed, metrics), character, missing)
    progress(1.0, "done")
    return page


def _images(
    avatar: Avatar, capture: Capture, folder: Path, rendered: list[HeldOut], character: PageCharacter | None
) -> PageImages:
    """Images and videos for the page; those of held-out frames are the ones that were measured."""
    shown: list[HeldOut] = []
    for split in SPLITS:
        own = [held for held in rendered if held.split == split]
        chosen = one_each([held.frame for held in own], PAGE_FRAMES)
        shown += [held for held in own if any(held.frame is frame for frame in chosen)]
        sheet_rows = [(held.frame, held.image) for held in shown if held.split == split]
        save_png(folder / f"{split}.png", comparison_sheet(capture, sheet_rows))
    canonical = canonical_row(canonical_images(avatar, capture, 256))
    turning = write_orbit(folder / "orbit.mp4", avatar, capture, 384, 36, character)
    poses = write_novel_poses(folder / "novel_pose.mp4", avatar, capture, SIZE)
    return PageImages(shown, canonical, [turning, *([poses] if poses else [])])


def _texts(out: Path, seed: int, metrics: dict[str, object]) -> PageTexts:
    run = shlex.quote(str(shareable(out / "run")))
    return PageTexts(
        "An animatable avatar from one camera",
        f"Synthetic subject {seed}: {FRAMES * 4 // 5} training images of {SIZE} x {SIZE}, recipe quick. One camera "
        "trained the avatar; the other three see frames and poses that were held out.",
        (
            key_metric(metrics, "novel_view.psnr_box", "novel view", "dB", at_least=26),
            key_metric(metrics, "novel_pose.psnr_box", "novel pose", "dB", at_least=24),
            key_metric(metrics, "geometry.chamfer_cm", "surface error", "cm", at_most=1.0),
            key_metric(metrics, "seconds.total", "time", "s", at_most=150),
        ),
        ((shlex.join(["twofold", "demo", *(["--seed", str(seed)] if seed else [])]), "make this page"),),
        (
            (f"twofold render {run} --motion dance --mesh", "a video of any motion"),
            (f"twofold export {run} --faces 40000 --texture 2048", "a finer character for Blender, Unity, three.js"),
            ("twofold studio mine --seed 7", "record another synthetic subject"),
            ("twofold train mine", "train on it"),
        ),
    )
