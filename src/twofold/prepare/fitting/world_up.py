"""A world that stands upright, with the person above its middle."""

from collections.abc import Mapping

import torch
from jaxtyping import Float
from torch import Tensor

from twofold.geometry.cameras import Camera
from twofold.geometry.rotations import axis_angle_to_matrix
from twofold.geometry.upright import turn_world
from twofold.prepare.fitting.initialization import shortest_turns

_CLOSE_TO_AXIS = 20.0
"""Degrees: along an axis of a calibrated world closer to an average body than this, the world's up points."""


def up_direction(poses: Float[Tensor, "t 24 3"], calibrated: bool) -> Float[Tensor, "3"]:
    """Which way is up: the way people stand on average, or the axis of a calibrated world next to it.

    Args:
        poses: root first, axis-angle, radians.
        calibrated: the world's axes mean something.
    """
    mean = axis_angle_to_matrix(poses[:, 0])[:, :, 1].mean(0)
    mean = mean / mean.norm().clamp_min(1e-9)
    axis = torch.zeros_like(mean)
    largest = int(mean.abs().argmax())
    axis[largest] = mean[largest].sign()
    if calibrated and float(torch.rad2deg(torch.arccos((mean @ axis).clamp(-1, 1)))) < _CLOSE_TO_AXIS:
        return axis
    return mean


def stand_upright(
    up: Float[Tensor, "3"],
    root: Float[Tensor, "3"],
    lowest: float,
    poses: Float[Tensor, "t 24 3"],
    translations: Float[Tensor, "t 3"],
    cameras: Mapping[str, Camera],
) -> tuple[Float[Tensor, "t 24 3"], Float[Tensor, "t 3"], dict[str, Camera]]:
    """Motion and cameras in a world with y up, its floor at 0, the person around x = z = 0; no image changes.

    Args:
        up: unit vector of the world as it is.
        root: rest position of the root joint, about which the body turns, metres.
        lowest: the smallest coordinate along `up` that the body reaches, metres.
        poses: axis-angle, radians.
        translations: metres.
        cameras: by name.
    """
    start, over = up.double(), torch.eye(3, dtype=torch.float64)
    if float(start[1]) < 0:
        # Cameras have y down: half a turn first, so that the rest is never close to another half.
        over = torch.diag(torch.tensor([1.0, -1.0, -1.0], dtype=torch.float64))
    turn = shortest_turns((over @ start)[None], torch.tensor([[0.0, 1.0, 0.0]], dtype=torch.float64))[0] @ over
    moved: dict[str, Camera] = {}
    turned, shifted = poses.double(), translations.double()
    for name, camera in cameras.items():
        turned, shifted, view = turn_world(
            turn, root.double(), poses.double(), translations.double(), camera.world_to_camera.double()
        )
        moved[name] = Camera(view, camera.intrinsics, camera.height, camera.width)
    middle = (shifted + root.double()).mean(0)
    middle[1] = lowest
    for name, camera in moved.items():
        view = camera.world_to_camera.clone()
        view[:3, 3] = view[:3, 3] + view[:3, :3] @ middle
        moved[name] = Camera(view.float(), camera.intrinsics, camera.height, camera.width)
    return turned.float(), (shifted - middle).float(), moved
