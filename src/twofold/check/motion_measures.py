"""What a capture's motion shows without its images: jumps, how far limbs move, from which sides the body is seen."""

import itertools
import math
from collections.abc import Sequence, Set
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float
from scipy import ndimage
from torch import Tensor

from twofold.body.skeleton import JOINT_NAMES, joint_transforms
from twofold.capture.types import Frame, spread
from twofold.geometry.accelerations import limited_gaps
from twofold.geometry.rotations import axis_angle_to_matrix
from twofold.prepare.turning import arc, camera_directions, sides_seen

SLACK, ACCELERATION = 0.12, 40.0
"""A joint may deviate from the middle between its neighbours in time by an estimator's error, metres, and by what four
times gravity does to it, m/s2: more than hands do in quick sports."""
TURN_SPEED = 12.0
"""Faster the trunk turns in no ordinary motion, rad/s: two turns a second is a figure skater's spin."""
NOVEL_BLOCK = 3
"""This many novel poses in a row may be a motion of their own, with a cut before and after."""
NEW_POSE = math.radians(30)
"""Poses count as different where a joint is turned by so much more."""
STILL = 15.0
"""A limb that turns by less, degrees, has not shown how it bends."""
LIMBS = (
    ("left shoulder", "left_shoulder"), ("right shoulder", "right_shoulder"), ("left elbow", "left_elbow"),
    ("right elbow", "right_elbow"), ("left hip", "left_hip"), ("right hip", "right_hip"), ("left knee", "left_knee"),
    ("right knee", "right_knee"), ("head", "neck"), ("back", "spine2"),
)  # fmt: skip


@dataclass(frozen=True)
class MotionFacts:
    """What the motion shows.

    Attributes:
        frames: that any split shows.
        jumps: frames that no person could get to from the one before and after.
        jitter: how far joints deviate from the middle between their neighbours, median, metres.
        ranges: for each limb of `LIMBS` how far its joint turns between any two training frames, degrees.
        poses: training frames whose poses differ from each other.
        azimuths: of the training cameras around the body, degrees; 0 in front, 90 at the person's left.
        elevations: of these cameras above the body's own horizon, degrees.
        turned: the arc that these azimuths span, degrees.
        seen: degrees of the 360 around the body that a training camera sees well.
        unseen: the side in the middle of what is not, in words; empty where all is seen.
        novelty: how far the poses of `novel_pose` are from the nearest training pose, median over frames of the largest
            turn of a joint, degrees; None where there are none.
        up: the body's own up against the world's y axis, mean cosine.
    """

    frames: tuple[int, ...]
    jumps: tuple[int, ...]
    jitter: float
    ranges: tuple[float, ...]
    poses: int
    azimuths: tuple[float, ...]
    elevations: tuple[float, ...]
    turned: float
    seen: float
    unseen: str
    novelty: float | None
    up: float


def motion_facts(
    poses: Float[Tensor, "T 24 3"],
    translations: Float[Tensor, "T 3"],
    joints: Float[Tensor, "24 3"],
    splits: dict[str, tuple[Frame, ...]],
    seconds: Float[np.ndarray, "T"],
) -> MotionFacts:
    """Measures a motion.

    Args:
        poses: of every frame.
        translations: of every frame, metres.
        joints: of this person in the T-pose.
        splits: the capture's.
        seconds: when each frame was taken.
    """
    times = sorted({frame.frame_index for frames in splits.values() for frame in frames})
    train = splits["train"]
    train_times = sorted({frame.frame_index for frame in train})
    rotations = axis_angle_to_matrix(poses)
    transforms = joint_transforms(joints, poses, translations)
    placed = (transforms[..., :3, :3] @ joints[:, :, None])[..., 0] + transforms[..., :3, 3]
    inside = (placed - placed[:, :1]) @ rotations[:, 0]
    moving = torch.cat([placed[:, :1], inside[:, 1:]], 1)
    jumps: list[int] = []
    deviations: list[np.ndarray] = []
    for run in _runs(times, {frame.frame_index for frame in splits.get("novel_pose", ())}):
        bad, deviation = _jumps(moving[run], rotations[run, 0], seconds[run])
        jumps += [time for time, yes in zip(run, bad.tolist(), strict=True) if yes]
        deviations.append(deviation)
    azimuths, elevations = _directions(train, rotations[:, 0], placed[:, 0])
    novel = sorted({frame.frame_index for frame in splits.get("novel_pose", ())})
    few = torch.tensor(spread(train_times, 150))
    apart = _apart(rotations[few], rotations[novel]).amax(-1).amin(0) if novel else torch.empty(0)
    upward = torch.nn.functional.normalize(placed[:, 12] - placed[:, 0], dim=-1)[times, 1]
    sides = sides_seen(np.radians(azimuths))
    return MotionFacts(
        frames=tuple(times),
        jumps=tuple(jumps),
        jitter=float(np.median(np.concatenate(deviations))) if any(map(len, deviations)) else 0.0,
        ranges=_ranges(rotations[few]),
        poses=_different(rotations[few]),
        azimuths=tuple(azimuths),
        elevations=tuple(elevations),
        turned=arc(azimuths),
        seen=float(sides.mean() * 360),
        unseen=_unseen(sides),
        novelty=math.degrees(float(apart.median())) if novel else None,
        up=float(upward.mean()),
    )


