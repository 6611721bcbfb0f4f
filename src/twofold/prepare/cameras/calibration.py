"""Cameras that were calibrated before: matched to clips, brought to their image size, freed of lens distortion.

Pixels are counted as everywhere here: column i and row j of an image is the point (i, j).
"""

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8

from twofold.errors import TwofoldError
from twofold.geometry.cameras import Camera
from twofold.geometry.lens import distorted_pixels, image_undistorter, undistorted_pixels

_CROPPED = 16
"""Video coders pad images to multiples of 16 pixels, and players cut that off again, right and below."""

_SAME_SIZE = 1.15
"""A principal point that is off the middle of the image by less than this factor is that of its lens."""


@dataclass(frozen=True)
class CalibratedCamera:
    """One calibrated camera that does not move (OpenCV: x right, y down, z forward).

    Attributes:
        name: as the calibration calls it.
        intrinsics: [fx s cx; 0 fy cy; 0 0 1], pixels.
        distortion: OpenCV's k1, k2, p1, p2, k3.
        world_to_camera: rigid, metres; which way is up in the world is not known.
        height: rows of the images it was calibrated for; None where the calibration does not say.
        width: columns of them.
    """

    name: str
    intrinsics: Float[np.ndarray, "3 3"]
    distortion: Float[np.ndarray, "5"]
    world_to_camera: Float[np.ndarray, "4 4"]
    height: int | None
    width: int | None

    @property
    def center(self) -> Float[np.ndarray, "3"]:
        """Its position in the world, metres."""
        return -self.world_to_camera[:3, :3].T @ self.world_to_camera[:3, 3]

    def without_distortion(self) -> "CalibratedCamera":
        """The camera that took the undistorted images."""
        return replace(self, distortion=np.zeros(5))


def pinhole(camera: CalibratedCamera, height: int, width: int) -> Camera:
    """The camera of undistorted images of this size, as captures have it."""
    matrices = [torch.as_tensor(m.astype(np.float32)) for m in (camera.world_to_camera, camera.intrinsics)]
    return Camera(matrices[0], matrices[1], height, width)


def match_cameras(cameras: Mapping[str, CalibratedCamera], clips: Sequence[str]) -> list[CalibratedCamera]:
    """The camera of each clip: by name, else in order.

    A name fits if it is the same, the same but for case and separators ("CAM_1" and "cam01"), part of the other
    ("cam01" and "walk_cam01_left"), or ends in the same number ("1" and "video-01"). Only where no clip's name says
    anything are as many clips as cameras taken in order.

    Args:
        cameras: by name, in the calibration's order.
        clips: names of the clips, without folder and ending.

    Raises:
        TwofoldError: neither works.
    """
    if len(set(clips)) < len(clips):
        raise TwofoldError(f"Two videos are called {_twice(clips)}; rename one after its camera ({_list(cameras)}).")
    names, some = list(cameras), False
    for fits in (_same, _same_words, _part_of, _same_number):
        candidates = [[name for name in names if fits(clip, name)] for clip in clips]
        chosen = [found[0] for found in candidates if len(found) == 1]
        if len(set(chosen)) == len(clips):
            return [cameras[name] for name in chosen]
        some = some or (fits is not _same_number and any(candidates))
    if len(clips) == len(cameras) and not some:
        return list(cameras.values())
    raise TwofoldError(
        f"The videos ({_list(clips)}) cannot be told apart by the cameras of the calibration ({_list(cameras)}); "
        "rename each video after its camera, or give exactly one for each camera in the calibration's order."
    )


def for_pictures(camera: CalibratedCamera, image: UInt8[np.ndarray, "h w 3"]) -> CalibratedCamera:
    """The camera of a clip whose images were cut or resized after the calibration.

    In this order: the same size; the same shape, so scaled; scaled with black bars on both sides, which must be seen
    in `image`; a few columns or rows less or more, so cut or padded on the right or below, as video coders do; scaled
    and one side rounded to a multiple of 8 or 16, as video coders do too, so that both sides have their own scale.
    Where the calibration does not say its size, the principal point must be near the middle of the image.

    Args:
        camera: as calibrated.
        image: any one of the clip as decoded (8-bit sRGB), upright.

    Raises:
        TwofoldError: the sizes do not go together.
    """
    height, width = image.shape[:2]
    if camera.height is None or camera.width is None:
        cx, cy = camera.intrinsics[:2, 2].tolist()
        meant = size_of_principal_point(cx, cy, height, width)
        if meant is not None:
            raise TwofoldError(
                f"Camera {camera.name} gives no image size; its principal point ({cx:.0f}, {cy:.0f}) is the middle of "
                f"images of about {meant[1]}x{meant[0]}, and the video has {width}x{height}. Give the video in the "
                "size it was calibrated in, or add the size to the calibration."
            )
        return replace(camera, height=height, width=width)
    if (height, width) == (camera.height, camera.width):
        return camera
    across, down = width / camera.width, height / camera.height
    if min(abs(camera.height * across - height), abs(camera.width * down - width)) <= 1:
        return _resized(camera, height, width, (across, down), (0.0, 0.0))
    scale = min(across, down)
    left, top = (width - scale * camera.width) / 2, (height - scale * camera.height) / 2
    if _has_bars(image, round(top), round(left)):
        return _resized(camera, height, width, (scale, scale), (left, top))
    if max(abs(width - camera.width), abs(height - camera.height)) <= min(_CROPPED, 0.02 * max(height, width)):
        return replace(camera, height=height, width=width)
    if _rounded(camera, height, width, across, down):
        return _resized(camera, height, width, (across, down), (0.0, 0.0))
    turned = abs(across * camera.width / camera.height - down * camera.height / camera.width) < 0.02
    raise TwofoldError(
        f"Camera {camera.name} was calibrated for {camera.width}x{camera.height} images, its video has "
        f"{width}x{height}; "
        + ("turn the video upright as it was calibrated." if turned else "give the video as it was calibrated.")
    )


