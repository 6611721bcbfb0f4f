"""WHAM: a joblib file with an entry for each person, `wham_output.pkl` (written with --save_pkl).

https://github.com/yohanshin/WHAM
"""

from pathlib import Path
from typing import Any

import numpy as np
import torch

from twofold.capture.readers.sequence import numbers
from twofold.errors import TwofoldError
from twofold.joblib_files import read_joblib
from twofold.prepare.estimators.estimates import (
    Estimates,
    PersonTrack,
    PoseOptions,
    as_axis_angle,
    betas_of,
    entries_have,
    wide_lens,
)

_WORDS = "results of WHAM"


def matches(content: Any) -> bool:
    """Whether the content of a pickle looks like them."""
    return entries_have(content, "frame_ids", "pose")


def read(path: Path, options: PoseOptions) -> Estimates:
    """Everybody, in the camera's axes.

    Raises:
        TwofoldError: the file is damaged.
    """
    content = read_joblib(path, _WORDS)
    if not matches(content):
        raise TwofoldError(f"{path} holds no people with `pose` and `frame_ids`, as WHAM writes them; run it again.")
    tracks: dict[int, PersonTrack] = {}
    for person, entry in content.items():
        where = f"{path}, person {person}"
        missing = [key for key in ("pose", "trans", "betas", "frame_ids") if key not in entry]
        if missing:
            raise TwofoldError(f"{where} lacks {', '.join(missing)}, which WHAM writes; run it again.")
        poses = as_axis_angle(entry["pose"], 24, "pose", where)
        ids = numbers(np.asarray(entry["frame_ids"]).ravel(), (len(poses),), "frame_ids", where).astype(np.int64)
        if len(set(ids.tolist())) < len(ids):
            raise TwofoldError(f"frame_ids in {where} name an image twice; run WHAM again.")
        places = torch.from_numpy(numbers(entry["trans"], (len(poses), 3), "trans", where))
        number = int(person) if isinstance(person, int) or str(person).isdecimal() else len(tracks)
        tracks[number] = PersonTrack(
            tuple(str(n) for n in ids.tolist()), poses, places, betas_of(entry["betas"], len(poses), where)
        )
    lens = wide_lens(lambda width, height: float(np.hypot(width, height)))
    return Estimates("WHAM", path, tracks, lens, counted=True)
