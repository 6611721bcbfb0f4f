"""The pictures that show a run: orbit, unseen views, unseen poses, canonical front and back."""

from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, UInt8
from PIL import Image
from torch import Tensor

from twofold.capture.types import Capture, Frame
from twofold.files import write_atomically
from twofold.methods.base import Avatar, PosedAvatar
from twofold.metrics.image import to_8bit
from twofold.outputs.sheets import color_normals, residual_picture, sheet
from twofold.outputs.video import write_video
from twofold.outputs.views import Picture, draw, orbit, pose_canonically


def save_png(path: Path, image: UInt8[np.ndarray, "h w *c"]) -> None:
    """Writes a PNG, whole or not at all."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with write_atomically(path) as beside:
        Image.fromarray(image).save(beside, format="PNG")


def panels(picture: Picture) -> dict[str, UInt8[np.ndarray, "h w 3"]]:
    """What a rendering is made of, as pictures: full, base, residual, normals of both, opacity."""
    opacity = picture.opacity[..., None].expand(-1, -1, 3)
    return {
        "full": to_8bit(picture.color).numpy(),
        "base": to_8bit(picture.base).numpy(),
        "residual": residual_picture(picture.color, picture.base),
        "normals": color_normals(picture.normal, picture.opacity),
        "base normals": color_normals(picture.base_normal, picture.opacity),
        "opacity": to_8bit(opacity).numpy(),
    }


def beside_truth(
    avatar: Avatar, capture: Capture, frame: Frame, chunk: int | None = None
) -> tuple[UInt8[np.ndarray, "h w 3"], Picture]:
    """A frame's own picture on the background, and the avatar's."""
    background = torch.tensor(capture.background)
    mask = frame.mask()[..., None]
    posed = avatar.pose(frame.pose, frame.translation)
    return to_8bit(frame.image() * mask + background * (1 - mask)).numpy(), draw(
        avatar, posed, frame.camera, background, chunk
    )


def comparison(avatar: Avatar, capture: Capture, frames: list[Frame], chunk: int | None = None) -> np.ndarray:
    """A sheet with a row for each frame: the truth beside all panels, cut to the person."""
    rows, labels, columns = [], [], []
    for frame in frames:
        true, picture = beside_truth(avatar, capture, frame, chunk)
        parts = {"truth": true, **panels(picture)}
        columns = list(parts)
        where = _around(frame.mask())
        rows.append([part[where] for part in parts.values()])
        labels.append(f"{frame.camera_name} {frame.time}")
    return sheet(rows, labels, columns)


def _around(mask: Float[Tensor, "h w"]) -> tuple[slice, slice]:
    rows, columns = (mask > 0.5).any(1).nonzero()[:, 0], (mask > 0.5).any(0).nonzero()[:, 0]
    margin = 6
    return (
        slice(max(int(rows.min()) - margin, 0), int(rows.max()) + margin),
        slice(max(int(columns.min()) - margin, 0), int(columns.max()) + margin),
    )


def spread(frames: tuple[Frame, ...], count: int) -> list[Frame]:
    """So many of the frames, evenly spread, each of another camera where there are several."""
    if not frames:
        return []
    chosen = np.linspace(0, len(frames) - 1, min(count, len(frames))).round().astype(int)
    return [frames[i] for i in chosen]


def orbit_frames(
    avatar: Avatar, posed: PosedAvatar, capture: Capture, size: int, views: int, up: Float[Tensor, "3"] | None = None
) -> Iterator[Picture]:
    """Pictures from all around."""
    for camera in orbit(posed, size, views, up):
        yield draw(avatar, posed, camera, torch.tensor(capture.background))


def scene_up(capture: Capture) -> Float[Tensor, "3"]:
    """Which way is up in the capture: the mean direction of its training cameras' upright."""
    ups = torch.stack([-frame.camera.world_to_camera[1, :3] for frame in capture.train])
    return torch.nn.functional.normalize(ups.mean(0), dim=0)


def motion_frames(avatar: Avatar, capture: Capture, split: str, size: int) -> Iterator[np.ndarray]:
    """A split's poses one after the other from one fixed camera, full beside base."""
    moments = {frame.time: frame for frame in reversed(capture.splits[split])}
    camera = None
    for time in sorted(moments):
        frame = moments[time]
        height = min(size, frame.camera.height)
        camera = camera or frame.camera.resized(height, round(frame.camera.width * height / frame.camera.height))
        picture = draw(avatar, avatar.pose(frame.pose, frame.translation), camera, torch.tensor(capture.background))
        yield np.concatenate([to_8bit(picture.color).numpy(), to_8bit(picture.base).numpy()], 1)


def render_run(
    avatar: Avatar, capture: Capture, folder: Path, what: str, size: int, chunk: int | None,
    show: Callable[[float], None], views: int = 24,
) -> None:  # fmt: skip
    """Draws everything, or one part, into a folder.

    Args:
        avatar: whom.
        capture: for cameras, poses and truth.
        folder: gets orbit.mp4, orbit/, novel_view.png, novel_pose.png, novel_pose.mp4, canonical.png.
        what: "all", "orbit", "views", "poses" or "canonical".
        size: edge of orbit and canonical pictures, pixels.
        chunk: rays at once; None as many as memory allows.
        show: told the share that is done.
        views: pictures of the orbit.
    """
    folder.mkdir(parents=True, exist_ok=True)
    background = torch.tensor(capture.background)
    if what in ("all", "canonical"):
        posed = pose_canonically(avatar)
        parts = [panels(draw(avatar, posed, camera, background, chunk)) for camera in orbit(posed, size, 2)]
        save_png(folder / "canonical.png", sheet([list(p.values()) for p in parts], ["front", "back"], list(parts[0])))
    show(0.1)
    for part, split, name in (("views", "novel_view", "novel_view"), ("poses", "novel_pose", "novel_pose")):
        if what in ("all", part) and capture.splits.get(split):
            frames = spread(capture.splits[split], 5)
            save_png(folder / f"{name}.png", comparison(avatar, capture, frames, chunk))
            if split == "novel_pose":
                write_video(folder / "novel_pose.mp4", motion_frames(avatar, capture, split, size), 12)
        show(0.3)
    if what in ("all", "orbit"):
        frame = capture.train[0]
        posed = avatar.pose(frame.pose, frame.translation, frame.time)

        def turning() -> Iterator[np.ndarray]:
            for view, picture in enumerate(orbit_frames(avatar, posed, capture, size, views, scene_up(capture))):
                color = to_8bit(picture.color).numpy()
                save_png(folder / "orbit" / f"{view:03d}.png", color)
                show(0.3 + 0.7 * (view + 1) / views)
                yield np.concatenate([color, color_normals(picture.normal, picture.opacity)], 1)

        write_video(folder / "orbit.mp4", turning(), 12)
    show(1.0)
