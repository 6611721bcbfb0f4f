"""Feet that stand: where a motion's feet rest, and how they keep resting on a body with other legs.

A motion that is copied joint by joint to other legs lets the feet slide: the pelvis moves as far as the old legs
carried it. Here the feet's own paths are kept instead. Wherever a foot of the source rests, the target's foot moves as
the source's does (hardly at all); between two such rests the correction passes smoothly from one to the other.
"""

import itertools
from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Bool, Float
from scipy.ndimage import gaussian_filter1d, maximum_filter1d
from torch import Tensor

from twofold.body.leg_ik import ANKLES, HIPS, KNEES, STRAIGHTEST, TOES, reach
from twofold.body.motion import Motion, joint_frames, local_poses

RESTING_SPEED = 0.15
"""A foot's front that is slower rests, metres per second. Recorded feet that stand drift by some centimetres."""

_SHORTEST_REST, _SHORTEST_GAP = 0.1, 0.06
"""Seconds: shorter rests are not kept, shorter gaps between two rests are noise."""

_HAND_OVER = 0.08
"""Seconds over which the pelvis passes from one standing foot's correction to the other's (standard deviation)."""


def resting(toes: Float[Tensor, "T 2 3"], fps: float) -> Bool[Tensor, "T 2"]:
    """In which frames each foot rests: slower than `RESTING_SPEED` for at least a tenth of a second.

    Args:
        toes: positions of the feet's front joints, metres.
        fps: frames per second.
    """
    if len(toes) < 3:
        return torch.ones(len(toes), 2, dtype=torch.bool)
    speeds = torch.gradient(toes, dim=0)[0].norm(dim=-1) * fps
    columns = [_cleaned((speeds[:, side] < RESTING_SPEED).numpy(), fps) for side in (0, 1)]
    return torch.from_numpy(np.stack(columns, -1))


def _cleaned(rests: Bool[np.ndarray, "T"], fps: float) -> Bool[np.ndarray, "T"]:
    """Short gaps closed, then short rests dropped."""
    for value, shortest in ((False, _SHORTEST_GAP), (True, _SHORTEST_REST)):
        for first, end in _runs(rests == value):
            # What touches either end of the motion may go on beyond it.
            if (end - first) / fps < shortest and first > 0 and end < len(rests):
                rests[first:end] = not value
    return rests


def _runs(mask: Bool[np.ndarray, "T"]) -> list[tuple[int, int]]:
    """First frame and end (one past the last) of each unbroken run of true values."""
    steps = np.flatnonzero(np.diff(np.concatenate([[False], mask, [False]]).astype(np.int8)))
    return [(int(a), int(b)) for a, b in zip(steps[::2], steps[1::2], strict=True)]


def kept_contacts(
    motion: Motion, joints: Float[Tensor, "24 3"], sole: float, toes: Float[Tensor, "T 2 3"], still: float = 0.0
) -> Motion:
    """The motion with its feet standing where and while the source's do, the floor at y = 0.

    The pelvis follows the standing foot's correction, so that a leg that stands alone keeps its pose; what the two
    feet disagree about is left to the legs.

    Args:
        motion: on the target body, y up, the feet not yet right.
        joints: of the target's T-pose, metres.
        sole: height of the target's soles in the T-pose, metres.
        toes: paths of the source's foot fronts (left, right), scaled to the target's size, y up, metres.
        still: metres that a resting foot of the source may move, or be above the floor, without being followed, where
            its path is not known better than that.
    """
    rests = resting(toes, motion.fps)
    if not rests.any():
        return motion
    rotations, positions = joint_frames(joints, motion)
    own = positions[:, list(TOES)]
    rise = float(joints[list(TOES), 1].mean()) - sole
    wanted = toes.double() - torch.tensor([0.0, _floor(toes, rests) - rise, 0.0])
    changes = torch.stack([_corrections(wanted[:, s], own[:, s], rests[:, s].numpy(), rise, still) for s in (0, 1)], 1)
    root = _shared(changes, rests, motion.fps)
    # A foot in the air goes with the pelvis; only what it has to make up for on the floor is passed on.
    apart = torch.stack([_between(changes[:, s] - root, rests[:, s].numpy()) for s in (0, 1)], 1)
    ankles = positions[:, list(ANKLES)] + root[:, None] + apart
    root = root - _lowering(positions + root[:, None], ankles, rests, motion.fps)[:, None] * torch.tensor([0.0, 1, 0])
    turned = reach(rotations, positions + root[:, None], ankles)
    poses, moved = local_poses(turned), motion.translations.double() + root
    return replace(motion, poses=poses.to(motion.poses), translations=moved.to(motion.translations))


