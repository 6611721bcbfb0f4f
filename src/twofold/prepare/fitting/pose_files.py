"""Poses that the user has: of every image of a clip, relative to the T-pose of the body that is taken."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from twofold.body.skeleton import Body
from twofold.errors import TwofoldError
from twofold.geometry.rotations import axis_angle_to_matrix
from twofold.npz import are_moderate, read_npz
from twofold.prepare.fitting.parameters import FittedMotion
from twofold.prepare.video.frames import ClipInfo

_PLACES = ("translations", "transl", "trans")
_JOINTS = 24


def poses_from_file(path: Path | str, info: ClipInfo, sources: Sequence[int], body: Body) -> FittedMotion:
    """A motion from an npz file with SMPL-like poses.

    Args:
        path: with `poses` (F x 24 x 3 or F x 72: axis-angle, root first, radians), `translations` (F x 3, metres; also
            called `transl` or `trans`) and, if they are known, `betas`. One camera: in its axes (x right, y down, z
            forward). Several: in the calibration's world.
        info: of the clip; F is how many images it has.
        sources: which of its images are used.
        body: whose joints these are.

    Raises:
        TwofoldError: the file is missing or damaged, lacks an array, has other shapes, or belongs to another clip.
    """
    path = Path(path)
    arrays = read_npz(path, ("poses", *_PLACES, "betas"))
    poses = _finite(arrays, ("poses",), path)
    places = _finite(arrays, _PLACES, path)
    if poses.ndim < 2 or poses[0].size != 3 * _JOINTS:
        raise TwofoldError(
            f"{path}: `poses` is {' x '.join(map(str, poses.shape))}, expected images x 24 x 3 (SMPL's joints)."
        )
    frames = len(poses)
    if places.shape != (frames, 3):
        shape = " x ".join(map(str, places.shape))
        raise TwofoldError(f"{path}: {frames} poses need translations of {frames} x 3; they are {shape}.")
    if not info.sources <= frames <= info.sources + max(1, info.sources // 50):
        raise TwofoldError(
            f"{path} has poses of {frames} images, and the clip has {info.sources}; give one for every image."
        )
    pose = torch.from_numpy(poses.reshape(frames, _JOINTS, 3)).float()
    motion = FittedMotion(
        guess=axis_angle_to_matrix(pose[:, 0]), root=torch.zeros(frames, 3), pose=pose[:, 1:],
        translation=torch.from_numpy(places).float(), betas=_betas(arrays, body, path),
        marks=torch.zeros(33, 3), log_focal=torch.zeros(()), log_distance=torch.zeros(()),
    )  # fmt: skip
    return motion_at(motion, sources)


def motion_at(motion: FittedMotion, sources: Sequence[int]) -> FittedMotion:
    """The motion in some frames, by their numbers."""
    chosen = torch.tensor(list(sources))
    return replace(
        motion, guess=motion.guess[chosen], root=motion.root[chosen], pose=motion.pose[chosen],
        translation=motion.translation[chosen],
    )  # fmt: skip


def _finite(arrays: dict[str, np.ndarray], names: Sequence[str], path: Path) -> np.ndarray:
    found = [name for name in names if name in arrays]
    if not found:
        raise TwofoldError(f"{path} lacks the array `{names[0]}`; docs/prepare.md describes what belongs in it.")
    values = arrays[found[0]]
    if values.dtype.kind not in "fiu" or not are_moderate(values):
        raise TwofoldError(f"{path}: `{found[0]}` holds something that is no finite number; estimate it again.")
    return values


def _betas(arrays: dict[str, np.ndarray], body: Body, path: Path) -> Float[Tensor, "S"]:
    """The shape coefficients given, filled up with zeros to as many as the body has."""
    betas = torch.zeros(body.shape_basis.shape[-1])
    if "betas" not in arrays:
        return betas
    given = np.atleast_2d(_finite(arrays, ("betas",), path).astype(np.float32))
    if (given != given[0]).any():
        raise TwofoldError(f"{path}: `betas` changes from image to image; a person has one shape, give its mean.")
    count = min(len(betas), given.shape[1])
    betas[:count] = torch.from_numpy(given[0, :count])
    return betas
