"""A training step at the released network sizes: ours against the reference form, on the same rays, in one run.

The reference form is how the field does it now: error-bounded sampler, every interval shaded, gradients of the distance
by automatic differentiation through automatic differentiation, float32. Ours samples the shell around the posed body
and takes the gradients by a hand-written reverse pass. Both have the same networks, losses (without LPIPS) and 1,728
rays.

Recipe `quick` is timed within a training, too: there the density is sharp, most samples are hidden, and a grid of
distances of some steps ago finds the others.

    python -m benchmarks.step [--threads 2] [--repeats 5] [--reference-repeats 1]
"""

from __future__ import annotations

import argparse
import itertools
import statistics
import tempfile
import time
from dataclasses import replace
from pathlib import Path

import torch

from benchmarks.common import peak_memory_gb, store, studio_capture, timed
from twofold.kernels.runtime import tune_process
from twofold.methods.base import Avatar, Mode
from twofold.methods.factorized import FactorizedAvatar, FactorizedConfig
from twofold.methods.factorized_recipes import fast, quick, released
from twofold.methods.subject import Subject
from twofold.recipe import Recipe
from twofold.training.loop import train
from twofold.training.pixels import PixelSource
from twofold.training.row_adam import make_optimizer


def reference() -> Recipe:
    """The reference form of the released recipe."""
    start = released()
    return replace(start, method=replace(start.method, field=replace(start.method.field, gradients="autograd")))


def at_work(method: FactorizedConfig) -> FactorizedConfig:
    """The method as it is for most of a training: pose conditioning on, density scale as after its first drop."""
    return replace(method, beta=0.01, pose=replace(method.pose, zero_until=0, zero_every=0))


def measure(recipe: Recipe, repeats: int, device: torch.device) -> dict[str, object]:
    """Seconds, split, samples and peak memory of one step."""
    capture = studio_capture(512)
    subject = Subject.of(capture)
    avatar: Avatar = at_work(recipe.method).build(subject, 0).to(device)
    pixels = released().training.pixels
    source = PixelSource(capture.train, subject.body, subject.betas, pixels)
    optimizer = make_optimizer(avatar, recipe.training)
    background = torch.tensor(capture.background, device=device)
    split = {"pose": 0.0, "render": 0.0, "losses": 0.0, "backward": 0.0, "optimizer": 0.0}
    rays = samples = 0
    count = 0
    mode = Mode(1)

    def step() -> None:
        nonlocal rays, samples, count
        generator = torch.Generator().manual_seed(1)
        frame = capture.train[0]
        batch = source.draw(0, generator, device).against(background)
        marks = [time.perf_counter()]
        posed = avatar.pose(frame.pose, frame.translation, frame.frame_index, mode)
        marks.append(time.perf_counter())
        rendering = avatar.render(batch.rays, posed, background, mode, generator)
        marks.append(time.perf_counter())
        loss = torch.stack(list(avatar.losses(rendering, batch, posed, mode, generator).values())).sum()
        marks.append(time.perf_counter())
        optimizer.zero_grad(set_to_none=True)
        loss.backward()
        marks.append(time.perf_counter())
        optimizer.step()
        marks.append(time.perf_counter())
        for name, begin, end in zip(split, marks[:-1], marks[1:], strict=True):
            split[name] += end - begin
        rays, count = len(batch.rays), count + 1
        samples = len(avatar.place(batch.rays, posed, mode, generator).samples) if count == 1 else samples

    result = timed(step, repeats, warm=1 if repeats > 1 else 0)
    return {
        **result,
        "rays": rays,
        "rays_per_s": rays / result["median_s"],
        "samples_per_ray": samples / rays,
        "split_s": {name: seconds / count for name, seconds in split.items()},
        "peak_memory_gb": peak_memory_gb(),
    }


def in_training(device: torch.device, steps: int = 600, last: int = 200) -> dict[str, object]:
    """Seconds of a step of `quick`, with the rays of the recipe, at the end of a short training."""
    capture, recipe, ended = studio_capture(512), quick(), list[float]()
    training = replace(recipe.training, steps=steps, preview_every=0, checkpoint_every=steps)
    recipe = replace(recipe, training=training)
    with tempfile.TemporaryDirectory() as folder:
        avatar = train(
            capture, recipe, Path(folder) / "run", device, progress=lambda _: ended.append(time.perf_counter())
        )
    assert isinstance(avatar, FactorizedAvatar)
    seconds = [end - begin for begin, end in itertools.pairwise(ended[-last - 1 : -1])]
    rays = training.pixels.rays * training.images_per_step
    source = PixelSource(capture.train, avatar.subject.body, avatar.subject.betas, training.pixels)
    frame, generator, mode = capture.train[0], torch.Generator().manual_seed(1), Mode(steps)
    batch = source.draw(0, generator, device)
    posed = avatar.pose(frame.pose, frame.translation, frame.frame_index, mode)
    median = statistics.median(seconds)
    return {
        "median_s": median,
        "best_s": min(seconds),
        "repeats": len(seconds),
        "rays": rays,
        "rays_per_s": rays / median,
        "samples_per_ray": len(avatar.place(batch.rays, posed, mode, generator).samples) / len(batch.rays),
        "peak_memory_gb": peak_memory_gb(),
    }


def main() -> None:
    """Measures and stores."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--threads", type=int, default=torch.get_num_threads())
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--reference-repeats", type=int, default=1)
    parser.add_argument("--device", default="cpu")
    arguments = parser.parse_args()
    torch.set_num_threads(arguments.threads)
    tune_process()
    device = torch.device(arguments.device)
    result: dict[str, object] = {"what": "training step", "threads": arguments.threads, "device": str(device)}
    result["quick"] = measure(quick(), arguments.repeats, device)
    result["quick_in_training"] = in_training(device)
    result["fast"] = ours = measure(fast(), arguments.repeats, device)
    result["reference"] = theirs = measure(reference(), arguments.reference_repeats, device)
    result["times_faster"] = float(theirs["median_s"]) / float(ours["median_s"])  # type: ignore[arg-type]
    store(f"step-{device.type}-{arguments.threads}threads", result)


if __name__ == "__main__":
    main()