def _unseen(seen: Bool[np.ndarray, "360"]) -> str:
    if seen.all() or not seen.any():
        return ""
    # Around the circle twice, so that a gap across the front is one gap.
    runs: list[list[int]] = []
    for degree in np.flatnonzero(~np.concatenate([seen, seen])).tolist():
        if runs and degree == runs[-1][-1] + 1:
            runs[-1].append(degree)
        else:
            runs.append([degree])
    widest = max(runs, key=len)
    names = ("front", "front left", "left side", "back left", "back", "back right", "right side", "front right")
    return names[round((widest[0] + widest[-1]) / 2 / 45) % 8]


def _directions(
    frames: Sequence[Frame], roots: Float[Tensor, "T 3 3"], pelvises: Float[Tensor, "T 3"]
) -> tuple[list[float], list[float]]:
    """Where the camera of each frame stands as the body sees it: degrees around and above."""
    if not frames:
        return [], []
    times = [frame.frame_index for frame in frames]
    return camera_directions(roots[times], pelvises[times], torch.stack([frame.camera.center for frame in frames]))


def _runs(times: Sequence[int], novel: Set[int]) -> list[list[int]]:
    """Frames in stretches of one motion: a block of novel poses may be another motion, single ones in between not.

    >>> _runs([0, 1, 2, 3, 4, 5, 6, 7, 8, 9], {1, 6, 7, 8, 9})
    [[0, 1, 2, 3, 4, 5], [6, 7, 8, 9]]
    """
    runs = [list(group) for _, group in itertools.groupby(times, lambda time: time in novel)]
    joined: list[list[int]] = []
    for run in runs:
        block = len(run) >= NOVEL_BLOCK and run[0] in novel
        after_block = bool(joined) and len(joined[-1]) >= NOVEL_BLOCK and set(joined[-1]) <= novel
        if joined and not block and not after_block:
            joined[-1] += run
        else:
            joined.append(run)
    return joined


def _jumps(
    joints: Float[Tensor, "t 24 3"], roots: Float[Tensor, "t 3 3"], seconds: Float[np.ndarray, "t"]
) -> tuple[Bool[np.ndarray, "t"], Float[np.ndarray, "s"]]:
    """Which frames are out of reach of both neighbours or of the one before, and by how much joints deviate (metres).

    Args:
        joints: the pelvis in the world, the others about it in the body's own axes, so that turning moves none.
        roots: the root's rotations.
        seconds: of the frames.
    """
    count = len(joints)
    bad = np.zeros(count, bool)
    if count < 3:
        return bad, np.empty(0, np.float32)
    gaps = limited_gaps(np.diff(seconds))
    before, after = gaps[:-1], gaps[1:]
    weight = torch.as_tensor(after / (before + after), dtype=joints.dtype)[:, None, None]
    away = (joints[1:-1] - weight * joints[:-2] - (1 - weight) * joints[2:]).norm(dim=-1).numpy()
    excess = away.max(1) - (SLACK + 0.5 * ACCELERATION * before * after)
    # Beside one wrong frame others deviate by half as much; only the worst of a group is it.
    worst = ndimage.maximum_filter1d(excess, 3, mode="nearest") == excess
    bad[1:-1] = (excess > 0) & worst
    bad[1:] |= _angles(roots[:-1].transpose(-1, -2) @ roots[1:]).numpy() > TURN_SPEED * gaps
    return bad, away.ravel()


def _angles(rotations: Float[Tensor, "*b 3 3"]) -> Float[Tensor, "*b"]:
    trace = rotations.diagonal(dim1=-2, dim2=-1).sum(-1)
    return torch.acos(((trace - 1) / 2).clamp(-1, 1))


def _apart(one: Float[Tensor, "a 24 3 3"], other: Float[Tensor, "b 24 3 3"]) -> Float[Tensor, "a b 23"]:
    """By how much each joint but the root is turned between any two poses, radians."""
    # trace(A^T B) is the inner product of the two matrices.
    trace = torch.einsum("ajmn,bjmn->abj", one[:, 1:], other[:, 1:])
    return torch.acos(((trace - 1) / 2).clamp(-1, 1))


def _ranges(rotations: Float[Tensor, "t 24 3 3"]) -> tuple[float, ...]:
    apart = _apart(rotations, rotations).flatten(0, 1).amax(0)
    return tuple(math.degrees(float(apart[JOINT_NAMES.index(joint) - 1])) for _, joint in LIMBS)


def _different(rotations: Float[Tensor, "t 24 3 3"]) -> int:
    """How many poses differ from all that were counted before."""
    apart = _apart(rotations, rotations).amax(-1)
    kept: list[int] = []
    for frame in range(len(rotations)):
        if not kept or float(apart[frame, kept].min()) > NEW_POSE:
            kept.append(frame)
    return len(kept)
