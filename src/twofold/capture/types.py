"""What a data set is to everything above it: a `Capture` of `Frame`s."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import groupby, pairwise
from pathlib import Path
from typing import TypeVar

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from twofold.body.skeleton import Body
from twofold.geometry.cameras import Camera
from twofold.images import read_grey, read_rgb

Item = TypeVar("Item")

SPLITS = ("train", "novel_view", "novel_pose")
"""Training images; the same frames from other cameras; other frames."""
VIDEO_LENGTH = 16
"""Images of the video whose consistency is measured."""


@dataclass(frozen=True)
class Frame:
    """One image: what a camera saw in a frame. Images are read when asked for, so a long capture costs no memory.

    One that is damaged or gone is a `TwofoldError` then.

    Attributes:
        frame_index: index of the frame in the capture's motion.
        camera_name: which camera.
        camera: that camera.
        pose: axis-angle rotations, root first, radians, relative to SMPL's T-pose.
        translation: SMPL's own (the root turns about its rest joint, then this is added), metres.
        image_file: PNG or JPEG, 8-bit sRGB.
        mask_file: one channel, 0 outside .. 255 on the person.
        ignored_file: one channel, 255 where nobody knows what the person looks like; None where all is known.
    """

    frame_index: int
    camera_name: str
    camera: Camera
    pose: Float[Tensor, "24 3"]
    translation: Float[Tensor, "3"]
    image_file: Path
    mask_file: Path
    ignored_file: Path | None = None

    def image(self) -> Float[Tensor, "h w 3"]:
        """Colours in 0..1, as stored (background included)."""
        return torch.from_numpy(read_rgb(self.image_file).astype(np.float32) / 255)

    def mask(self) -> Float[Tensor, "h w"]:
        """Share of each pixel that the person covers, 0..1."""
        return torch.from_numpy(read_grey(self.mask_file).astype(np.float32) / 255)

    def composited(self, background: Float[Tensor, "3"]) -> Float[Tensor, "h w 3"]:
        """The person on a background colour, 0..1: the one place where an image meets a background."""
        mask = self.mask()[..., None]
        return self.image() * mask + background * (1 - mask)

    def ignored(self) -> Bool[Tensor, "h w"]:
        """Pixels that are neither learned from nor measured, because something passes in front of the person."""
        if self.ignored_file is None:
            return torch.zeros(self.camera.height, self.camera.width, dtype=torch.bool)
        return torch.from_numpy(read_grey(self.ignored_file) > 127)


@dataclass(frozen=True)
class Capture:
    """A person filmed: body, cameras, motion, images, splits.

    Attributes:
        name: for titles.
        folder: where it lies.
        body: the body model as arrays.
        betas: its shape coefficients for this person.
        fps: frames per second.
        background: the colour behind the person where an image is composited, 0..1.
        splits: frames of "train", "novel_view" and "novel_pose" (the last two may be empty).
        meshes: true posed surfaces by time (npz with vertices in metres and faces), where they are known.
        credit: whom to name when showing it; empty for one's own.
        seconds: when each frame of the motion was taken, from the first one on, where the rate varies; `fps` is the
            mean then.
    """

    name: str
    folder: Path
    body: Body
    betas: Float[Tensor, "S"]
    fps: float
    background: tuple[float, float, float]
    splits: dict[str, tuple[Frame, ...]]
    meshes: dict[int, Path] = field(default_factory=dict)
    credit: str = ""
    seconds: Float[Tensor, "T"] | None = None

    def second(self, frame: int) -> float:
        """When a frame was taken, seconds, by its index."""
        return float(self.seconds_of([frame])[0])

    def seconds_of(self, frames: Sequence[int]) -> Float[np.ndarray, "n"]:
        """When frames were taken, seconds, by their indices."""
        if self.seconds is None:
            return np.array(frames, dtype=np.float64) / self.fps
        return self.seconds[list(frames)].numpy().astype(np.float64)

    @property
    def train(self) -> tuple[Frame, ...]:
        """The training frames."""
        return self.splits["train"]


def spread(items: Sequence[Item], most: int | None = None) -> list[Item]:
    """At most this many items, evenly spread, the first and the last among them; None for all.

    >>> spread("abcdefg", 3)
    ['a', 'd', 'g']
    """
    count = len(items) if most is None else min(most, len(items))
    chosen = np.linspace(0, len(items) - 1, count).round().astype(int)
    return [items[i] for i in chosen.tolist()]


def steady_video(capture: Capture, most: int = VIDEO_LENGTH) -> list[Frame]:
    """Successive frames of one camera that stands still: the longest such run of novel poses, else of another split."""
    best: list[Frame] = []
    for split in ("novel_pose", "novel_view", "train"):
        frames = sorted(capture.splits.get(split, ()), key=lambda f: (f.camera_name, f.frame_index))
        for _, group in groupby(frames, key=lambda f: f.camera_name):
            taken = list(group)
            step = min(
                (b.frame_index - a.frame_index for a, b in pairwise(taken) if b.frame_index > a.frame_index), default=0
            )
            usual = np.median(np.diff(capture.seconds_of([f.frame_index for f in taken]))) if len(taken) > 1 else 0.0
            run = taken[:1]
            for before, now in pairwise(taken):
                still = torch.equal(before.camera.world_to_camera, now.camera.world_to_camera)
                near = capture.second(now.frame_index) - capture.second(before.frame_index) < 1.5 * usual
                run = [*run, now] if now.frame_index - before.frame_index == step and still and near else [now]
                if len(run) > max(len(best), 1):
                    best = run
        if best:
            break
    return best[:most]
