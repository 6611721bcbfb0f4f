"""Time to quality: PSNR over the subject's box on unseen views and poses against seconds of training.

The reference form (paper-size networks, error-bounded sampler, autograd, float32) then trains for as many seconds. It
takes minutes for an image of ordinary size, so both are measured on small images of the same frames, too.

python -m benchmarks.quality [--threads 2] [--steps 1000] [--seed 0] [--size 192]
"""

from __future__ import annotations

import argparse
import contextlib
import tempfile
import time
from dataclasses import replace
from pathlib import Path

import torch

from benchmarks.common import store, studio_capture
from benchmarks.step import reference
from twofold.capture.types import Capture
from twofold.evaluation import measure_split
from twofold.kernels.runtime import tune_process
from twofold.methods.base import Avatar
from twofold.methods.factorized_recipes import demo_recipe
from twofold.training import loop

SMALL = 48
"""Rows and columns of the images that the reference form is asked for."""


class OutOfTime(Exception):
    """The reference form has trained for as long as it may."""


def figures(avatar: Avatar, capture: Capture, most: int) -> dict[str, float]:
    """PSNR over the subject's box in decibels, by split."""
    with torch.no_grad():
        splits = {name: measure_split(avatar, capture, name, most)["psnr_box"] for name in ("novel_view", "novel_pose")}
    return {name: float(value) for name, value in splits.items()}  # type: ignore[arg-type]


def train_reference(capture: Capture, small: Capture, seconds: float) -> dict[str, object]:
    """What the reference form reaches in some seconds; a step that has begun is finished."""
    recipe = reference()
    # Without LPIPS patches teach nothing; two images of 1,728 rays fill 40 GB of memory.
    pixels = replace(recipe.training.pixels, patches=0)
    training = replace(recipe.training, images_per_step=1, pixels=pixels, preview_every=0)
    recipe = replace(recipe, training=training)
    begun = time.perf_counter()
    built: list[Avatar] = []
    steps = 0

    def on_step(progress: loop.Progress) -> None:
        nonlocal steps
        steps = progress.step
        if time.perf_counter() - begun >= seconds:
            raise OutOfTime

    with tempfile.TemporaryDirectory() as folder, contextlib.suppress(OutOfTime):
        loop.train(
            capture, recipe, Path(folder) / "run", torch.device("cpu"), progress=on_step, before_first=built.append
        )
    taken = time.perf_counter() - begun
    return {"steps": steps, "rays": pixels.rays, "seconds": taken, "small": figures(built[0].eval(), small, 2)}


def main() -> None:
    """Measures and stores."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--threads", type=int, default=torch.get_num_threads())
    parser.add_argument("--steps", type=int, default=1000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--size", type=int, default=192)
    parser.add_argument("--points", type=int, default=5)
    arguments = parser.parse_args()
    torch.set_num_threads(arguments.threads)
    tune_process()
    capture = studio_capture(arguments.size, 50, 4, arguments.seed)
    small = studio_capture(SMALL, 50, 4, arguments.seed)
    recipe = demo_recipe(arguments.seed)
    recipe = replace(recipe, training=replace(recipe.training, steps=arguments.steps))
    every = max(arguments.steps // arguments.points, 1)
    curve: list[dict[str, float]] = []
    built: list[Avatar] = []
    measuring = 0.0
    begun = time.perf_counter()

    def on_step(progress: loop.Progress) -> None:
        nonlocal measuring
        if progress.step % every == 0:
            start = time.perf_counter()
            avatar = built[0].eval()
            point = {"step": progress.step, "seconds": start - begun - measuring, **figures(avatar, capture, 6)}
            avatar.train()
            curve.append(point)
            print(point, flush=True)
            measuring += time.perf_counter() - start

    with tempfile.TemporaryDirectory() as folder:
        loop.train(
            capture, recipe, Path(folder) / "run", torch.device("cpu"), progress=on_step, before_first=built.append
        )
    ours = figures(built[0].eval(), small, 2)
    theirs = train_reference(capture, small, curve[-1]["seconds"])
    store(
        f"quality-cpu-{arguments.threads}threads-seed{arguments.seed}",
        {"what": "PSNR over the subject's box against seconds of training (measuring not counted)",
         "threads": arguments.threads, "seed": arguments.seed, "size": arguments.size, "curve": curve,
         "small_size": SMALL, "small": ours, "reference": theirs},
    )  # fmt: skip


if __name__ == "__main__":
    main()
