"""Seconds to render images of the demo's kind of avatar: quick and paper-size networks, 256 and 512 square.

The reference form (error-bounded sampler, gradients by autograd) renders a small image; its seconds for a large one
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
from twofold.field.grids import body_distance
from twofold.kernels.runtime import tune_process
from twofold.methods.base import Avatar
from twofold.methods.factorized import FactorizedAvatar
from twofold.methods.factorized_recipes import fast, quick
from twofold.methods.subject import Subject
from twofold.outputs.views import render_image
from twofold.training.loop import train


def seconds(avatar: Avatar, capture: Capture, size: int, repeats: int) -> dict[str, float]:
    """Time of one image from the training camera, posing included."""
    frame = capture.train[0]
    camera = frame.camera.resized(size, size)
    background = torch.tensor(capture.background)
    device = next(avatar.parameters()).device

    def image() -> None:
        with torch.no_grad():
            render_image(avatar, avatar.pose(frame.pose, frame.translation), camera.to(device), background)

    return timed(image, repeats)


def take_shape(avatar: FactorizedAvatar, capture: Capture, steps: int = 300, points: int = 2048) -> float:
    """Brings a field to the body's own surface, as training would, in a minute: networks start as a sphere.

    Returns:
        how far the field's distance is from the body's within 6 cm of its surface, metres, mean.
    """
    generator = torch.Generator().manual_seed(0)
    device, vertices = avatar.device, avatar.canonical_points.cpu()
    near = vertices[torch.randint(len(vertices), (100_000,), generator=generator)]
    x = near + 0.06 * (2 * torch.rand(len(near), 3, generator=generator) - 1)
    wanted = torch.from_numpy(body_distance(x.numpy(), vertices.numpy(), capture.body.faces.numpy())).to(device)
    x = x.to(device)
    frame = capture.train[0]
    condition = avatar.pose(frame.pose, frame.translation).own.condition
    optimizer = torch.optim.Adam(avatar.field.parameters(), 5e-4)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, steps)
    average = 1.0
    for _ in range(steps):
        which = torch.randint(len(x), (points,), generator=generator).to(device)
        loss = (avatar.field.sdf(x[which], condition) - wanted[which]).abs().mean()
        optimizer.zero_grad(set_to_none=True)
        loss.backward()
        torch.nn.utils.clip_grad_norm_(avatar.field.parameters(), 1.0)
        optimizer.step()
        schedule.step()
        average += 0.1 * (float(loss.detach()) - average)
    avatar.eval()
    return average


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
    # A density scale of 3 mm is what a trained avatar has.
    method = at_work(fast().method)
    paper_size = replace(method, beta=0.003).build(Subject.of(capture), 0).to(device)
    result["fast_off_the_body_m"] = take_shape(paper_size, capture)
    result["fast"] = {size: seconds(paper_size, capture, size, 1) for size in (256, 512)}
    slow = at_work(reference().method).build(Subject.of(capture), 0).to(device).eval()
    result["reference"] = {48: seconds(slow, capture, 48, 1)}
    result["peak_memory_gb"] = peak_memory_gb()
    store(f"rendering-{device.type}-{arguments.threads}threads", result)


if __name__ == "__main__":
    main()