def _floor(toes: Float[Tensor, "T 2 3"], rests: Bool[Tensor, "T 2"]) -> float:
    """Height of the source's foot fronts when they stand on the floor: that of its lower rests."""
    return float(torch.quantile(toes[..., 1][rests].double()[:1_000_000], 0.2))


def _corrections(
    wanted: Float[Tensor, "T 3"], own: Float[Tensor, "T 3"], rests: Bool[np.ndarray, "T"], rise: float, still: float
) -> Float[Tensor, "T 3"]:
    """How far a foot is to be moved.

    While it rests, onto the source's path (but for a constant shift over the floor); in between, smoothly from one
    rest to the next.
    """
    known = (wanted - own).numpy().copy()
    for first, end in _runs(rests):
        path = wanted[first:end].numpy()
        middle = path.mean(0)
        off = path - middle
        far = np.linalg.norm(off, axis=1, keepdims=True)
        known[first:end] -= off * np.minimum(1, still / np.maximum(far, 1e-12))
        if abs(middle[1] - rise) < still:
            known[first:end, 1] += rise - middle[1]
        known[first:end, [0, 2]] -= known[first:end, [0, 2]].mean(0)
    return _between(torch.from_numpy(known), rests)


def _between(values: Float[Tensor, "T 3"], rests: Bool[np.ndarray, "T"]) -> Float[Tensor, "T 3"]:
    """The values of resting frames, passing smoothly from one rest to the next; zero where there is no rest at all."""
    runs = _runs(rests)
    if not runs:
        return torch.zeros_like(values)
    known = values.numpy().copy()
    known[: runs[0][0]], known[runs[-1][1] :] = known[runs[0][0]], known[runs[-1][1] - 1]
    for (_, end), (following, _) in itertools.pairwise(runs):
        share = np.linspace(0, 1, following - end + 2)[1:-1, None]
        share = share * share * (3 - 2 * share)
        known[end:following] = known[end - 1] + share * (known[following] - known[end - 1])
    return torch.from_numpy(known)


def _shared(changes: Float[Tensor, "T 2 3"], rests: Bool[Tensor, "T 2"], fps: float) -> Float[Tensor, "T 3"]:
    """The correction of whichever foot stands, passed over smoothly."""
    weights = gaussian_filter1d(rests.numpy().astype(np.float64), _HAND_OVER * fps, axis=0, mode="nearest") + 1e-3
    weighted = (torch.from_numpy(weights)[..., None] * changes).sum(1)
    return weighted / torch.from_numpy(weights).sum(1, keepdim=True)


def _lowering(
    positions: Float[Tensor, "T 24 3"], ankles: Float[Tensor, "T 2 3"], rests: Bool[Tensor, "T 2"], fps: float
) -> Float[Tensor, "T"]:
    """By how much the pelvis has to come down for standing feet to be within reach, smoothly over time, metres."""
    need = torch.zeros(len(positions), dtype=torch.float64)
    for side in (0, 1):
        hip, knee, ankle = (positions[:, joints[side]] for joints in (HIPS, KNEES, ANKLES))
        longest = STRAIGHTEST * ((knee - hip).norm(dim=-1) + (ankle - knee).norm(dim=-1))
        longest = torch.maximum(longest, (ankle - hip).norm(dim=-1))
        line = hip - ankles[:, side]
        across = line[:, [0, 2]].norm(dim=-1)
        highest = (longest.square() - across.square()).clamp_min(0).sqrt()
        need = torch.maximum(need, torch.where(rests[:, side], line[:, 1] - highest, 0.0))
    need = torch.where(need < 1e-9, 0.0, need)
    if not need.any():
        return need
    wide = maximum_filter1d(need.numpy(), max(1, round(0.3 * fps)), mode="nearest")
    return torch.maximum(torch.from_numpy(gaussian_filter1d(wide, 0.06 * fps, mode="nearest")), need)
