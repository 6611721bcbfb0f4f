"""A camera path: key views, a smooth path through them, its file, its video."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from scipy.interpolate import CubicSpline

from twofold.errors import TwofoldError
from twofold.files import made_folder, write_json
from twofold.geometry.cameras import Camera
from twofold.outputs.views import look_at


@dataclass(frozen=True)
class KeyView:
    """A view that a path goes through.

    Attributes:
        eye: position, metres.
        target: what is looked at, metres.
        up: direction.
        fov: vertical field of view, radians.
    """

    eye: Float[np.ndarray, "3"]
    target: Float[np.ndarray, "3"]
    up: Float[np.ndarray, "3"]
    fov: float


def path_cameras(keys: Sequence[KeyView], frames: int, height: int, width: int) -> list[Camera]:
    """Cameras along a smooth path: a cubic spline through the key views, evenly spaced in the keys' order.

    Raises:
        TwofoldError: there are fewer than two key views.
    """
    if len(keys) < 2:
        raise TwofoldError(f"A camera path needs two key views or more, there are {len(keys)}; add some.")
    rows = np.stack([np.concatenate([key.eye, key.target, key.up, [key.fov]]) for key in keys])
    times = np.linspace(0, len(keys) - 1, frames)
    path = CubicSpline(np.arange(len(keys)), rows)(times) if len(keys) > 2 else _straight(rows, times)
    return [_camera(row, height, width) for row in path]


def _straight(rows: np.ndarray, times: np.ndarray) -> np.ndarray:
    return rows[0] + times[:, None] * (rows[1] - rows[0])


def _camera(row: np.ndarray, height: int, width: int) -> Camera:
    numbers = torch.from_numpy(row).float()
    eye, target, up = numbers[:3], numbers[3:6], numbers[6:9]
    focal = 0.5 * height / float(np.tan(0.5 * row[9]))
    intrinsics = torch.tensor([[focal, 0, (width - 1) / 2], [0, focal, (height - 1) / 2], [0, 0, 1]]).float()
    return Camera(look_at(eye, target, up), intrinsics, height, width)


def save_path(path: Path, cameras: Sequence[Camera], fps: float) -> None:
    """Writes cameras as JSON: of each frame world_to_camera (4 x 4, metres) and intrinsics (3 x 3, pixels).

    Axes are OpenCV's.

    Raises:
        TwofoldError: the place cannot be written to.
    """
    first = cameras[0]
    frames = [
        {"world_to_camera": camera.world_to_camera.tolist(), "intrinsics": camera.intrinsics.tolist()}
        for camera in cameras
    ]
    with made_folder(path.parent):
        write_json(path, {"fps": fps, "height": first.height, "width": first.width, "frames": frames})
