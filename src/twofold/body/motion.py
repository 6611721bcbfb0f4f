"""A motion: the poses and places of a body over time, and what can be done to it whatever file it came from."""

import math
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from twofold.body.skeleton import PARENTS, joint_transforms
from twofold.errors import TwofoldError
from twofold.geometry.rotations import axis_angle_to_matrix, matrix_to_axis_angle

UP_AXES: dict[str, tuple[tuple[float, float, float], ...]] = {
    "y": ((1, 0, 0), (0, 1, 0), (0, 0, 1)),
    "z": ((1, 0, 0), (0, 0, 1), (0, -1, 0)),
    "-y": ((1, 0, 0), (0, -1, 0), (0, 0, -1)),
    "-z": ((1, 0, 0), (0, 0, -1), (0, 1, 0)),
    "x": ((0, -1, 0), (1, 0, 0), (0, 0, 1)),
    "-x": ((0, 1, 0), (-1, 0, 0), (0, 0, 1)),
}
"""For each axis that may point up in a file, the rotation to a world with y up. -y is a camera's world (OpenCV)."""


@dataclass(frozen=True)
class Motion:
    """A pose sequence.

    Attributes:
        name: for titles and files.
        poses: axis-angle rotations relative to SMPL's T-pose, root first, radians.
        translations: SMPL's own (the root turns about its rest joint, then this is added), metres.
        fps: frames per second.
        betas: shape coefficients of the person who moved, where the file gives them.
    """

    name: str
    poses: Float[Tensor, "T 24 3"]
    translations: Float[Tensor, "T 3"]
    fps: float
    betas: Float[Tensor, "S"] | None = None

    def __len__(self) -> int:
        return len(self.poses)

    @property
    def seconds(self) -> float:
        """From the first frame to the last."""
        return (len(self) - 1) / self.fps


def joint_frames(
    joints: Float[Tensor, "24 3"], motion: Motion
) -> tuple[Float[Tensor, "T 24 3 3"], Float[Tensor, "T 24 3"]]:
    """World rotation and position of every joint in every frame, in double precision: forward kinematics.

    Args:
        joints: of the T-pose, metres.
        motion: what moves them.
    """
    rest = joints.double()
    transforms = joint_transforms(rest, motion.poses.double(), motion.translations.double())
    positions = (transforms[..., :3, :3] @ rest[:, :, None])[..., 0] + transforms[..., :3, 3]
    return transforms[..., :3, :3], positions


def local_poses(rotations: Float[Tensor, "*b 24 3 3"]) -> Float[Tensor, "*b 24 3"]:
    """Axis-angle poses relative to the parents, from world rotations of all joints; the inverse of `joint_frames`."""
    above = rotations[..., list(PARENTS[1:]), :, :]
    local = torch.cat([rotations[..., :1, :, :], above.transpose(-1, -2) @ rotations[..., 1:, :, :]], -3)
    return matrix_to_axis_angle(local)


def as_single(motion: Motion) -> Motion:
    """The motion in single precision, which bodies and avatars use."""
    betas = None if motion.betas is None else motion.betas.float()
    return replace(motion, poses=motion.poses.float(), translations=motion.translations.float(), betas=betas)


def resampled(motion: Motion, fps: float) -> Motion:
    """The motion at another frame rate: rotations by spherical interpolation (slerp), translations linearly.

    The first frame stays; the last one stays where the new rate meets it.

    >>> still = Motion("still", torch.zeros(5, 24, 3), torch.arange(5.0)[:, None].expand(5, 3), 4.0)
    >>> resampled(still, 2.0).translations[:, 0].tolist()
    [0.0, 2.0, 4.0]

    Args:
        motion: at any rate.
        fps: wanted frames per second.

    Raises:
        TwofoldError: the rate is not positive.
    """
    if not (math.isfinite(fps) and fps > 0):
        raise TwofoldError(f"The frame rate should be a positive number of frames per second, it is {fps}.")
    if fps == motion.fps or len(motion) < 2:
        return replace(motion, fps=float(fps))
    count = math.floor(motion.seconds * fps + 1e-6) + 1
    at = (torch.arange(count, dtype=torch.float64) * (motion.fps / fps)).clamp_max(len(motion) - 1)
    return _between_frames(motion, at, fps)


