"""What can be scrubbed: the frames of a capture's splits, and motions."""

from bisect import bisect_right
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from statistics import median

import torch
from jaxtyping import Float
from torch import Tensor

from twofold.body.motion import Motion
from twofold.body.skeleton import ShapedBody
from twofold.capture.types import Capture, Frame
from twofold.evaluation import NEAR
from twofold.methods.base import Avatar
from twofold.viewer.body_pose import BodyPose, turned_motion


@dataclass(frozen=True)
class Timeline:
    """A pose sequence.

    Attributes:
        name: for the list of motions.
        poses: at least one.
        fps: frames per second.
        labels: a frame's name each; empty for those that are counted from 0.
        seconds: when each frame begins, from 0; empty for frames that follow each other at `fps`.
    """

    name: str
    poses: tuple[BodyPose, ...]
    fps: float
    labels: tuple[str, ...] = ()
    seconds: tuple[float, ...] = ()

    def __len__(self) -> int:
        return len(self.poses)

    def at(self, seconds: float) -> int:
        """The frame that is shown this long after the first one, over and over again."""
        if not self.seconds:
            return int(seconds * self.fps) % len(self.poses)
        return bisect_right(self.seconds, seconds % self._length) - 1

    @cached_property
    def _length(self) -> float:
        """Seconds until the first frame comes again; the last one stays as long as frames usually do."""
        return self.seconds[-1] + (median(b - a for a, b in pairwise(self.seconds)) if len(self) > 1 else 1.0)

    def begins(self, frame: int) -> float:
        """Seconds from the first frame to this one."""
        return self.seconds[frame] if self.seconds else frame / self.fps


def split_timelines(capture: Capture, avatar: Avatar | None) -> list[Timeline]:
    """The frames of every split in the order of time, each once, with what training learned about their poses."""
    trained = {frame.frame_index for frame in capture.train}
    found: list[Timeline] = []
    for split, frames in capture.splits.items():
        by_index = {frame.frame_index: frame for frame in reversed(frames)}
        if by_index:
            ordered = [by_index[index] for index in sorted(by_index)]
            poses = tuple(frame_pose(f, capture, avatar, f.frame_index in trained) for f in ordered)
            labels = tuple(str(frame.frame_index) for frame in ordered)
            taken = capture.seconds_of(sorted(by_index))
            seconds = tuple((taken - taken[0]).tolist())
            found.append(Timeline(f"capture: {split}", poses, capture.fps, labels, seconds))
    return found


@torch.no_grad()
def frame_pose(frame: Frame, capture: Capture, avatar: Avatar | None, trained: bool) -> BodyPose:
    """A frame's pose, corrected as evaluation corrects it."""
    pose, translation = frame.pose, frame.translation
    if avatar is not None:
        pose, translation = avatar.refined_pose(frame.frame_index, pose, translation, NEAR, capture.second)
    return BodyPose(pose.detach().cpu(), translation.detach().cpu(), frame, trained)


def motion_timeline(
    motion: Motion, body: ShapedBody, turn: Float[Tensor, "3 3"], pelvis: Float[Tensor, "3"]
) -> Timeline:
    """A motion in the world that is shown, begun with the pelvis at a place.

    Args:
        motion: in a world with y up.
        body: who moves, in the T-pose.
        turn: rotation to the world that is shown.
        pelvis: where the motion begins, metres.
    """
    moved = turned_motion(motion, turn, body.joints[0])
    start = moved.translations[0] + body.joints[0]
    places = moved.translations - start + pelvis
    poses = tuple(BodyPose(pose, place) for pose, place in zip(moved.poses, places, strict=True))
    return Timeline(motion.name, poses, motion.fps)
