"""Seconds to render pictures of the demo's kind of avatar: quick and paper-size networks, 256 and 512 square.

The reference form (error-bounded sampler, gradients by autograd) renders a small picture; its seconds for a large one
are stated as rays times its seconds a ray, since it would take an hour.

    python -m benchmarks.rendering [--threads 2] [--steps 300]
"""

from __future__ import annotations

import argparse
import tempfile
from dataclasses import replace
from pathlib import Path

import torch

from benchmarks.common import peak_memory_gb, store, studio_capture, timed
from benchmarks.step import at_work, reference
from twofold.capture.types import Capture
from twofold.methods.base import Avatar, Subject
from twofold.outputs.views import draw
from twofold.recipes import fast, quick
from twofold.speed import tune_process
from twofold.train.loop import train


def seconds(avatar: Avatar, capture: Capture, size: int, repeats: int) -> dict[str, float]:
    """Time of one picture from the training camera, posing included."""
    frame = capture.train[0]
    camera = frame.camera.resized(size, size)
    background = torch.tensor(capture.background)
    device = next(avatar.parameters()).device

    def picture() -> None:
        with torch.no_grad():
            draw(avatar, avatar.pose(frame.pose, frame.translation), camera.to(device), background)

    return timed(picture, repeats)


def main() -> None:
    """Measures and stores."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--threads", type=int, default=torch.get_num_threads())
    parser.add_argument("--steps", type=int, default=300)
    parser.add_argument("--device", default="cpu")
    arguments = parser.parse_args()
    torch.set_num_threads(arguments.threads)
    tune_process()
    capture = studio_capture(512)
    device = torch.device(arguments.device)
    result: dict[str, object] = {"what": "rendering", "threads": arguments.threads, "device": str(device)}
    with tempfile.TemporaryDirectory() as folder:
        recipe = quick()
        recipe = replace(recipe, training=replace(recipe.training, steps=arguments.steps, preview_every=0))
        trained = train(capture, recipe, Path(folder) / "run", device)
    result["quick"] = {size: seconds(trained, capture, size, 3) for size in (256, 512)}
    # Paper-size networks start as a sphere; a density scale of 3 mm is what a trained avatar has.
    method = at_work(fast().method)
    paper_size = replace(method, beta=0.003).build(Subject.of(capture), 0).to(device).eval()
    result["fast"] = {size: seconds(paper_size, capture, size, 1) for size in (256, 512)}
    slow = at_work(reference().method).build(Subject.of(capture), 0).to(device).eval()
    result["reference"] = {48: seconds(slow, capture, 48, 1)}
    result["peak_memory_gb"] = peak_memory_gb()
    store(f"rendering-{device.type}-{arguments.threads}threads", result)


if __name__ == "__main__":
    main()
