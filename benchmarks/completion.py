"""Completion of unobserved regions: colour errors of what no training image shows, with completion and without.

Synthetic subjects filmed from the front only; the same training twice. Captures and runs are kept in a folder and used
again, so it can be stopped and continued.

python -m benchmarks.completion [--seeds 0 2] [--steps 700] [--size 160] [--work FOLDER]
"""

from __future__ import annotations

import argparse
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from benchmarks.common import store
from twofold.capture.coverage import coverage_of
from twofold.capture.folder import read_capture
from twofold.capture.types import Capture, spread
from twofold.evaluation import render_frame
from twofold.kernels.runtime import tune_process
from twofold.methods.base import Avatar
from twofold.methods.factorized_recipes import quick
from twofold.methods.table import fitted, with_completion
from twofold.metrics.image import psnr
from twofold.outputs.coverage_error import PROTOCOL, CoverageErrors
from twofold.recipe import Recipe
from twofold.studio.appearance import sample_look
from twofold.studio.generate import StudioConfig, make_studio
from twofold.training.clock import read_spent
from twofold.training.loop import train
from twofold.training.run import CHECKPOINT, load, read_recipe

YAW, FRAMES, CAMERAS = 60.0, 50, 4
"""Degrees that the subjects turn about the front, frames, and cameras a quarter turn apart."""
IMAGES, FRONT = 9, 6
"""Novel views and training images that are measured."""


def recipe(steps: int, on: bool) -> Recipe:
    """`quick` without pose refinement, as the poses are exact."""
    start = quick()
    method = replace(start.method, pose=replace(start.method.pose, refine=()))
    training = replace(start.training, steps=steps, preview_every=0, checkpoint_every=100_000)
    return with_completion(replace(start, method=method, training=training), on)


def trained(capture: Capture, folder: Path, steps: int, on: bool) -> Avatar:
    """The avatar of a finished run in `folder`, or of a new one."""
    chosen = fitted(recipe(steps, on), capture)[0]
    if not (folder / CHECKPOINT).is_file() or load(folder)[1] < steps or read_recipe(folder) != chosen:
        train(capture, chosen, folder, torch.device("cpu"))
    return load(folder)[0]


@torch.no_grad()
def measured(avatar: Avatar, capture: Capture) -> dict[str, object]:
    """Colour errors by coverage in novel views, and PSNR over the person in training images."""
    errors = CoverageErrors(capture, coverage_of(capture))
    for frame in spread(capture.splits["novel_view"], IMAGES):
        errors.add(frame, render_frame(avatar, capture, frame, True))
    front: list[float] = []
    for frame in spread(capture.train, FRONT):
        truth = frame.composited(torch.tensor(capture.background))
        front.append(psnr(render_frame(avatar, capture, frame, True).color, truth, frame.mask() > 0.5))
    return {**errors.metrics(), "front_psnr": float(np.mean(front))}


def main() -> None:
    """Trains, measures and stores."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.completion", description=__doc__)
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 2])
    parser.add_argument("--steps", type=int, default=700)
    parser.add_argument("--size", type=int, default=160)
    parser.add_argument("--work", type=Path, default=Path(tempfile.gettempdir()) / "twofold-completion")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    tune_process()
    for seed in arguments.seeds:
        folder = arguments.work / f"subject{seed}"
        if not folder.exists():
            make_studio(StudioConfig(seed, arguments.size, FRAMES, CAMERAS, yaw_range=YAW), folder)
        capture, look = read_capture(folder), sample_look(seed)
        row: dict[str, object] = {"seed": seed, "shirt": look.shirt, "hair": look.hair}
        row |= {"steps": arguments.steps, "size": arguments.size, "surface": coverage_of(capture).share}
        for name in ("off", "on"):
            run = arguments.work / f"subject{seed}-{name}"
            avatar = trained(capture, run, arguments.steps, name == "on")
            spent = read_spent(run / CHECKPOINT)
            row[name] = {**measured(avatar, capture), "processor_s": spent and spent.processor}
        store(f"completion-seed{seed}", {"what": PROTOCOL, **row})


if __name__ == "__main__":
    main()
