"""An avatar of a real person on one picture: held-out images beside it, an orbit of a training pose, and of a new one.

python -m benchmarks.real_sheet RUN --sheet docs/pictures/real_juggle.jpg [--images 4] [--views 8] [--frame 30]
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from jaxtyping import UInt8
from PIL import Image

from twofold.body.builtin_motions import BUILTIN_MOTIONS
from twofold.body.motion import as_single
from twofold.body.skeleton import shape_body
from twofold.capture.folder import read_capture
from twofold.capture.types import Capture, Frame, spread
from twofold.evaluation import pose_at, render_frame
from twofold.methods.base import Avatar, PosedAvatar
from twofold.outputs.gallery import around_person
from twofold.outputs.sheets import as_bytes, sheet
from twofold.outputs.views import orbit, render_image
from twofold.training.run import find_capture, load

EDGE = 420
"""Rows and columns of the images of an orbit."""


def pairs(avatar: Avatar, capture: Capture, frames: Sequence[Frame]) -> list[UInt8[np.ndarray, "h w 3"]]:
    """Each image with the avatar beside it."""
    background, found = torch.tensor(capture.background), []
    for frame in frames:
        part = around_person(frame.mask())
        images = frame.composited(background), render_frame(avatar, capture, frame, True).color
        found.append(np.concatenate([as_bytes(image)[part] for image in images], 1))
    return found


def around(avatar: Avatar, capture: Capture, posed: PosedAvatar, views: int) -> list[UInt8[np.ndarray, "h w 3"]]:
    """Views from all sides."""
    background = torch.tensor(capture.background)
    images = [as_bytes(render_image(avatar, posed, c, background).color) for c in orbit(posed, EDGE, views)]
    # Cut to what is not background in any of them.
    person = np.any([np.abs(i.astype(int) - as_bytes(background[None, None])).max(-1) > 12 for i in images], 0)
    if not person.any():
        raise SystemExit(f"the avatar is invisible in views of {EDGE} x {EDGE} from all sides; train it further")
    rows, columns = (np.flatnonzero(person.any(axis)) for axis in (1, 0))
    part = slice(max(rows[0] - 4, 0), rows[-1] + 5), slice(max(columns[0] - 4, 0), columns[-1] + 5)
    return [image[part] for image in images]


def strip(images: Sequence[UInt8[np.ndarray, "_ _ 3"]], height: int) -> UInt8[np.ndarray, "h w 3"]:
    """Images of any size beside each other, brought to one height."""
    sizes = [(round(image.shape[1] * height / image.shape[0]), height) for image in images]
    scaled = [
        np.array(Image.fromarray(i).resize(size, Image.Resampling.LANCZOS))
        for i, size in zip(images, sizes, strict=True)
    ]
    return np.concatenate(scaled, 1)


@torch.no_grad()
def main() -> None:
    """Draws the picture."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", type=Path)
    parser.add_argument("--sheet", type=Path, required=True)
    parser.add_argument("--images", type=int, default=4, help="held-out images")
    parser.add_argument("--views", type=int, default=8)
    parser.add_argument("--frame", type=int, default=30, help="of the dance, whose pose is the new one")
    parser.add_argument("--height", type=int, default=260)
    arguments = parser.parse_args()
    avatar, _ = load(arguments.run)
    capture = read_capture(find_capture(arguments.run, None))
    rows, labels = [], []
    for split, label in (("novel_view", "other cameras"), ("novel_pose", "held-out images")):
        if frames := spread(capture.splits.get(split, ()), arguments.images):
            rows.append(pairs(avatar, capture, frames))
            labels.append(f"{label}, avatar beside them")
            print(label, flush=True)
    middle = capture.train[len(capture.train) // 2]
    rows.append(around(avatar, capture, pose_at(avatar, capture, middle), arguments.views))
    motion = as_single(BUILTIN_MOTIONS["dance"](shape_body(capture.body, capture.betas)))
    if not 0 <= arguments.frame < len(motion):
        raise SystemExit(f"--frame should be 0 to {len(motion) - 1}, of the dance; it is {arguments.frame}")
    dancing = avatar.pose(motion.poses[arguments.frame], motion.translations[arguments.frame])
    rows.append(around(avatar, capture, dancing, arguments.views))
    strips = [[strip(row, arguments.height)] for row in rows]
    drawn = sheet(strips, [*labels, "from all sides", "in a new pose"], footer=capture.credit)
    Image.fromarray(drawn).convert("RGB").save(arguments.sheet, quality=86)


if __name__ == "__main__":
    main()
