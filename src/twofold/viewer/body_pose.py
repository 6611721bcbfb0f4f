"""A pose that is edited: by a joint's angles, by a gizmo, from frames; and as a file."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from twofold.body.joint_limits import joint_limits
from twofold.body.motion import Motion, joint_frames
from twofold.body.skeleton import PARENTS, ShapedBody, canonical_pose
from twofold.capture.types import Frame
from twofold.files import made_folder, write_npz
from twofold.geometry.rotations import axis_angle_to_matrix, matrix_to_axis_angle

_FREE = math.pi
"""Range of a component of the root's rotation vector, and of joints without limits, radians."""


@dataclass(frozen=True)
class BodyPose:
    """A pose and place of the body.

    Attributes:
        pose: axis-angle rotations, root first, radians; of a training frame with the learned correction.
        translation: SMPL's own (the root turns about its rest joint, then this is added), metres.
        frame: the capture's frame that it is; None for all other poses.
        trained: whether that is a training frame, which has learned corrections and codes.
    """

    pose: Float[Tensor, "24 3"]
    translation: Float[Tensor, "3"]
    frame: Frame | None = None
    trained: bool = False

    def with_joint(self, joint: int, rotation: Float[Tensor, "3"]) -> "BodyPose":
        """The pose with another rotation vector of one joint (radians); it is no longer a frame's."""
        pose = self.pose.clone()
        pose[joint] = rotation
        return BodyPose(pose, self.translation)

    def moved(self, translation: Float[Tensor, "3"]) -> "BodyPose":
        """The pose at another place; it is no longer a frame's."""
        return BodyPose(self.pose, translation)

    def motion(self, name: str, fps: float = 30.0) -> Motion:
        """The pose as a motion of one frame."""
        return Motion(name, self.pose[None], self.translation[None], fps)


def joint_place(body: ShapedBody, posed: BodyPose, joint: int) -> tuple[Float[Tensor, "3 3"], Float[Tensor, "3"]]:
    """World rotation and position (metres) of a joint: where its gizmo stands."""
    rotations, positions = joint_frames(body.joints, posed.motion("pose"))
    return rotations[0, joint].float(), positions[0, joint].float()


def with_world_rotation(body: ShapedBody, posed: BodyPose, joint: int, rotation: Float[Tensor, "3 3"]) -> BodyPose:
    """The pose in which a joint has this world rotation, all other joints unchanged relative to their parents."""
    if PARENTS[joint] < 0:
        local = rotation
    else:
        parent, _ = joint_place(body, posed, PARENTS[joint])
        local = parent.T @ rotation
    return posed.with_joint(joint, matrix_to_axis_angle(local))


def with_pelvis_at(body: ShapedBody, posed: BodyPose, place: Float[Tensor, "3"]) -> BodyPose:
    """The pose moved until the pelvis is at `place`, metres."""
    return posed.moved(place - body.joints[0].to(place))


def canonical_like(posed: BodyPose, turn: Float[Tensor, "3 3"]) -> BodyPose:
    """The canonical pose, upright, with the pelvis where it is in `posed`.

    Args:
        posed: gives the place.
        turn: rotation from a world with y up to the one that is shown.
    """
    pose = canonical_pose().to(posed.pose)
    pose[0] = matrix_to_axis_angle(turn.to(pose))
    return BodyPose(pose, posed.translation)


def joint_ranges(joint: int, rotation: Float[Tensor, "3"]) -> tuple[tuple[float, float], ...]:
    """Least and largest component of a joint's rotation vector for sliders, radians.

    They are a person's limits, widened to whole multiples of 5 degrees that hold the present rotation.

    >>> [round(math.degrees(angle)) for angle in joint_ranges(4, torch.zeros(3))[0]]
    [-5, 150]
    """
    low, high = joint_limits()
    step = math.radians(5)
    ranges: list[tuple[float, float]] = []
    for axis in range(3):
        least, largest = float(low[joint, axis]), float(high[joint, axis])
        least = -_FREE if math.isinf(least) else least
        largest = _FREE if math.isinf(largest) else largest
        now = float(rotation[axis])
        least = min(least, math.floor(now / step + 1e-6) * step)
        largest = max(largest, math.ceil(now / step - 1e-6) * step)
        ranges.append((least, largest))
    return tuple(ranges)


def turned_motion(motion: Motion, turn: Float[Tensor, "3 3"], pelvis: Float[Tensor, "3"]) -> Motion:
    """The motion in another world: R' = A R and t' = A (j0 + t) - j0.

    Args:
        motion: in a world with y up.
        turn: rotation A to the world that is shown.
        pelvis: rest position j0 of the root joint, metres.
    """
    roots = matrix_to_axis_angle(turn @ axis_angle_to_matrix(motion.poses[:, 0]))
    poses = torch.cat([roots[:, None], motion.poses[:, 1:]], 1)
    return replace(motion, poses=poses, translations=(motion.translations + pelvis) @ turn.T - pelvis)


def save_poses(path: Path, poses: Sequence[BodyPose], fps: float, betas: Float[Tensor, "S"] | None = None) -> None:
    """Writes poses as an npz that `twofold render --motion`, `twofold motion` and the viewer read.

    The names of the arrays are those of a capture's motion.npz, so that readers take the body for the same one.

    Raises:
        TwofoldError: the place cannot be written to.
    """
    arrays = {
        "poses": torch.stack([p.pose for p in poses]).flatten(1).numpy(),
        "translations": torch.stack([p.translation for p in poses]).numpy(),
        "fps": np.array(float(fps)),
    }
    if betas is not None:
        arrays["betas"] = betas.numpy()
    with made_folder(path.parent):
        write_npz(path, arrays)
