"""The images of a run's report: held-out frames with error maps, branches, front and back, videos."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import islice
from pathlib import Path

import numpy as np
import torch
from jaxtyping import UInt8
from PIL import Image

from twofold.capture.types import Capture, Frame, spread
from twofold.evaluation import render_frame
from twofold.methods.base import Avatar
from twofold.metrics.image import psnr_box, to_8bit
from twofold.outputs.gallery import around_person, motion_frames, orbit_frames, panels, scene_up, shown_truth
from twofold.outputs.sheets import ERROR_RANGE, as_bytes, error_map
from twofold.outputs.video import write_video
from twofold.outputs.views import RenderedImage, orbit, pose_canonically, render_image
from twofold.report.page_character import PageCharacter, mesh_orbit
from twofold.report.parts import CaptionedImage, Row, Video

SPLITS = {"novel_view": "Novel views", "novel_pose": "Novel poses"}
"""Held-out splits and their headings."""
MIN_ROWS = 300
"""Images with fewer rows are enlarged, so that a phone shows their pixels and not a blur."""
MAX_MOTION = 60
"""Frames of the held-out motion that the page's video shows."""
FIELD, MESH = "the field, volume rendered", "the baked mesh, rasterized"
"""Which renderer made an image, in words."""


@dataclass(frozen=True)
class HeldOut:
    """A held-out frame and its rendering."""

    split: str
    frame: Frame
    image: RenderedImage


def held_out(
    avatar: Avatar, capture: Capture, count: int, on_image: Callable[[], None] = lambda: None
) -> list[HeldOut]:
    """Renders `count` frames of each held-out split, of different cameras where there are several."""
    found: list[HeldOut] = []
    for split in SPLITS:
        for frame in one_each(capture.splits.get(split, ()), count):
            found.append(HeldOut(split, frame, render_frame(avatar, capture, frame, True)))
            on_image()
    return found


def one_each(frames: Sequence[Frame], count: int) -> list[Frame]:
    """At most `count` frames, spread over the cameras and over time."""
    cameras = sorted({frame.camera_name for frame in frames})
    if len(cameras) < 2:
        return spread(list(frames), count) if frames else []
    chosen: list[Frame] = []
    for number, camera in enumerate(spread(cameras, count)):
        own = [frame for frame in frames if frame.camera_name == camera]
        chosen.append(own[round((number + 0.5) / min(count, len(cameras)) * (len(own) - 1))])
    return chosen


def comparison_row(capture: Capture, shown: Sequence[HeldOut]) -> Row:
    """Each frame as one image: ground truth, avatar, error map, cut to the person."""
    background = torch.tensor(capture.background)
    images: list[CaptionedImage] = []
    for held in shown:
        frame, image = held.frame, held.image
        truth, mask = shown_truth(frame, background), frame.mask()
        error = error_map(image.color, frame.composited(background))
        error[frame.ignored()] = 0
        box = around_person(mask)
        parts = [as_bytes(part)[box] for part in (truth, image.color, error)]
        caption = f"{frame.camera_name}, frame {frame.frame_index}"
        if (mask > 0.5).any():
            color = psnr_box(image.color, frame.composited(background), mask, ignored=frame.ignored())
            caption += f": {color:.1f} dB in the box"
        images.append(CaptionedImage(enlarged(np.concatenate(parts, 1)), caption, small=True))
    return Row(tuple(images), "Ground truth, avatar, error", wrapped=True)


ERROR_TEXT = f"Error: mean absolute difference of the colours, black 0, pale yellow {ERROR_RANGE:g} or more of 1."


def branches_row(shown: HeldOut) -> Row | None:
    """The parts that a rendering is the sum of; None for methods without a base branch."""
    if not shown.image.has_base:
        return None
    box, names = (
        around_person(shown.frame.mask()),
        {"full": "full", "base": "pose-independent base", "residual": "residual"},
    )
    names |= {"normals": "normals", "base normals": "normals of the base"}
    parts = panels(shown.image)
    return Row(
        tuple(CaptionedImage(enlarged(parts[name][box]), words, small=True) for name, words in names.items()),
        f"{shown.frame.camera_name}, frame {shown.frame.frame_index}",
    )


