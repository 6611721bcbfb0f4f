"""Colours of several cameras: one training camera is darker and tinted, and others measure the avatar.

A synthetic subject is filmed by four cameras that train; the images of one of them are multiplied with 0.85 and a tint.
The avatar is trained as it is, with the colours of the first camera as reference, and with their mean; on untouched
images and on changed ones. PSNR over the box of the untouched cameras that do not train.

python -m benchmarks.camera_colors [--steps 600] [--seed 3]
"""

from __future__ import annotations

import argparse
import shutil
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from PIL import Image

from benchmarks.common import store
from twofold.capture.folder import read_capture
from twofold.capture.types import Capture
from twofold.evaluation import measure_split
from twofold.methods.factorized_recipes import quick
from twofold.studio.generate import StudioConfig, make_studio
from twofold.training.loop import train

DARKER = np.array([0.85 * 1.05, 0.85, 0.85 * 0.95])
"""What the changed camera multiplies red, green and blue with."""
TRAINING = 4


def several(capture: Capture) -> Capture:
    """The capture with every second camera training, the others as novel views."""
    frames = (*capture.train, *capture.splits["novel_view"])
    cameras = [*dict.fromkeys(frame.camera_name for frame in frames)]
    chosen = set(cameras[::2][:TRAINING])
    train_frames = tuple(frame for frame in frames if frame.camera_name in chosen)
    others = tuple(frame for frame in frames if frame.camera_name not in chosen)
    return replace(capture, splits={"train": train_frames, "novel_view": others})


def changed(folder: Path, out: Path, camera: str) -> Path:
    """A copy of the capture in which one camera's images are darker and tinted."""
    shutil.copytree(folder, out)
    for file in (out / "images" / camera).iterdir():
        image = np.asarray(Image.open(file).convert("RGB"))
        Image.fromarray((image * DARKER).round().clip(0, 255).astype(np.uint8)).save(file, quality=95, subsampling=0)
    return out


def main() -> None:
    """Measures and stores."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--steps", type=int, default=600)
    parser.add_argument("--seed", type=int, default=3)
    parser.add_argument("--size", type=int, default=128)
    arguments = parser.parse_args()
    rows: dict[str, dict[str, object]] = {}
    with tempfile.TemporaryDirectory() as scratch:
        plain = Path(scratch) / "plain"
        make_studio(StudioConfig(arguments.seed, arguments.size, 40, 2 * TRAINING), plain)
        camera = several(read_capture(plain)).train[-1].camera_name
        dark = changed(plain, Path(scratch) / "dark", camera)
        for folder in (plain, dark):
            capture = several(read_capture(folder))
            for setting in ("off", "first", "mean") if folder == dark else ("off", "first"):
                recipe = quick()
                training = replace(
                    recipe.training.scaled(arguments.steps / recipe.training.steps), preview_every=0,
                    camera_colors=setting,
                )  # fmt: skip
                name = f"{folder.name} {setting}"
                recipe = replace(recipe, training=training, seed=arguments.seed)
                avatar = train(capture, recipe, Path(scratch) / name.replace(" ", "-"), torch.device("cpu"))
                found = measure_split(avatar, capture, "novel_view", 40)
                response = avatar.camera_response
                numbers = {} if response is None else response.numbers()
                learned = {n: round(v, 4) for n, v in numbers.items() if n.startswith(f"{camera}_")}
                rows[name] = {"psnr_box": found["psnr_box"], "ssim": found["ssim"], **learned}
                print(name, rows[name], flush=True)
    store(
        "camera-colors",
        {
            "what": f"quick trained on {TRAINING} cameras, one of which ({camera}) is changed in the rows 'dark': its "
            f"images are multiplied with {DARKER.round(4).tolist()}; measured by the {TRAINING} others",
            "steps": arguments.steps, "seed": arguments.seed, "size": arguments.size, "rows": rows,
        },
    )  # fmt: skip


if __name__ == "__main__":
    main()
