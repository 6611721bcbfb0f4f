"""Poses that the user has, in a file of their own or as results of an estimator, as a motion of a clip's images."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from twofold.body.skeleton import Body
from twofold.errors import TwofoldError
from twofold.geometry.cameras import Camera
from twofold.geometry.rotations import axis_angle_to_matrix
from twofold.prepare.estimators.estimates import (
    Lens,
    PersonTrack,
    PoseOptions,
    absent_words,
    chosen_track,
    places_of,
)
from twofold.prepare.estimators.known_estimators import placed, read_estimates
from twofold.prepare.fitting.parameters import FittedMotion, root_of
from twofold.prepare.video.frames import ClipInfo

_VARYING = 0.3
"""Betas that differ by more from image to image are worth a sentence."""


@dataclass(frozen=True)
class OwnPoses:
    """A motion of every image of a clip.

    Attributes:
        motion: of every image; between images with poses it is that of the nearest one.
        absent: images without a pose, by `VideoFrame.source`.
        lens: the camera that the poses were estimated with; None where nothing says.
        remarks: sentences for the user.
    """

    motion: FittedMotion
    absent: tuple[int, ...]
    lens: Lens | None
    remarks: tuple[str, ...]


def poses_from_file(path: Path | str, info: ClipInfo, body: Body, options: PoseOptions | None = None) -> OwnPoses:
    """A motion from poses of SMPL's joints: see `known_estimators.ESTIMATORS` for the files.

    Args:
        path: file or folder.
        info: of the clip; images are matched by their names or numbers.
        body: whose joints these are.
        options: whom of several people, and what else is needed.

    Raises:
        TwofoldError: the file is missing or damaged, of no known kind, of another body, or belongs to another clip.
    """
    options = options or PoseOptions()
    found, placement = read_estimates(Path(path), options)
    if found.smpl and body.name != "smpl":
        raise TwofoldError(
            f"{path} has poses and shapes of SMPL, and the body is {body.name}; name your SMPL file with --body."
        )
    track, people = chosen_track(found, options.track)
    betas, words = _one_shape(track, body, path)
    track, _ = chosen_track(placed(found, placement, root_of(body, betas)), options.track)
    count = len(track.images)
    if found.complete and not info.sources <= count <= info.sources + max(1, info.sources // 50):
        raise TwofoldError(
            f"{path} has poses of {count} images, and the clip has {info.sources}; give one for every image."
        )
    rows, assumed = places_of(track, found, info)
    if not rows:
        raise TwofoldError(f"{path} has no pose of any image of the clip; give the results for this clip.")
    absent = tuple(source for source in range(info.sources) if source not in rows)
    known = torch.tensor(sorted(rows))
    nearest = known[(torch.arange(info.sources)[:, None] - known).abs().argmin(1)]
    order = torch.tensor([rows[int(source)] for source in nearest])
    pose = track.poses[order].float()
    motion = FittedMotion(
        guess=axis_angle_to_matrix(pose[:, 0]), root=torch.zeros(len(pose), 3), pose=pose[:, 1:],
        translation=track.translations[order].float(), betas=betas.float(),
        marks=torch.zeros(33, 3), log_focal=torch.zeros(()), log_distance=torch.zeros(()),
    )  # fmt: skip
    remarks = (*found.remarks, people, words, assumed, absent_words(found, absent))
    return OwnPoses(motion, absent, found.lens, tuple(filter(None, remarks)))


def with_lens(own: OwnPoses, camera: Camera, lens: Lens, info: ClipInfo, body: Body) -> OwnPoses:
    """Poses for another camera than they were estimated with: every pelvis keeps its place and size in the image.

    Args:
        own: as estimated.
        camera: that is taken, of images of the clip's size.
        lens: that they were estimated with.
        info: of the clip.
        body: whose joints these are.
    """
    across, down = info.width / info.full_width, info.height / info.full_height
    fx, fy, cx, cy = lens(info.full_width, info.full_height)
    fx, fy, cx, cy = fx * across, fy * down, (cx + 0.5) * across - 0.5, (cy + 0.5) * down - 0.5
    joint = root_of(body, own.motion.betas)
    moved = refocused(own.motion.translation + joint, (fx, fy, cx, cy), camera.intrinsics) - joint
    ratio = float(camera.intrinsics[0, 0]) / fx
    words = () if abs(ratio - 1) < 1e-3 else (
        f"The poses were estimated with a focal length of {fx:.0f} pixels; depths are scaled by {ratio:.3f} for yours.",
    )  # fmt: skip
    return replace(own, motion=replace(own.motion, translation=moved), remarks=(*own.remarks, *words))


def refocused(
    points: Float[Tensor, "n 3"], lens: tuple[float, float, float, float], intrinsics: Float[Tensor, "3 3"]
) -> Float[Tensor, "n 3"]:
    """Points in a camera's axes moved so that another lens shows them at the same pixels and in the same size."""
    fx, fy, cx, cy = lens
    depth = points[:, 2] * float(intrinsics[0, 0]) / fx
    column = fx * points[:, 0] / points[:, 2] + cx
    row = fy * points[:, 1] / points[:, 2] + cy
    x = (column - intrinsics[0, 2]) / intrinsics[0, 0] * depth
    y = (row - intrinsics[1, 2]) / intrinsics[1, 1] * depth
    return torch.stack([x, y, depth], -1)


def motion_at(motion: FittedMotion, sources: Sequence[int]) -> FittedMotion:
    """The motion in some frames, by their numbers."""
    chosen = torch.tensor(list(sources))
    return replace(
        motion, guess=motion.guess[chosen], root=motion.root[chosen], pose=motion.pose[chosen],
        translation=motion.translation[chosen],
    )  # fmt: skip


def _one_shape(track: PersonTrack, body: Body, path: Path | str) -> tuple[Float[Tensor, "S"], str]:
    """The mean shape, filled up with zeros to as many coefficients as the body has, and a sentence where it varies."""
    betas = torch.zeros(body.shape_basis.shape[-1])
    count = min(len(betas), track.betas.shape[1])
    if not count:
        return betas, ""
    betas[:count] = track.betas.mean(0)[:count].float()
    off = float((track.betas - track.betas.mean(0)).abs().max())
    if off <= _VARYING:
        return betas, ""
    return betas, f"betas in {path} differ from image to image by up to {off:.2f}; a person has one shape, their mean."
