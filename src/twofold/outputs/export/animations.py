"""Motions of a character: from training frames or from any poses, upright and on the ground."""

from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from twofold.body.motion import Motion
from twofold.capture.types import Capture, spread
from twofold.geometry.rotations import axis_angle_to_matrix, matrix_to_axis_angle
from twofold.outputs.export.bake import Pose
from twofold.outputs.export.character import Animation, Character, pose_character
from twofold.outputs.export.make import Baked, training_poses

WEIGHED = 60
"""Frames of a motion for which the morph targets' weights are worked out; those between are interpolated."""


def capture_clip(baked: Baked, name: str = "capture", weighed: int = WEIGHED) -> Animation:
    """The training motion in the capture's world, with the learned corrections of its poses; see `motion_clip`."""
    taken = baked.capture.seconds_of(sorted({frame.frame_index for frame in baked.capture.train}))
    return _clip(baked, name, training_poses(baked.capture), taken - taken[0], weighed)


def motion_clip(baked: Baked, motion: Motion, weighed: int = WEIGHED) -> Animation:
    """Any motion of the body as a clip, with the weights that the field gives the morph targets in its poses.

    Args:
        baked: from `bake`.
        motion: y up.
        weighed: frames for which these weights are worked out; those between are interpolated.
    """
    poses, translations = motion.poses.float(), motion.translations.float()
    frames = [Pose(pose, place, None) for pose, place in zip(poses, translations, strict=True)]
    return _clip(baked, motion.name, frames, np.arange(len(frames)) / motion.fps, weighed)


@torch.no_grad()
def _clip(baked: Baked, name: str, frames: Sequence[Pose], times: np.ndarray, weighed: int = WEIGHED) -> Animation:
    shape, avatar = baked.shape, baked.avatar
    fitted = {frame.frame_index: row for row, frame in enumerate(shape.frames) if frame.frame_index is not None}
    row_of = [None if frame.frame_index is None else fitted.get(frame.frame_index) for frame in frames]
    asked = set(spread([index for index, row in enumerate(row_of) if row is None], weighed)) if weighed else set[int]()
    corrected = bool(avatar.pose_corrections())
    poses, places = [], []
    weights: dict[int, np.ndarray] = {}
    for index, frame in enumerate(frames):
        row = row_of[index]
        if row is not None:
            weights[index] = shape.weights[row].cpu().numpy()
        if index not in asked and (frame.frame_index is None or not corrected):
            poses.append(frame.pose.cpu().numpy())  # nothing corrects it, and nothing is to be asked there
            places.append(frame.translation.cpu().numpy())
            continue
        posed = frame.of(avatar)
        poses.append(posed.body.pose.cpu().numpy())
        places.append((posed.body.joints[0] - shape.skin.rest.joints[0]).cpu().numpy())
        if index in asked:
            weights[index] = shape.weights_at(avatar, posed, baked.config.branch).cpu().numpy()
    given = sorted(weights)
    table = np.stack([weights[index] for index in given])
    between = [np.interp(times, times[given], table[:, target]) for target in range(table.shape[1])]
    shown = np.stack(between, 1).astype(np.float32) if between else None
    return Animation(name, times.astype(np.float32), np.stack(poses), np.stack(places), shown)


def upright(capture: Capture) -> Float[Tensor, "3 3"]:
    """The rotation that turns the capture's axis of the world that points up to +y.

    Up is the axis nearest to the mean upright of the training cameras.
    """
    up = torch.stack([-frame.camera.world_to_camera[1, :3] for frame in capture.train]).mean(0)
    axis = int(up.abs().argmax())
    start, target = torch.zeros(3), torch.tensor([0.0, 1.0, 0.0])
    start[axis] = up[axis].sign()
    if axis == 1:
        return torch.eye(3) if start[1] > 0 else torch.diag(torch.tensor([1.0, -1.0, -1.0]))
    return axis_angle_to_matrix(torch.linalg.cross(start, target) * (torch.pi / 2))


def turned(clip: Animation, rotation: Float[Tensor, "3 3"], pelvis: Float[np.ndarray, "3"]) -> Animation:
    """The clip in a world turned by `rotation`; `pelvis` is the root's place in the rest pose."""
    root = axis_angle_to_matrix(torch.from_numpy(clip.poses[:, 0]).float())
    poses = clip.poses.copy()
    poses[:, 0] = matrix_to_axis_angle(rotation @ root).numpy()
    places = (clip.translations + pelvis) @ rotation.numpy().T - pelvis
    return Animation(clip.name, clip.times, poses, places.astype(clip.translations.dtype), clip.weights)


def grounded(clip: Animation, character: Character) -> Animation:
    """The clip moved so that it starts above the origin and its lowest point is at y = 0."""
    frames = spread(range(len(clip.times)), 24)
    lowest = min(pose_character(character, clip.poses[t], clip.translations[t])[:, 1].min() for t in frames)
    start = clip.translations[0] + character.joints[0]
    moved = clip.translations - np.array([start[0], lowest, start[2]], dtype=clip.translations.dtype)
    return Animation(clip.name, clip.times, clip.poses, moved, clip.weights)