def evenly_timed(motion: Motion, seconds: Float[np.ndarray, "T"]) -> Motion:
    """The motion at its mean rate, of frames that were taken at these times.

    >>> late = Motion("late", torch.zeros(3, 24, 3), torch.arange(3.0)[:, None].expand(3, 3), 1.0)
    >>> moved = evenly_timed(late, np.array([0.0, 1.0, 4.0]))
    >>> moved.fps, [round(place, 3) for place in moved.translations[:, 0].tolist()]
    (0.5, [0.0, 1.333, 2.0])

    Args:
        motion: its rate does not count.
        seconds: when each frame was taken, increasing.
    """
    if len(motion) < 2:
        return motion
    even = np.linspace(seconds[0], seconds[-1], len(seconds))
    at = torch.from_numpy(np.interp(even, seconds, np.arange(len(seconds))))
    return _between_frames(motion, at, (len(seconds) - 1) / float(seconds[-1] - seconds[0]))


def _between_frames(motion: Motion, at: Float[Tensor, "n"], fps: float) -> Motion:
    """The motion at fractional frames, which make a motion of this rate."""
    low = at.floor().long().clamp_max(len(motion) - 2)
    share = at - low
    first = axis_angle_to_matrix(motion.poses[low].double())
    second = axis_angle_to_matrix(motion.poses[low + 1].double())
    step = matrix_to_axis_angle(first.transpose(-1, -2) @ second)
    poses = matrix_to_axis_angle(first @ axis_angle_to_matrix(step * share[:, None, None]))
    before, after = (motion.translations[index].double() for index in (low, low + 1))
    moved = before + share[:, None] * (after - before)
    return replace(motion, poses=poses.to(motion.poses), translations=moved.to(motion.translations), fps=float(fps))


def started_at_origin(motion: Motion, joints: Float[Tensor, "24 3"]) -> Motion:
    """The motion shifted over the floor until the pelvis starts at x = 0, z = 0; its height stays.

    Args:
        motion: y up.
        joints: of the T-pose, metres.
    """
    shift = motion.translations[0] + joints[0].to(motion.translations)
    shift = shift * torch.tensor([1.0, 0.0, 1.0]).to(shift)
    return replace(motion, translations=motion.translations - shift)


def turned_upright(motion: Motion, up: str, pelvis: Float[Tensor, "3"]) -> Motion:
    """The motion in a world with y up: R' = A R and t' = A (j0 + t) - j0.

    Args:
        motion: in a world where `up` points up.
        up: a key of `UP_AXES`.
        pelvis: rest position j0 of the root joint, metres.
    """
    turn = torch.tensor(UP_AXES[up], dtype=torch.float64)
    roots = matrix_to_axis_angle(turn @ axis_angle_to_matrix(motion.poses[:, 0].double()))
    j0 = pelvis.double()
    moved = (motion.translations.double() + j0) @ turn.T - j0
    poses = torch.cat([roots.to(motion.poses)[:, None], motion.poses[:, 1:]], 1)
    return replace(motion, poses=poses, translations=moved.to(motion.translations))


def up_axis(ups: Float[Tensor, "T 3"]) -> str | None:
    """The axis that points up, from where each frame's trunk points; None where the trunk has no usual direction.

    >>> up_axis(torch.tensor([[0.0, 0.1, 1.0], [0.0, 0.0, 1.0]]))
    'z'
    """
    mean = torch.nn.functional.normalize(ups, dim=-1).mean(0)
    largest = int(mean.abs().argmax())
    if abs(float(mean[largest])) < 0.6:
        return None
    return ("" if mean[largest] > 0 else "-") + "xyz"[largest]


def leg_length(joints: Float[Tensor, "24 3"]) -> float:
    """Thigh and shin together, mean of both sides, metres."""
    thighs, shins = joints[[4, 5]] - joints[[1, 2]], joints[[7, 8]] - joints[[4, 5]]
    return float((thighs.norm(dim=-1) + shins.norm(dim=-1)).mean())
