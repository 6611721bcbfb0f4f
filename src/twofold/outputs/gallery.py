"""The images that show a run: orbit, unseen views, unseen poses, canonical front and back."""

import functools
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import TypeVar

import numpy as np
import torch
from jaxtyping import Float, UInt8
from PIL import Image
from torch import Tensor

from twofold.capture.types import Capture, Frame, spread
from twofold.errors import TwofoldError
from twofold.files import plain_errors, write_atomically
from twofold.methods.base import Avatar, PosedAvatar
from twofold.metrics.image import subject_box
from twofold.outputs.shares import Shares
from twofold.outputs.sheets import as_bytes, color_normals, residual_image, sheet
from twofold.outputs.video import write_video
from twofold.outputs.views import RenderedImage, orbit, pose_canonically, render_image

Item = TypeVar("Item")
_ROWS = 5
"""Frames of a split beside the truth."""


def save_png(path: Path, image: UInt8[np.ndarray, "h w *c"]) -> None:
    """Writes a PNG, whole or not at all."""
    with plain_errors(path):
        path.parent.mkdir(parents=True, exist_ok=True)
    with write_atomically(path) as beside:
        Image.fromarray(image).save(beside, format="PNG")


def save_preview(avatar: Avatar, capture: Capture, folder: Path, step: int) -> None:
    """Writes previews/STEP.png: a training image, the avatar's and its normals, at most 256 pixels high."""
    frame = capture.train[(step // 7) % len(capture.train)]
    height = min(256, frame.camera.height)
    camera = frame.camera.resized(height, round(frame.camera.width * height / frame.camera.height))
    image = render_image(
        avatar, avatar.pose(frame.pose, frame.translation, frame.frame_index), camera, _background(capture)
    )
    true = Image.fromarray(as_bytes(frame.image())).resize((camera.width, height), Image.Resampling.BOX)
    parts = [np.asarray(true), *(panels(image)[name] for name in ("full", "normals"))]
    save_png(folder / "previews" / f"{step:06d}.png", np.concatenate(parts, 1))


def _background(capture: Capture) -> Tensor:
    return torch.tensor(capture.background)


def panels(image: RenderedImage) -> dict[str, UInt8[np.ndarray, "h w 3"]]:
    """What a rendering is made of, as images: full, normals, opacity; of a base branch base, residual, normals."""
    parts = {"full": image.color}
    if image.has_base:
        parts |= {"base": image.base, "residual": residual_image(image.color, image.base)}
    parts["normals"] = color_normals(image.normal, image.opacity)
    if image.has_base:
        parts["base normals"] = color_normals(image.base_normal, image.opacity)
    parts["opacity"] = image.opacity
    return {name: as_bytes(part) for name, part in parts.items()}


def beside_truth(
    avatar: Avatar, capture: Capture, frame: Frame, chunk: int | None = None
) -> tuple[UInt8[np.ndarray, "h w 3"], RenderedImage]:
    """A frame's own image on the background, and the avatar's."""
    background = _background(capture)
    posed = avatar.pose(frame.pose, frame.translation)
    image = render_image(avatar, posed, frame.camera, background, chunk)
    return as_bytes(shown_truth(frame, background)), image


def shown_truth(frame: Frame, background: Float[Tensor, "3"]) -> Float[Tensor, "h w 3"]:
    """A frame's own image on the background; what is ignored there is hatched in grey."""
    ignored = frame.ignored()
    rows, columns = (torch.arange(size) for size in ignored.shape)
    hatch = torch.where((rows[:, None] + columns) % 6 < 2, 0.75, 0.5)[..., None]
    return torch.where(ignored[..., None], hatch, frame.composited(background))


def comparison(
    avatar: Avatar, capture: Capture, frames: list[Frame], chunk: int | None = None,
    drawn: Callable[[], None] | None = None,
) -> UInt8[np.ndarray, "h w 3"]:  # fmt: skip
    """A sheet with a row for each frame: the truth beside all panels, cut to the person."""

    def rendered() -> Iterator[tuple[Frame, RenderedImage]]:
        for frame in frames:
            yield frame, beside_truth(avatar, capture, frame, chunk)[1]
            if drawn:
                drawn()

    return comparison_sheet(capture, rendered())


def comparison_sheet(capture: Capture, rendered: Iterable[tuple[Frame, RenderedImage]]) -> UInt8[np.ndarray, "h w 3"]:
    """The same of frames that were rendered already."""
    rows: list[list[UInt8[np.ndarray, "h w 3"]]] = []
    labels: list[str] = []
    columns: list[str] = []
    for frame, image in rendered:
        parts = {"truth": as_bytes(shown_truth(frame, _background(capture))), **panels(image)}
        columns = list(parts)
        where = around_person(frame.mask())
        rows.append([part[where] for part in parts.values()])
        labels.append(f"{frame.camera_name} {frame.frame_index}")
    return sheet(rows, labels, columns)


def around_person(mask: Float[Tensor, "h w"]) -> tuple[slice, slice]:
    """The person's box and a little room; the whole image where nobody is."""
    return subject_box(mask, margin=6) if (mask > 0.5).any() else (slice(None), slice(None))


def orbit_frames(
    avatar: Avatar, posed: PosedAvatar, capture: Capture, size: int, views: int, up: Float[Tensor, "3"] | None = None,
    chunk: int | None = None,
) -> Iterator[RenderedImage]:  # fmt: skip
    """Images from all around."""
    for camera in orbit(posed, size, views, up):
        yield render_image(avatar, posed, camera, _background(capture), chunk)


def scene_up(capture: Capture) -> Float[Tensor, "3"]:
    """Which way is up in the capture: the mean direction of its training cameras' upright."""
    ups = torch.stack([-frame.camera.world_to_camera[1, :3] for frame in capture.train])
    return torch.nn.functional.normalize(ups.mean(0), dim=0)


def motion_frames(
    avatar: Avatar, capture: Capture, split: str, size: int, chunk: int | None = None
) -> Iterator[UInt8[np.ndarray, "h w 3"]]:
    """A split's poses one after the other from one fixed camera; full beside base, where there is a base branch."""
    frames_by_index = {frame.frame_index: frame for frame in reversed(capture.splits[split])}
    camera = None
    for time in sorted(frames_by_index):
        frame = frames_by_index[time]
        height = min(size, frame.camera.height)
        camera = camera or frame.camera.resized(height, round(frame.camera.width * height / frame.camera.height))
        posed = avatar.pose(frame.pose, frame.translation)
        image = render_image(avatar, posed, camera, _background(capture), chunk)
        parts = [image.color, image.base] if image.has_base else [image.color]
        yield np.concatenate([as_bytes(part) for part in parts], 1)


def render_run(
    avatar: Avatar, capture: Capture, folder: Path, what: str, size: int, chunk: int | None,
    progress: Callable[[float], None], views: int = 24,
) -> None:  # fmt: skip
    """Draws everything, or one part, into a folder.

    Args:
        avatar: whom.
        capture: for cameras, poses and truth.
        folder: gets orbit.mp4, orbit/, novel_view.png, novel_pose.png, novel_pose.mp4, canonical.png.
        what: "all", "orbit", "views", "poses" or "canonical".
        size: edge of orbit and canonical images, pixels.
        chunk: rays at once; None as many as memory allows.
        progress: called with the fraction that is done.
        views: images of the orbit.

    Raises:
        TwofoldError: the capture has no frames for the one part that was asked for, or the folder cannot be written.
    """
    splits = {"views": "novel_view", "poses": "novel_pose"}
    if what in splits and not capture.splits.get(splits[what]):
        raise TwofoldError(
            f"{capture.folder} has no images in its split {splits[what]}, so there is nothing to compare with; "
            "draw the orbit or the canonical pose instead."
        )
    background = _background(capture)
    shares = Shares(*_pieces(capture, what, size, views), progress)

    def counted(kind: str, images: Iterable[Item]) -> Iterator[Item]:
        for image in images:
            shares.done(kind)
            yield image

    if what in ("all", "canonical"):
        posed = pose_canonically(avatar)
        drawn = (render_image(avatar, posed, camera, background, chunk) for camera in orbit(posed, size, 2))
        parts = [panels(image) for image in counted("canonical", drawn)]
        save_png(folder / "canonical.png", sheet([list(p.values()) for p in parts], ["front", "back"], list(parts[0])))
    for part, split in splits.items():
        if what in ("all", part) and capture.splits.get(split):
            frames = spread(capture.splits[split], _ROWS)
            rows = comparison(avatar, capture, frames, chunk, functools.partial(shares.done, part))
            save_png(folder / f"{split}.png", rows)
            if split == "novel_pose":
                moving = motion_frames(avatar, capture, split, size, chunk)
                _write_film(folder / "novel_pose.mp4", counted("motion", moving))
    if what in ("all", "orbit"):
        frame = capture.train[0]
        posed = avatar.pose(frame.pose, frame.translation, frame.frame_index)

        def turning() -> Iterator[np.ndarray]:
            images = orbit_frames(avatar, posed, capture, size, views, scene_up(capture), chunk)
            for view, image in enumerate(counted("orbit", images)):
                parts = panels(image)
                save_png(folder / "orbit" / f"{view:03d}.png", parts["full"])
                yield np.concatenate([parts["full"], parts["normals"]], 1)

        _write_film(folder / "orbit.mp4", turning())


def _pieces(capture: Capture, what: str, size: int, views: int) -> tuple[dict[str, int], dict[str, float]]:
    """How many images of each kind `render_run` draws, and their sizes beside each other, pixels."""
    seen, posed = (capture.splits.get(split, ()) for split in ("novel_view", "novel_pose"))
    frames_by_index = {frame.frame_index: frame.camera for frame in posed}
    counts = {
        "canonical": (2 if what in ("all", "canonical") else 0, size * size),
        "views": (min(len(seen), _ROWS) if what in ("all", "views") else 0, _pixels(seen)),
        "poses": (min(len(posed), _ROWS) if what in ("all", "poses") else 0, _pixels(posed)),
        "motion": (len(frames_by_index) if what in ("all", "poses") else 0, min(_pixels(posed), size * size)),
        "orbit": (views if what in ("all", "orbit") else 0, size * size),
    }
    return {name: count for name, (count, _) in counts.items()}, {
        name: float(area) for name, (_, area) in counts.items()
    }


def _pixels(frames: Sequence[Frame]) -> int:
    return frames[0].camera.height * frames[0].camera.width if frames else 0


def _write_film(path: Path, frames: Iterable[UInt8[np.ndarray, "h w 3"]]) -> None:
    with plain_errors(path):
        path.parent.mkdir(parents=True, exist_ok=True)
    write_video(path, frames, 12)
