"""What the cameras of a clip saw, as tensors, and a first guess of the motion from it."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from twofold.body.skeleton import Body
from twofold.geometry.cameras import Camera
from twofold.prepare.detections import Track
from twofold.prepare.fitting.body_landmarks import BodyPoints
from twofold.prepare.fitting.initialization import first_pose, first_translation
from twofold.prepare.fitting.outlines import Mask, Outlines
from twofold.prepare.fitting.parameters import FittedMotion, place_points, pose_motion


@dataclass(frozen=True)
class Evidence:
    """What one camera saw.

    Attributes:
        camera: with a guess of the focal length where that is unknown.
        track: landmarks, sides repaired.
        masks: of each frame, as arrays (0..255) or as image files, which keeps the memory of long clips small;
            None where there are none.
        offsets: how far the estimator usually marks points off a body's (`Estimator.offsets`), metres.
        seconds: when each frame was seen, where the times are not even.
    """

    camera: Camera
    track: Track
    masks: Sequence[Mask] | None = None
    offsets: Float[np.ndarray, "33 3"] | None = None
    seconds: Float[np.ndarray, "t"] | None = None

    def __getitem__(self, times: slice) -> "Evidence":
        parts = {name: value[times] for name, value in vars(self.track).items()}
        masks = None if self.masks is None else self.masks[times]
        seconds = None if self.seconds is None else self.seconds[times]
        return Evidence(self.camera, Track(**parts), masks, self.offsets, seconds)


@dataclass(frozen=True)
class Seen:
    """Evidence of all cameras as tensors, c cameras and t frames; landmarks in space are each camera's or common.

    Offsets are the estimators' usual ones, mean over the cameras; `seconds` is None where the times are even.
    """

    world_to_camera: Float[Tensor, "c 4 4"]
    intrinsics: Float[Tensor, "c 3 3"]
    pixels: Float[Tensor, "c t 33 2"]
    weight: Float[Tensor, "c t 33"]
    space: Float[Tensor, "k t 33 3"]
    space_weight: Float[Tensor, "k t 33"]
    size: Float[Tensor, "c"]
    offsets: Float[Tensor, "33 3"]
    seconds: Float[Tensor, "t"] | None = None


def gather(
    evidence: Sequence[Evidence],
    outlines: Sequence[Outlines | None],
    points_in_space: Float[np.ndarray, "t 33 3"] | None,
) -> Seen:
    """Evidence of all cameras; landmarks in space are taken from `points_in_space` (world, metres) where given."""
    cameras = [e.camera for e in evidence]
    pixels = torch.from_numpy(np.stack([e.track.pixels for e in evidence])).float()
    weight = torch.from_numpy(np.stack([e.track.visibility for e in evidence])).float()
    space = torch.from_numpy(np.stack([e.track.world for e in evidence])).float()
    world_to_camera = torch.stack([c.world_to_camera for c in cameras]).float()
    space = torch.einsum("cij,ctni->ctnj", world_to_camera[:, :3, :3], space)
    if points_in_space is not None:
        space = torch.from_numpy(points_in_space).float()[None]
    there, in_space = pixels.isfinite().all(-1), space.isfinite().all(-1)
    # A guess about what is hidden is worth little, but better than nothing.
    weight = torch.where(there, weight.clamp_min(0.02) ** 2, 0)
    found = (weight > 0).any(-1, keepdim=True)
    offsets = [np.zeros((33, 3)) if e.offsets is None else e.offsets for e in evidence]
    sizes = [_height(e.track) if o is None else o.size for e, o in zip(evidence, outlines, strict=True)]
    return Seen(
        world_to_camera,
        torch.stack([c.intrinsics for c in cameras]).float(),
        torch.nan_to_num(pixels),
        weight * found,
        torch.nan_to_num(space),
        in_space.float(),
        torch.tensor(sizes),
        torch.from_numpy(np.mean(offsets, 0)).float(),
        None if evidence[0].seconds is None else torch.from_numpy(evidence[0].seconds),
    )


def _height(track: Track) -> float:
    """Median over the clip of the landmarks' extent, a little less than the person's height, pixels."""
    there = np.isfinite(track.pixels).all(-1)
    found = np.flatnonzero(there.any(1))
    if len(found) == 0:
        return 1.0
    extents = [np.ptp(track.pixels[time][there[time]], axis=0).max() for time in found]
    return max(float(np.median(extents)) * 1.1, 1.0)


def begin(body: Body, points: BodyPoints, seen: Seen) -> FittedMotion:
    """A first guess: the mean shape, posed by the landmarks in space, standing where it projects to its landmarks."""
    where = torch.where(seen.space_weight[..., None] > 0, seen.space, torch.nan)
    guesses = [first_pose(points, one) for one in where]
    # Each camera has a guess of its own; in each frame the one that sees most is taken, of those that know any.
    surest = seen.weight.sum(-1)[: len(guesses)] if len(guesses) > 1 else torch.zeros(1, len(where[0]))
    best = torch.where(torch.stack([known for _, _, known in guesses]), surest, surest - 1e3).argmax(0)
    guess, pose = (torch.stack([g[part] for g in guesses])[best, torch.arange(len(best))] for part in (0, 1))
    moments = len(guess)
    motion = FittedMotion(
        guess=guess, root=torch.zeros(moments, 3), pose=pose.float(), translation=torch.zeros(moments, 3),
        betas=torch.zeros(body.shape_basis.shape[-1]), marks=seen.offsets, log_focal=torch.zeros(()),
        log_distance=torch.zeros(()),
    )  # fmt: skip
    moved = place_points(pose_motion(body, motion), points, motion)
    weight = seen.weight.sqrt()
    translation = first_translation(moved, seen.pixels, weight, seen.world_to_camera, seen.intrinsics)
    known = torch.nonzero(seen.weight.sum((0, 2)) > 1)[:, 0]
    if len(known) == 0:
        return motion
    nearest = (torch.arange(moments)[:, None] - known).abs().argmin(1)
    return replace(motion, translation=translation[known][nearest])
