"""How well runs of `vid2avatar` told the person from the background: a sheet of training frames, and numbers.

python -m benchmarks.separation RUN [RUN ...] --sheet docs/pictures/methods_background.jpg [--name background]

A row is a training frame: the image, the rendering, the background alone, the person alone, the opacity.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
import torch
from PIL import Image

from benchmarks.common import store
from twofold.capture.folder import read_capture
from twofold.capture.types import Capture, Frame, spread
from twofold.geometry.cameras import pixel_grid, pixel_rays
from twofold.methods.vid2avatar import Vid2Avatar
from twofold.metrics.image import psnr, silhouette_iou
from twofold.outputs.views import rays_at_once, render_image
from twofold.training.clock import read_spent
from twofold.training.run import CHECKPOINT, find_capture, load, read_recipe

ROWS = 2
"""Frames of each run that are shown, evenly spread."""
MEASURED = 6
"""Frames of each run that are measured, evenly spread."""


@torch.no_grad()
def pieces(avatar: Vid2Avatar, frame: Frame) -> list[torch.Tensor]:
    """Image, rendering, background alone, person alone and opacity of a training frame, [h w 3] each, 0..1."""
    posed = avatar.pose(frame.pose, frame.translation, frame.frame_index)
    rays = pixel_rays(frame.camera, pixel_grid(frame.camera).flatten(0, 1))
    size = frame.camera.height, frame.camera.width
    parts = torch.arange(len(rays)).split(rays_at_once(avatar.device))
    scene = torch.cat([avatar.scene_color(rays[part], posed) for part in parts]).unflatten(0, size)
    person = render_image(avatar, posed, frame.camera, torch.zeros(3))
    opacity = person.opacity[..., None].clamp(0, 1)
    return [frame.image(), person.color + (1 - opacity) * scene, scene, person.color, opacity.expand(-1, -1, 3)]


def measured(avatar: Vid2Avatar, capture: Capture) -> dict[str, float]:
    """Means over training frames: overlap of opacity and mask, PSNR of the whole image (dB)."""
    overlaps, errors = [], []
    for frame in spread(capture.train, MEASURED):
        image, whole, _, _, opacity = pieces(avatar, frame)
        overlaps.append(silhouette_iou(opacity[..., 0], frame.mask()))
        errors.append(psnr(whole.clamp(0, 1), image))
    return {"silhouette_iou": float(np.mean(overlaps)), "psnr_whole_image": float(np.mean(errors))}


def main() -> None:
    """Draws the sheet; with a name it stores the numbers, too."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("runs", type=Path, nargs="+")
    parser.add_argument("--sheet", type=Path, required=True)
    parser.add_argument("--name", default=None)
    arguments = parser.parse_args()
    rows, numbers = [], []
    for run in arguments.runs:
        avatar, _ = load(run, torch.device("cpu"))
        if not isinstance(avatar, Vid2Avatar) or avatar.scene is None:
            parser.error(f"{run} has no background field")
        capture, recipe = read_capture(find_capture(run, None)), read_recipe(run)
        rows += [torch.cat(pieces(avatar, frame), 1) for frame in spread(capture.train, ROWS)]
        spent = read_spent(run / CHECKPOINT)
        numbers.append(
            {
                "recipe": recipe.name, "steps": recipe.training.steps,
                "processor_seconds": None if spent is None else spent.processor,
                "separation": vars(recipe.method.separation), "beta": recipe.method.beta,
                "rates": vars(recipe.method.rates), **measured(avatar, capture),
            }
        )  # fmt: skip
        print(numbers[-1], flush=True)
    sheet = (255 * torch.cat(rows).clamp(0, 1)).round().byte().numpy()
    Image.fromarray(sheet).save(arguments.sheet, quality=88)
    if arguments.name:
        store(f"methods-{arguments.name}", {"runs": numbers})


if __name__ == "__main__":
    main()
