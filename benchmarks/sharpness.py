"""How sharp an avatar is after a given training: PSNR and error of image gradients on unseen views of large images.

python -m benchmarks.sharpness --steps 2400 [--seeds 3 4 5] [--size 512] [--threads 1] [--settings K=V] [--name NAME]

Another commit is measured with this file, too: `PYTHONPATH=OTHER/src python -m benchmarks.sharpness ...`.
"""

from __future__ import annotations

import argparse
import json
import resource
import tempfile
import time
from pathlib import Path

import numpy as np
import torch

from benchmarks.common import store, studio_capture
from twofold.capture.types import Capture
from twofold.evaluation import render_frame
from twofold.kernels.runtime import tune_process
from twofold.methods.base import Avatar
from twofold.methods.table import chosen_recipe
from twofold.metrics.detail import gradient_error
from twofold.training import loop

IMAGES = {"novel_view": 8, "novel_pose": 4, "train": 3}
"""Images of each split, evenly spread."""


def spent() -> float:
    """Processor seconds of this process."""
    used = resource.getrusage(resource.RUSAGE_SELF)
    return used.ru_utime + used.ru_stime


@torch.no_grad()
def measured(avatar: Avatar, capture: Capture) -> dict[str, dict[str, float]]:
    """PSNR (dB) and gradient error over the subject's box, by split."""
    found = {}
    for split, count in IMAGES.items():
        frames = capture.splits[split]
        errors, gradients = [], []
        for index in np.linspace(0, len(frames) - 1, count).round().astype(int):
            frame = frames[index]
            mask = frame.mask() > 0.5
            rows, columns = mask.any(1).nonzero()[:, 0], mask.any(0).nonzero()[:, 0]
            box = torch.zeros_like(mask)
            box[rows.min() : rows.max() + 1, columns.min() : columns.max() + 1] = True
            color = render_frame(avatar, capture, frame, split != "novel_pose").color.clamp(0, 1)
            truth = frame.image() * frame.mask()[..., None]
            errors.append(float(-10 * torch.log10((color - truth).square()[box].mean())))
            gradients.append(gradient_error(color, truth, box))
        found[split] = {"psnr_box": float(np.mean(errors)), "gradient_error": float(np.mean(gradients))}
    return found


def main() -> None:
    """Measures and prints; with a name it stores the result, too."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--steps", type=int, required=True)
    parser.add_argument("--seeds", type=int, nargs="+", default=[3, 4, 5])
    parser.add_argument("--size", type=int, default=512)
    parser.add_argument("--threads", type=int, default=torch.get_num_threads())
    parser.add_argument("--settings", nargs="+", default=[])
    parser.add_argument("--name", default=None)
    arguments = parser.parse_args()
    torch.set_num_threads(arguments.threads)
    tune_process()
    subjects: dict[str, dict[str, object]] = {}
    for seed in arguments.seeds:
        capture = studio_capture(arguments.size, 80, 8, seed)
        recipe = chosen_recipe("quick", arguments.settings, 0, steps=arguments.steps)
        with tempfile.TemporaryDirectory() as folder:
            begun, used = time.perf_counter(), spent()
            avatar = loop.train(capture, recipe, Path(folder) / "run", torch.device("cpu"))
            taken = {"seconds": time.perf_counter() - begun, "processor_seconds": spent() - used}
        subjects[str(seed)] = {**taken, **measured(avatar, capture)}
        print(seed, json.dumps(subjects[str(seed)]), flush=True)
    if arguments.name:
        asked = {key: getattr(arguments, key) for key in ("steps", "size", "threads", "settings")}
        store(arguments.name, {**asked, "subjects": subjects})


if __name__ == "__main__":
    main()
