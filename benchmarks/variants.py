"""Variants of `quick` on subjects that no table reports: where a training could be better than the full model.

python -m benchmarks.variants full pose_lf wo_feat method.pose.drop=0.5 method.field.pose_code=4 [--seeds 11 12]

A variant is "full", an ablation, a setting, or several of these joined by "+". Each is trained like a cell of
`twofold reproduce --data studio`: 40 images of 192 x 192 of one camera, 900 steps.
"""

from __future__ import annotations

import argparse
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from benchmarks.common import store, studio_capture
from twofold.capture.types import Capture, spread
from twofold.evaluation import measure_split
from twofold.kernels.runtime import tune_process
from twofold.methods.base import Avatar
from twofold.methods.factorized_recipes import ABLATIONS, ablation
from twofold.methods.table import with_settings
from twofold.recipe import Recipe
from twofold.reproduce.experiments import base_recipe
from twofold.training import loop

IMAGES = 12
"""Images of each split, evenly spread."""
METRICS = ("psnr_box", "ssim_box", "gradient_error")


def variant(name: str) -> Recipe:
    """The recipe of a variant."""
    recipe, parts = base_recipe("quick", synthetic=True), name.split("+")
    for part in parts:
        recipe = ablation(part, recipe) if part in ABLATIONS else recipe
    return with_settings(recipe, [part for part in parts if part not in (*ABLATIONS, "full")])


def measured(avatar: Avatar, capture: Capture) -> dict[str, dict[str, float]]:
    """Means by split."""
    found = {}
    for split in ("novel_view", "novel_pose"):
        frames = spread(capture.splits[split], IMAGES)
        means = measure_split(avatar, replace(capture, splits={split: tuple(frames)}), split)
        found[split] = {name: float(means[name]) for name in METRICS if name in means}  # type: ignore[arg-type]
    return found


def main() -> None:
    """Trains, measures and stores."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("variants", nargs="+")
    parser.add_argument("--seeds", type=int, nargs="+", default=[11, 12])
    parser.add_argument("--threads", type=int, default=torch.get_num_threads())
    arguments = parser.parse_args()
    torch.set_num_threads(arguments.threads)
    tune_process()
    rows: dict[str, dict[str, object]] = {name: {} for name in arguments.variants}
    for seed in arguments.seeds:
        capture = studio_capture(192, 50, 4, seed)
        for name in arguments.variants:
            with tempfile.TemporaryDirectory() as folder:
                avatar = loop.train(capture, variant(name), Path(folder) / "run", torch.device("cpu"))
            rows[name][f"studio {seed}"] = found = measured(avatar, capture)
            print(seed, name, *(f"{split} {means['psnr_box']:.2f}" for split, means in found.items()), flush=True)
    for name, subjects in rows.items():
        mean = {s: np.mean([f[s]["psnr_box"] for f in subjects.values()]) for s in ("novel_view", "novel_pose")}  # type: ignore[index]
        print(name, *(f"{split} {value:.2f}" for split, value in mean.items()))
    steps = variant("full").training.steps
    store("variants", {"images": IMAGES, "steps": steps, "against": arguments.variants[0], "rows": rows})


if __name__ == "__main__":
    main()
