"""Time to quality: PSNR over the subject's box on unseen views and poses against seconds of training.

python -m benchmarks.quality [--threads 2] [--steps 1000] [--seed 0] [--size 192]
"""

from __future__ import annotations

import argparse
import tempfile
import time
from dataclasses import replace
from pathlib import Path

import torch

from benchmarks.common import store, studio_capture
from twofold.demo import demo_recipe
from twofold.evaluate import measure_split
from twofold.methods.base import Avatar
from twofold.speed import tune_process
from twofold.train import loop


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
    recipe = demo_recipe(arguments.seed)
    recipe = replace(recipe, training=replace(recipe.training, steps=arguments.steps))
    every = max(arguments.steps // arguments.points, 1)
    curve: list[dict[str, float]] = []
    built: list[Avatar] = []
    measuring = 0.0
    begun = time.perf_counter()

    def watch(progress: loop.Progress) -> None:
        nonlocal measuring
        if progress.step % every == 0:
            start = time.perf_counter()
            avatar = built[0].eval()
            point = {"step": progress.step, "seconds": start - begun - measuring}
            with torch.no_grad():
                for split in ("novel_view", "novel_pose"):
                    point[split] = float(measure_split(avatar, capture, split, 6)["psnr_box"])  # type: ignore[arg-type]
            avatar.train()
            curve.append(point)
            print(point, flush=True)
            measuring += time.perf_counter() - start

    with tempfile.TemporaryDirectory() as folder:
        loop.train(capture, recipe, Path(folder) / "run", torch.device("cpu"), watch=watch, before_first=built.append)
    store(
        f"quality-cpu-{arguments.threads}threads-seed{arguments.seed}",
        {"what": "PSNR over the subject's box against seconds of training (measuring not counted)",
         "threads": arguments.threads, "seed": arguments.seed, "size": arguments.size, "curve": curve},
    )  # fmt: skip


if __name__ == "__main__":
    main()