def size_of_principal_point(cx: float, cy: float, height: int, width: int) -> tuple[int, int] | None:
    """The size (height, width) of images whose middle the principal point is; None if that is about the size given.

    Lenses have it within a few percent of the middle, and images that were scaled differ by far more.

    >>> size_of_principal_point(639.5, 359.5, 720, 1280)
    >>> size_of_principal_point(639.5, 359.5, 360, 640)
    (720, 1280)
    """
    meant = 2 * cy + 1, 2 * cx + 1
    ratios = meant[0] / height, meant[1] / width
    if all(1 / _SAME_SIZE <= ratio <= _SAME_SIZE for ratio in ratios):
        return None
    return round(meant[0]), round(meant[1])


def _rounded(camera: CalibratedCamera, height: int, width: int, across: float, down: float) -> bool:
    """Whether one side is what the other's scale asks for, rounded to a multiple of 8 or 16."""
    if camera.height is None or camera.width is None:
        return False
    for side, exact in ((height, camera.height * across), (width, camera.width * down)):
        step = 16 if side % 16 == 0 else 8
        if side % 8 == 0 and abs(side - exact) < step and abs(side - exact) <= 0.05 * side:
            return True
    return False


def distort(camera: CalibratedCamera, pixels: Float[np.ndarray, "*b 2"]) -> Float[np.ndarray, "*b 2"]:
    """Where the lens shows what a perfect one would show at `pixels` (column, row)."""
    return distorted_pixels(camera.intrinsics, camera.distortion, pixels)


def undistort(camera: CalibratedCamera, pixels: Float[np.ndarray, "*b 2"]) -> Float[np.ndarray, "*b 2"]:
    """Where a perfect lens would show what this one shows at `pixels`: the inverse of `distort`, to 0.001 pixels."""
    return undistorted_pixels(camera.intrinsics, camera.distortion, pixels)


def undistorter(
    camera: CalibratedCamera, height: int, width: int
) -> Callable[[UInt8[np.ndarray, "h w c"]], UInt8[np.ndarray, "h w c"]]:
    """Turns images of this camera into what a perfect lens would have shown, of the same size.

    What no pixel showed repeats the nearest one. The images belong to `camera.without_distortion()`.
    """
    return image_undistorter(camera.intrinsics, camera.distortion, height, width)


def _resized(
    camera: CalibratedCamera, height: int, width: int, scale: tuple[float, float], corner: tuple[float, float]
) -> CalibratedCamera:
    """Images scaled and laid down with their left upper corner at `corner` (column, row) of larger ones."""
    intrinsics = camera.intrinsics.copy()
    intrinsics[:2] *= np.array(scale)[:, None]
    # The image's edge lies half a pixel outside of its first pixel.
    intrinsics[:2, 2] += np.array(corner) + 0.5 * (np.array(scale) - 1)
    return replace(camera, intrinsics=intrinsics, height=height, width=width)


def _has_bars(image: UInt8[np.ndarray, "h w 3"], top: int, left: int) -> bool:
    """Whether both sides are black for `top` rows or `left` columns (the other is 0), but not for much more."""
    if top < 2 and left < 2:
        return False
    lines = image if top >= 2 else image.swapaxes(0, 1)
    bar = max(top, left)
    dark: Bool[np.ndarray, "n"] = np.percentile(lines.reshape(len(lines), -1), 90, axis=1) < 24
    outer = np.concatenate([dark[: bar - 1], dark[len(dark) - bar + 1 :]])
    inner = np.concatenate([dark[bar + 2 : bar + 10], dark[len(dark) - bar - 10 : len(dark) - bar - 2]])
    return bool(outer.all() and not inner.all())


def _words(name: str) -> list[str]:
    """Letters and numbers of a name, apart, without leading zeros.

    >>> _words("CAM_01b")
    ['cam', '1', 'b']
    """
    return [word.lstrip("0") or word[-1:] for word in re.findall(r"[a-z]+|\d+", name.casefold())]


def _same(clip: str, camera: str) -> bool:
    return clip == camera


def _same_words(clip: str, camera: str) -> bool:
    return bool(_words(clip)) and _words(clip) == _words(camera)


def _part_of(clip: str, camera: str) -> bool:
    longer, shorter = sorted((_words(clip), _words(camera)), key=len, reverse=True)
    if not any(word.isalpha() for word in shorter):  # a bare number is in far too many names
        return False
    return any(longer[i : i + len(shorter)] == shorter for i in range(len(longer)))


def _same_number(clip: str, camera: str) -> bool:
    numbers = [[word for word in _words(name) if word.isdecimal()][-1:] for name in (clip, camera)]
    return bool(numbers[0]) and numbers[0] == numbers[1]


def _twice(names: Sequence[str]) -> str:
    return next(name for name in names if names.count(name) > 1)


def _list(names: Sequence[str] | Mapping[str, object]) -> str:
    return ", ".join(names)
