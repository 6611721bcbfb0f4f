"""A training step of each method: its fast recipe against the dense form, on the same rays, in one process.

The dense form is the recipe with the numbers of the authors' program: every sample shaded, float32, gradients by
automatic differentiation. Both forms have the same networks with the same weights, those of a run where one is named:
a field that has learned a person hides and leaves out more samples than one that is haze. Times are seconds of the
processor on one thread, so that other programs on the machine count little.

    python -m benchmarks.method_steps [--rays 256] [--run humannerf=runs/humannerf ...] [methods ...]
"""

from __future__ import annotations

import argparse
import json
import statistics
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch

from benchmarks.common import RESULTS, store, studio_capture
from twofold.capture.folder import read_capture
from twofold.capture.types import Capture
from twofold.kernels.runtime import flush_denormals, tune_process
from twofold.losses import total
from twofold.methods.base import Avatar, Mode
from twofold.methods.subject import Subject
from twofold.methods.table import METHODS, RECIPES
from twofold.training.pixels import PixelSource
from twofold.training.row_adam import make_optimizer
from twofold.training.run import find_capture, load

NAME = "method-steps-cpu-1threads"
"""Of the stored file; methods that are not measured again stay in it as they are."""
PAIRS = [name for method in METHODS.values() for name in method.recipes if f"{name}_fast" in RECIPES]
FAST_STEPS = 8
"""Steps of the fast form: one period of what is kept between steps."""
LATE = 2400
"""The step whose schedules are measured: all has begun."""


def with_state_of(recipe: Any, start: Avatar) -> Avatar:
    """An avatar by a recipe, with another one's state."""
    avatar: Avatar = recipe.method.build(start.subject, recipe.seed)
    state = start.state_dict()
    avatar.load_stored(state)
    avatar.load_state_dict(state)
    return avatar


def untrained(recipe: Any, capture: Capture) -> Avatar:
    """An avatar as its training begins."""
    avatar: Avatar = recipe.method.build(Subject.of(capture), recipe.seed)
    avatar.prepare_training(capture, 0, torch.Generator().manual_seed(0))
    return avatar


def measure(recipe: Any, capture: Capture, start: Avatar, rays: int, steps: int, warm: int) -> dict[str, Any]:
    """Median and mean processor seconds of some steps on the same rays, and their parts."""
    avatar = with_state_of(recipe, start).train()
    subject = avatar.subject
    pixels = replace(RECIPES["fast"]().training.pixels, rays=rays, patches=0)
    source = PixelSource(capture.train, subject.body, subject.betas, pixels, avatar.ray_margin)
    optimizer = make_optimizer(avatar, recipe.training)
    frame, color = capture.train[0], torch.tensor(capture.background)
    parts = dict.fromkeys(("pose", "render", "losses", "backward", "optimizer"), 0.0)
    seconds: list[float] = []
    for number in range(warm + steps):
        mode = Mode(LATE + number - warm, epoch=60)
        generator = torch.Generator().manual_seed(1)
        batch = source.draw(0, generator)
        batch = batch.against(avatar.background(color, len(batch.rays), generator))
        marks = [time.process_time()]
        posed = avatar.pose(frame.pose, frame.translation, frame.frame_index, mode)
        marks.append(time.process_time())
        rendering = avatar.render(batch.rays, posed, batch.background, mode, generator)
        marks.append(time.process_time())
        loss = total(avatar.losses(rendering, batch, posed, mode, generator))
        marks.append(time.process_time())
        optimizer.zero_grad(set_to_none=True)
        loss.backward()
        marks.append(time.process_time())
        optimizer.step()
        marks.append(time.process_time())
        if number >= warm:
            seconds.append(marks[-1] - marks[0])
            for name, begin, end in zip(parts, marks[:-1], marks[1:], strict=True):
                parts[name] += (end - begin) / steps
    return {
        "mean_s": statistics.mean(seconds),
        "median_s": statistics.median(seconds),
        "steps": steps,
        "split_s": parts,
    }


def weight_volume(capture: Capture) -> dict[str, float]:
    """What HumanNeRF's weight volume takes by itself, whatever the rays; processor seconds."""
    avatar = RECIPES["humannerf"]().method.build(Subject.of(capture), 0)
    optimizer = torch.optim.Adam(avatar.volume.parameters(), lr=1e-9, fused=True)
    marks: list[list[float]] = []
    for _ in range(2):
        optimizer.zero_grad(set_to_none=True)
        times = [time.process_time()]
        volume = avatar.volume()
        times.append(time.process_time())
        volume.square().mean().backward()
        times.append(time.process_time())
        optimizer.step()
        marks.append([*times, time.process_time()])
    last = marks[-1]
    return {name: last[i + 1] - last[i] for i, name in enumerate(("forward_s", "backward_s", "update_s"))}


def main() -> None:
    """Measures and stores."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("methods", nargs="*", default=PAIRS)
    parser.add_argument("--rays", type=int, default=256)
    parser.add_argument("--run", action="append", default=[], help="NAME=FOLDER: a run of NAME_fast")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    tune_process()
    flush_denormals()
    runs = {name: Path(folder) for name, _, folder in (text.partition("=") for text in arguments.run)}
    stored = RESULTS / f"{NAME}.json"
    before = json.loads(stored.read_text("utf-8")) if stored.is_file() else {}
    kept = before if before.get("rays") == arguments.rays else {}
    result: dict[str, Any] = {
        "what": "training step of each method, seconds of the processor, one thread; busy machine",
        "rays": arguments.rays,
        "methods": kept.get("methods", {}),
        "weight_volume": kept.get("weight_volume", {}),
    }
    for name in arguments.methods:
        capture = read_capture(find_capture(runs[name])) if name in runs else studio_capture(192)
        start, steps = load(runs[name]) if name in runs else (untrained(RECIPES[f"{name}_fast"](), capture), 0)
        fast = measure(RECIPES[f"{name}_fast"](), capture, start, arguments.rays, FAST_STEPS, 1)
        dense = measure(RECIPES[name](), capture, start, arguments.rays, 1, 0)
        ratio = dense["mean_s"] / fast["mean_s"]
        result["methods"][name] = {"trained_steps": steps, "dense": dense, "fast": fast, "times_faster": ratio}
        print(f"{name}: dense {dense['mean_s']:.2f} s, fast {fast['mean_s']:.3f} s, {ratio:.1f} times", flush=True)
    if "humannerf" in arguments.methods:
        result["weight_volume"] = weight_volume(studio_capture(192))
    store(NAME, result)


if __name__ == "__main__":
    main()
