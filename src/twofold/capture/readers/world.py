"""A data set's world turned so that y points up, its floor at 0 and the person around its middle."""

from collections.abc import Mapping

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from twofold.body.skeleton import Body, PosedBody, joint_transforms, pose_body, shape_body
from twofold.capture.readers.sequence import SourceCamera
from twofold.capture.types import spread
from twofold.geometry.rotations import shortest_turn
from twofold.geometry.upright import turn_world

_PELVIS, _NECK = 0, 12
_CLOSE_TO_AXIS = 25.0
"""Degrees between a recording's vertical axis and the way in which people stand on average."""
_SOME = 40
"""Frames in which the floor is looked for."""


def posed(
    body: Body, betas: Float[Tensor, "S"], pose: Float[Tensor, "24 3"], translation: Float[Tensor, "3"]
) -> PosedBody:
    """The body in a frame, in single precision."""
    return pose_body(shape_body(body, betas.float()), pose.float(), translation.float())


def posed_joints(
    body: Body, betas: Float[Tensor, "S"], poses: Float[Tensor, "t 24 3"], translations: Float[Tensor, "t 3"]
) -> Float[Tensor, "t 24 3"]:
    """Joints in the world, metres, in double precision."""
    rest = body.joints.double() + body.joint_basis.double()[..., : len(betas)] @ betas.double()
    transforms = joint_transforms(rest, poses.double(), translations.double())
    return (transforms[..., :3, :3] @ rest[:, :, None])[..., 0] + transforms[..., :3, 3]


def up_of(joints: Float[Tensor, "t 24 3"], gravity: bool) -> Float[Tensor, "3"]:
    """Which way is up: from pelvis to neck on average; the axis next to it where the world has a vertical one."""
    mean = (joints[:, _NECK] - joints[:, _PELVIS]).mean(0)
    mean = mean / mean.norm().clamp_min(1e-9)
    axis = torch.zeros_like(mean)
    largest = int(mean.abs().argmax())
    axis[largest] = mean[largest].sign()
    near = float(torch.rad2deg(torch.arccos((mean @ axis).clamp(-1, 1)))) < _CLOSE_TO_AXIS
    return axis if gravity and near else mean


def upright(
    body: Body,
    betas: Float[Tensor, "S"],
    poses: Float[Tensor, "t 24 3"],
    translations: Float[Tensor, "t 3"],
    cameras: Mapping[str, SourceCamera],
    gravity: bool,
) -> tuple[Float[Tensor, "t 24 3"], Float[Tensor, "t 3"], dict[str, SourceCamera]]:
    """Motion and cameras in a world with y up; no image changes."""
    up = up_of(posed_joints(body, betas, poses, translations), gravity)
    over = torch.eye(3, dtype=torch.float64)
    if float(up[1]) < 0:
        over = torch.diag(torch.tensor([1.0, -1.0, -1.0], dtype=torch.float64))  # so that the rest is no half turn
    turn = shortest_turn(over @ up, torch.tensor([0.0, 1.0, 0.0], dtype=torch.float64)) @ over
    root = body.joints[0].double() + body.joint_basis[0].double()[:, : len(betas)] @ betas.double()
    some = spread(range(len(poses)), _SOME)
    views = {name: torch.from_numpy(camera.world_to_camera) for name, camera in cameras.items()}
    turned, moved = poses, translations
    for name, view in views.items():
        turned, moved, views[name] = turn_world(turn, root, poses, translations, view)
    lows = [float(posed(body, betas, turned[t], moved[t]).vertices[:, 1].min()) for t in some]
    middle = (moved + root).mean(0)
    middle[1] = float(np.quantile(lows, 0.1))
    found: dict[str, SourceCamera] = {}
    for name, view in views.items():
        shifted = view.clone()
        shifted[:3, 3] = view[:3, 3] + view[:3, :3] @ middle
        found[name] = SourceCamera(cameras[name].intrinsics, cameras[name].distortion, shifted.numpy())
    return turned, moved - middle, found
