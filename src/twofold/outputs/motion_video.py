"""A motion as a video, or as images with opacity: of an avatar, of its mesh, or of a bare body."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, UInt8
from PIL import Image, ImageColor
from torch import Tensor

from twofold.body.motion import Motion
from twofold.body.skeleton import ShapedBody, pose_body
from twofold.errors import TwofoldError
from twofold.files import made_folder, new_folder
from twofold.geometry.cameras import Camera
from twofold.inputs import is_there
from twofold.methods.base import Avatar
from twofold.outputs.mesh_images import floor_image, mesh_image
from twofold.outputs.video import write_alpha_video, write_video
from twofold.outputs.views import render_image

VIDEO_ENDINGS = (".mp4", ".webm", ".mov")
"""Videos that are written; the last two can hold opacity."""


@dataclass(frozen=True)
class View:
    """An image of a frame: colour times opacity (that is, on black), opacity, what stands behind (None: a colour)."""

    color: Float[Tensor, "h w 3"]
    opacity: Float[Tensor, "h w"]
    behind: Float[Tensor, "h w 3"] | None = None

    def on(self, background: Float[Tensor, "3"]) -> Float[Tensor, "h w 3"]:
        """Composited on what stands behind, or on a colour."""
        behind = background if self.behind is None else self.behind
        return self.color + (1 - self.opacity[..., None]) * behind

    def with_alpha(self) -> Float[Tensor, "h w 4"]:
        """Straight (not premultiplied) colour and opacity."""
        opacity = self.opacity[..., None]
        return torch.cat([self.color / opacity.clamp_min(1e-4), opacity], -1).clamp(0, 1)


Renderer = Callable[[int, Camera], View]
"""Makes the view of a motion's frame (by its index) from a camera."""


@torch.no_grad()
def rest_body(avatar: Avatar) -> ShapedBody:
    """The body of an avatar in the T-pose, for reading motions onto it and placing cameras (on the CPU)."""
    posed = avatar.pose(torch.zeros(24, 3), torch.zeros(3)).body
    parts = (posed.vertices, posed.joints, posed.faces, posed.weights)
    vertices, joints, faces, weights = (part.detach().cpu() for part in parts)
    return ShapedBody(vertices, joints, faces, weights, vertices.new_zeros(len(vertices), 3, 0))


def field_renderer(avatar: Avatar, motion: Motion, chunk: int | None = None) -> Renderer:
    """Renders the avatar's field: the best image, the slowest."""

    @torch.no_grad()
    def view(index: int, camera: Camera) -> View:
        posed = avatar.pose(motion.poses[index], motion.translations[index])
        image = render_image(avatar, posed, camera, torch.zeros(3), chunk)
        return View(image.color, image.opacity)

    return view


def body_renderer(body: ShapedBody, motion: Motion, background: Float[Tensor, "3"], floor: bool = True) -> Renderer:
    """Renders a bare body as clay, on a floor with its shadow."""

    def view(index: int, camera: Camera) -> View:
        vertices = pose_body(body, motion.poses[index], motion.translations[index]).vertices
        color, opacity = mesh_image(camera, vertices, body.faces)
        return View(color, opacity, floor_image(camera, background, vertices, body.faces) if floor else None)

    return view


def read_color(text: str) -> Float[Tensor, "3"]:
    """A colour by name ("white"), as "#rrggbb", or as three numbers "0.2,0.3,0.4"; 0..1.

    >>> read_color("#ff8000").tolist()[:1], read_color("0,0.5,1").tolist()
    ([1.0], [0.0, 0.5, 1.0])

    Raises:
        TwofoldError: it is none of these.
    """
    advice = f"--background should be a colour such as white, #20a0ff or 0.1,0.2,0.3 (0 to 1); it is {text!r}."
    parts = text.split(",")
    try:
        if len(parts) == 3:
            numbers = torch.tensor([float(part) for part in parts])
            if not ((numbers >= 0) & (numbers <= 1)).all():
                raise TwofoldError(advice)
            return numbers
        return torch.tensor(ImageColor.getrgb(text)[:3]) / 255
    except ValueError as error:
        raise TwofoldError(advice) from error


def require_video_path(path: Path, alpha: bool) -> None:
    """Checks before any rendering that a motion can be written to `path`.

    Raises:
        TwofoldError: its ending is of a video that is not written, or that holds no opacity where that is wanted.
    """
    ending = path.suffix.lower()
    if ending and ending not in VIDEO_ENDINGS:
        raise TwofoldError(f"--out should end in {', '.join(VIDEO_ENDINGS)} or be a folder for images, it is {path}.")
    if alpha and ending == ".mp4":
        raise TwofoldError("An MP4 holds no opacity; with --alpha let --out end in .webm or .mov, or name a folder.")
    if is_there(path) and path.is_dir() == bool(ending):
        what = "a folder" if ending else "a file"
        raise TwofoldError(f"{path} exists and is {what}; choose another --out.")


def write_motion(
    path: Path,
    fps: float,
    cameras: list[Camera],
    renderer: Renderer,
    background: Float[Tensor, "3"],
    alpha: bool = False,
    progress: Callable[[float], None] = lambda _: None,
    replace: bool = False,
) -> None:
    """Renders a motion into a video (by the ending of `path`) or a folder of PNG images, whole or not at all.

    Args:
        path: see `require_video_path`.
        fps: frames per second.
        cameras: one for every frame.
        renderer: of the motion's frames.
        background: colour behind, 0..1.
        alpha: keep the opacity instead of a background.
        progress: called with the fraction that is done.
        replace: overwrite a folder that holds files.

    Raises:
        TwofoldError: the place cannot be written to.
    """

    def views() -> Iterator[UInt8[np.ndarray, "h w c"]]:
        for index, camera in enumerate(cameras):
            view = renderer(index, camera)
            image = view.with_alpha() if alpha else view.on(background).clamp(0, 1)
            yield (image * 255).round().to(torch.uint8).numpy()
            progress((index + 1) / len(cameras))

    if path.suffix:
        with made_folder(path.parent):
            (write_alpha_video if alpha else write_video)(path, views(), fps)
        return
    with new_folder(path, replace) as folder:
        for index, image in enumerate(views()):
            Image.fromarray(image).save(folder / f"{index:06d}.png")
