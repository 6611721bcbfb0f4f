"""How well masks meet the true outline: the estimator's, refined by the background, and an avatar's silhouettes.

    python -m benchmarks.masks [--acts turning bending ...] [--avatar-of turning] [--avatar-steps 1200]

Synthetic subjects before a room, filmed by a still camera as for `benchmarks.fits`; the estimator's masks are those of
`twofold prepare --refine-masks off`. Of one act an avatar is trained on masks as `prepare` refines them, and its
silhouettes in the corrected poses of its training images are measured, too: as they are, and refined like a mask.
"""

from __future__ import annotations

import argparse
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from jaxtyping import UInt8
from PIL import Image

from benchmarks.common import store
from benchmarks.filmed_subject import ACTS, FPS, film, true_masks
from twofold.capture.folder import read_capture
from twofold.capture.types import Capture, Frame
from twofold.evaluation import render_frame
from twofold.images import read_grey, read_rgb
from twofold.kernels.runtime import tune_process
from twofold.methods.table import chosen_recipe
from twofold.metrics.image import silhouette_iou
from twofold.prepare.detect import mask_refinement
from twofold.prepare.detect.mask_refinement import background_plate, refine_clip, refined_mask
from twofold.training import loop

PASSES = (1, 2, 3)
"""Numbers of passes of the refinement that are compared."""
Mask = UInt8[np.ndarray, "h w"]


def frames_of(capture: Capture) -> list[Frame]:
    """All frames of the one camera, in order."""
    return sorted((f for frames in capture.splits.values() for f in frames), key=lambda f: f.frame_index)


def mean_iou(masks: Sequence[Mask], truths: Sequence[Mask]) -> float:
    """Mean IoU of masks with the true ones, both 0..255."""
    shares = [[torch.from_numpy(mask / 255.0) for mask in part] for part in (masks, truths)]
    return float(np.mean([silhouette_iou(one, other) for one, other in zip(*shares, strict=True)]))


def save(path: Path, mask: Mask) -> None:
    """Writes a mask."""
    Image.fromarray(mask).save(path)


def refined(frames: Sequence[Frame], folder: Path, passes: int) -> list[Mask]:
    """The frames' masks after so many passes, by the function that `prepare` calls."""
    folder.mkdir()
    files = [Path(shutil.copy(frame.mask_file, folder / f"{frame.frame_index:06d}.png")) for frame in frames]
    refine_clip([frame.image_file for frame in frames], files, save, passes=passes)
    return [read_grey(file) for file in files]


def silhouettes(capture: Capture, folder: Path, steps: int) -> tuple[list[Mask], list[Mask]]:
    """An avatar's silhouettes after a training of `quick` on the capture, as they are and refined like masks."""
    avatar = loop.train(capture, chosen_recipe("quick", [], 0, steps=steps), folder, torch.device("cpu")).eval()
    frames = frames_of(capture)
    images = [read_rgb(frame.image_file) for frame in frames]
    with torch.no_grad():
        opacities = [render_frame(avatar, capture, frame, True).opacity.clamp(0, 1) for frame in frames]
    plain = [(255 * opacity).round().to(torch.uint8).numpy() for opacity in opacities]
    plate = background_plate(images, plain)
    return plain, [refined_mask(image, mask, plate) for image, mask in zip(images, plain, strict=True)]


def measured(act: str, seed: int, scratch: Path, steps: int) -> dict[str, float]:
    """IoU with the true outline of each kind of mask of one act; with steps, of an avatar as well."""
    clip, out = scratch / act / "clip", scratch / act / "capture"
    film(act, seed, clip)
    words = ["prepare", str(clip), "--out", str(out), "--fps", str(FPS), "--refine-masks", "off"]
    subprocess.run([sys.executable, "-m", "twofold", *words], check=True, stderr=subprocess.DEVNULL)
    capture = read_capture(out)
    frames = frames_of(capture)
    every = true_masks(act, seed)
    truths = [every[frame.frame_index] for frame in frames]
    row = {"estimated": mean_iou([read_grey(frame.mask_file) for frame in frames], truths)}
    by_passes = {passes: refined(frames, scratch / act / f"passes{passes}", passes) for passes in PASSES}
    row |= {f"passes_{passes}": mean_iou(masks, truths) for passes, masks in by_passes.items()}
    if steps:
        for frame, mask in zip(frames, by_passes[mask_refinement.PASSES], strict=True):
            save(frame.mask_file, mask)
        plain, sharp = silhouettes(read_capture(out), scratch / act / "run", steps)
        row |= {"avatar": mean_iou(plain, truths), "avatar_refined": mean_iou(sharp, truths)}
    return row


def main() -> None:
    """Measures and stores."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.masks", description=__doc__)
    parser.add_argument("--acts", nargs="+", choices=list(ACTS), default=list(ACTS))
    parser.add_argument("--avatar-of", nargs="*", choices=list(ACTS), default=["turning"])
    parser.add_argument("--avatar-steps", type=int, default=1200)
    given = parser.parse_args()
    tune_process()
    with tempfile.TemporaryDirectory() as scratch:
        rows = {
            act: measured(act, 1 + list(ACTS).index(act), Path(scratch), given.avatar_steps * (act in given.avatar_of))
            for act in given.acts
        }
    store("masks", {"acts": rows, "avatar_steps": given.avatar_steps})


if __name__ == "__main__":
    main()