@torch.no_grad()
def canonical_images(
    avatar: Avatar, capture: Capture, size: int, on_image: Callable[[], None] = lambda: None
) -> dict[str, RenderedImage]:
    """The avatar in the canonical pose, from the front and from behind, by the field."""
    posed, found = pose_canonically(avatar), dict[str, RenderedImage]()
    for name, camera in zip(("front", "back"), orbit(posed, size, 2), strict=True):
        found[name] = render_image(avatar, posed, camera, torch.tensor(capture.background))
        on_image()
    return found


def canonical_row(images: dict[str, RenderedImage]) -> Row:
    """Front and back, colours and normals."""
    parts = {name: panels(image) for name, image in images.items()}
    return Row(
        tuple(CaptionedImage(part["full"], name, small=True) for name, part in parts.items())
        + tuple(CaptionedImage(part["normals"], f"{name}, normals", small=True) for name, part in parts.items())
    )


def write_orbit(
    path: Path, avatar: Avatar, capture: Capture, size: int, views: int, character: PageCharacter | None,
    on_image: Callable[[], None] = lambda: None,
) -> Video:  # fmt: skip
    """An orbit of the first training frame: by the mesh where a character is given, else by the field."""
    with torch.no_grad():
        if character is not None:
            frames = mesh_orbit(character.character, size, views, np.array(capture.background))
            write_video(path, frames, max(views // 3, 1))
            return Video(path, f"Orbit. Renderer: {MESH}.", (size, size))
        frame = capture.train[0]
        posed = avatar.pose(frame.pose, frame.translation, frame.frame_index)

        def counted(image: RenderedImage) -> UInt8[np.ndarray, "h w 3"]:
            on_image()
            return to_8bit(image.color).numpy()

        turning = orbit_frames(avatar, posed, capture, size, views, scene_up(capture))
        write_video(path, (counted(image) for image in turning), max(views // 3, 1))
    return Video(path, f"Orbit. Renderer: {FIELD}.", (size, size))


def write_novel_poses(
    path: Path, avatar: Avatar, capture: Capture, size: int, on_image: Callable[[], None] = lambda: None
) -> Video | None:
    """The held-out motion from one camera by the field; None where there is none."""
    whole, shown = held_out_motion(capture)
    if not shown:
        return None

    extent: list[tuple[int, int]] = []

    def images() -> Iterator[UInt8[np.ndarray, "h w 3"]]:
        for image in islice(motion_frames(avatar, capture, "novel_pose", size), shown):
            on_image()
            extent.append((image.shape[1], image.shape[0]))
            yield image

    write_video(path, images(), 6 if shown <= MAX_MOTION // 3 else 12)
    part = "The held-out motion" if whole == shown else f"The first {shown} of {whole} frames of the held-out motion"
    return Video(path, f"{part}. Renderer: {FIELD}.", extent[0])


def held_out_motion(capture: Capture) -> tuple[int, int]:
    """How many frames the held-out motion has, and how many of them a page shows."""
    whole = len({frame.frame_index for frame in capture.splits.get("novel_pose", ())})
    return whole, min(whole, MAX_MOTION)


def enlarged(image: UInt8[np.ndarray, "h w 3"]) -> UInt8[np.ndarray, "H W 3"]:
    """The image, a whole number of times as large, so that it has at least `MIN_ROWS` rows."""
    times = -(-MIN_ROWS // len(image))
    if times <= 1:
        return image
    size = (times * image.shape[1], times * image.shape[0])
    return np.asarray(Image.fromarray(image).resize(size, Image.Resampling.BICUBIC)).copy()
