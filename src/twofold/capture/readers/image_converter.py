"""One image of a data set on its way into a capture: undistorted, resized, judged."""

from typing import final

import numpy as np
import torch
from jaxtyping import Float, UInt8
from PIL import Image
from torch import Tensor

from twofold.body.skeleton import Body
from twofold.capture.readers.sequence import SourceCamera, SourceImage
from twofold.capture.readers.world import posed
from twofold.errors import TwofoldError
from twofold.geometry.cameras import Camera, project
from twofold.geometry.lens import image_undistorter, largest_distortion
from twofold.geometry.silhouettes import overlap, silhouette

_LENS_MATTERS = 0.05
"""Pixels: a lens that moves no point by more needs no resampling."""
_FAR_TOO_SMALL = 0.1
_PERSON = 128


@final
class ImageConverter:
    """Brings the images of one camera to what a capture holds.

    Args:
        source: the camera.
        size: rows and columns of its images.
        scale: of rows and columns.
        joints: of the body in every frame, world, metres.

    Attributes:
        camera: of the images that come out.
    """

    def __init__(
        self, source: SourceCamera, size: tuple[int, int], scale: float, joints: Float[Tensor, "t 24 3"]
    ) -> None:
        height, width = size
        self._size = size
        bent = source.distortion
        matters = bent is not None and largest_distortion(source.intrinsics, bent, height, width) > _LENS_MATTERS
        self._straighten = (
            image_undistorter(source.intrinsics, bent, height, width) if bent is not None and matters else None
        )
        whole = Camera(
            torch.from_numpy(source.world_to_camera), torch.from_numpy(source.intrinsics.copy()), height, width
        )
        rows, columns = max(1, round(scale * height)), max(1, round(scale * width))
        fine = whole if (rows, columns) == size else whole.resized(rows, columns)
        pixels, depths = project(fine, joints)
        self._joints, self._in_front = pixels.numpy(), (depths > 0).all(-1).numpy()
        self.camera = Camera(fine.world_to_camera.float(), fine.intrinsics.float(), rows, columns)

    def converted(self, image: SourceImage) -> tuple[UInt8[np.ndarray, "h w 3"], UInt8[np.ndarray, "h w"]]:
        """Colours and mask of an image: undistorted first, then made smaller.

        Raises:
            TwofoldError: the image cannot be read, or has another size than the camera's first one.
        """
        colours, mask = image.read()
        if colours.shape[:2] != self._size or mask.shape != self._size:
            raise TwofoldError(
                f"{image.where} has {colours.shape[1]} x {colours.shape[0]} pixels (its mask {mask.shape[1]} x "
                f"{mask.shape[0]}), the camera's first image {self._size[1]} x {self._size[0]}; give all in one size."
            )
        if self._straighten is not None:
            both = self._straighten(np.concatenate([colours, mask[..., None]], -1))
            colours, mask = np.ascontiguousarray(both[..., :3]), np.ascontiguousarray(both[..., 3])
        rows, columns = self.camera.height, self.camera.width
        if (rows, columns) != self._size:
            colours = np.array(Image.fromarray(colours).resize((columns, rows), Image.Resampling.LANCZOS))
            mask = np.array(Image.fromarray(mask).resize((columns, rows), Image.Resampling.BILINEAR))
        return colours, mask

    def fault(self, mask: UInt8[np.ndarray, "h w"], frame: int) -> str:
        """Why a frame cannot be used; empty where it can. The same that a capture is refused for."""
        if not self._in_front[frame]:
            return "the body is behind the camera"
        person = mask >= _PERSON
        if not person.any():
            return "the mask is empty"
        if person.all():
            return "the mask is full"
        columns, rows = np.flatnonzero(person.any(0)), np.flatnonzero(person.any(1))
        low, high = np.array([columns[0], rows[0]]), np.array([columns[-1], rows[-1]])
        size = np.array([self.camera.width, self.camera.height])
        joints = self._joints[frame]
        inside = ((joints >= -0.5) & (joints <= size - 0.5)).all(-1)
        if not (inside & ((joints >= low) & (joints <= high)).all(-1)).any():
            return "mask and posed body do not meet"
        reach = float((joints.max(0) - joints.min(0)).max())
        if reach < _FAR_TOO_SMALL * float((high - low).max()):
            return "the body is far smaller than the mask"
        return ""


def agreement(
    camera: Camera,
    mask: UInt8[np.ndarray, "h w"],
    body: Body,
    betas: Float[Tensor, "S"],
    pose: Float[Tensor, "24 3"],
    translation: Float[Tensor, "3"],
) -> float:
    """Silhouette IoU of a mask and the posed body, 0..1."""
    surface = posed(body, betas, pose, translation)
    return overlap(silhouette(camera, surface.vertices, surface.faces), mask >= _PERSON)
