"""Runs of several methods beside ground truth, also where one had to be trained on other images of the same person.

python -m benchmarks.methods_sheet RUN [RUN ...] --sheet docs/pictures/methods_sheet.jpg [--split novel_view novel_pose]

`twofold compare` does the same for runs of one capture. Vid2Avatar without masks needs images with a background, the
others may have been trained without; the frames shown are those of the first run's capture, in the same poses.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import torch
from PIL import Image

from twofold.capture.folder import read_capture
from twofold.comparison import shown_frames
from twofold.evaluation import render_frame
from twofold.outputs.gallery import around_person
from twofold.outputs.sheets import as_bytes, sheet
from twofold.training.run import find_capture, load, read_recipe


@torch.no_grad()
def main() -> None:
    """Draws the sheet."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("runs", type=Path, nargs="+")
    parser.add_argument("--sheet", type=Path, required=True)
    parser.add_argument("--split", nargs="+", default=["novel_view", "novel_pose"])
    parser.add_argument("--images", type=int, default=12, help="of each split, evenly spread, of which some are shown")
    arguments = parser.parse_args()
    avatars = {read_recipe(run).name: load(run, torch.device("cpu"))[0] for run in arguments.runs}
    capture = read_capture(find_capture(arguments.runs[0], None))
    background = torch.tensor(capture.background)
    rows, labels = [], []
    for split in arguments.split:
        for frame in shown_frames(capture, split, arguments.images):
            part = around_person(frame.mask())
            images = [render_frame(avatar, capture, frame, True).color for avatar in avatars.values()]
            rows.append([as_bytes(image)[part] for image in (frame.composited(background), *images)])
            labels.append(f"{split.replace('_', ' ')}, {frame.camera_name} {frame.frame_index}")
            print(labels[-1], flush=True)
    drawn = sheet(rows, labels, ["ground truth", *avatars], footer=capture.credit)
    Image.fromarray(drawn).convert("RGB").save(arguments.sheet, quality=88)


if __name__ == "__main__":
    main()
