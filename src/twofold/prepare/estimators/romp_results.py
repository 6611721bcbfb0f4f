"""ROMP (simple-romp, and BEV): an npz file for each image, or `video_results.npz` for a video.

https://github.com/Arthur151/ROMP
"""

from pathlib import Path
from typing import Any

import numpy as np

from twofold.capture.readers.sequence import numbers
from twofold.errors import TwofoldError
from twofold.inputs import is_there
from twofold.npy import read_npz_object
from twofold.prepare.estimators.estimates import (
    Detection,
    Estimates,
    PoseOptions,
    as_axis_angle,
    betas_of,
    tracks_of,
    wide_lens,
)

VIDEO = "video_results.npz"
_WORDS = "ROMP's results"
_MAX_FILES = 1_000_000


def recognizes(path: Path) -> bool:
    """Whether it looks like them."""
    if path.is_dir():
        return is_there(path / VIDEO) or any(entry.suffix == ".npz" for entry in path.iterdir())
    return path.suffix == ".npz" and read_npz_object(path, "results", _WORDS, only_names=True) is not None


def read(path: Path, options: PoseOptions) -> Estimates:
    """Everybody in every image; images with nobody have no file.

    Raises:
        TwofoldError: a file is damaged, or of a version without translations.
    """
    detections: list[Detection] = []
    if path.is_dir():
        files = sorted(entry for entry in path.iterdir() if entry.suffix == ".npz" and entry.name != VIDEO)
        if files:
            for file in files:
                detections += _people(_results(file), file.stem, file)
        else:
            path = path / VIDEO
    if path.is_file():
        content = _results(path)
        if isinstance(content, dict) and "smpl_thetas" in content:
            detections += _people(content, path.stem, path)
        elif isinstance(content, dict):
            for name in sorted(content):
                detections += _people(content[name], Path(str(name)).stem, path)
        else:
            detections += _people(content, path.stem, path)
    lens = wide_lens(lambda width, height: 443.4 / 512 * max(width, height))
    return Estimates("ROMP", path, tracks_of(detections), lens)


def _results(file: Path) -> Any:
    found = read_npz_object(file, "results", _WORDS)
    if found is None:
        raise TwofoldError(f"{file} lacks `results`, which ROMP writes; give the folder with its npz files.")
    return found


def _people(content: Any, image: str, where: Path) -> list[Detection]:
    if isinstance(content, list):
        raise TwofoldError(
            f"{where} is of ROMP's version of 2021, which stores no translations (cam_trans); run simple-romp."
        )
    if not isinstance(content, dict):
        raise TwofoldError(f"`results` in {where} should be a dictionary, it is {type(content).__name__}.")
    missing = [key for key in ("smpl_thetas", "smpl_betas", "cam_trans") if key not in content]
    if missing:
        raise TwofoldError(f"{where} lacks {', '.join(missing)}, which ROMP writes; run simple-romp again.")
    poses = as_axis_angle(content["smpl_thetas"], 24, "smpl_thetas", where)
    places = numbers(content["cam_trans"], (len(poses), 3), "cam_trans", where)
    betas = betas_of(content["smpl_betas"], len(poses), where)
    ids: list[int | None] = [None] * len(poses)
    if "track_ids" in content:
        ids = [int(n) for n in numbers(np.asarray(content["track_ids"]).ravel(), (len(poses),), "track_ids", where)]
    import torch

    return [
        Detection(image, ids[p], poses[p], torch.from_numpy(places[p]), betas[p]) for p in range(len(poses))
    ]  # fmt: skip
