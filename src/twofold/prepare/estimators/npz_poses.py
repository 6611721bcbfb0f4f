"""Poses in an npz file of the user's own: `poses`, `translations` and, if they are known, `betas`."""

from pathlib import Path

import torch

from twofold.capture.readers.sequence import numbers
from twofold.errors import TwofoldError
from twofold.npz import read_npz
from twofold.prepare.estimators.estimates import (
    Estimates,
    PersonTrack,
    PoseOptions,
    as_axis_angle,
    betas_of,
)

_PLACES = ("translations", "transl", "trans")


def recognizes(path: Path) -> bool:
    """Whether it may be one."""
    return not path.is_dir()


def read(path: Path, options: PoseOptions) -> Estimates:
    """A pose for every image of the clip, in order, or for those in `frame_ids`, counted from 0.

    Raises:
        TwofoldError: the file is missing or damaged, lacks an array, or has other shapes.
    """
    arrays = read_npz(path, ("poses", *_PLACES, "betas", "frame_ids"))
    places = next((name for name in _PLACES if name in arrays), None)
    for name, there in (("poses", "poses" in arrays), ("translations", places is not None)):
        if not there:
            raise TwofoldError(f"{path} lacks the array `{name}`; docs/prepare.md describes what belongs in it.")
    poses = as_axis_angle(arrays["poses"], 24, "poses", path)
    count = len(poses)
    shifts = numbers(arrays[places or ""], (count, 3), places or "", path)
    betas = betas_of(arrays["betas"], count, path) if "betas" in arrays else torch.zeros(count, 0).double()
    images = range(count)
    if "frame_ids" in arrays:
        images = [int(n) for n in numbers(arrays["frame_ids"], (count,), "frame_ids", path)]
        if len(set(images)) < count:
            raise TwofoldError(f"frame_ids in {path} name an image twice; correct them.")
    track = PersonTrack(tuple(map(str, images)), poses, torch.from_numpy(shifts), betas)
    return Estimates("npz", path, {0: track}, counted=True, complete="frame_ids" not in arrays, smpl=False)
