"""4D-Humans and PHALP: a joblib file with an entry for each image, `results/demo_VIDEO.pkl`.

https://github.com/shubham-goel/4D-Humans
"""

from pathlib import Path
from typing import Any

import numpy as np
import torch

from twofold.capture.readers.sequence import numbers
from twofold.errors import TwofoldError
from twofold.joblib_files import read_joblib
from twofold.prepare.estimators.estimates import (
    Detection,
    Estimates,
    PoseOptions,
    as_axis_angle,
    betas_of,
    entries_have,
    tracks_of,
    wide_lens,
)

_WORDS = "results of 4D-Humans"
KEYS = ("tid", "smpl", "camera", "tracked_time")


def matches(content: Any) -> bool:
    """Whether the content of a pickle looks like them."""
    return entries_have(content, "smpl", "camera")


def read(path: Path, options: PoseOptions) -> Estimates:
    """Everybody in every image; what was only predicted between detections is left out.

    Raises:
        TwofoldError: the file is damaged.
    """
    content = read_joblib(path, _WORDS)
    if not matches(content):
        raise TwofoldError(f"{path} holds no images with `smpl` and `camera`, as 4D-Humans writes them; run it again.")
    detections: list[Detection] = []
    for name in sorted(content, key=str):
        detections += _people(content[name], Path(str(name)).stem, f"{path}, image {name}")
    lens = wide_lens(lambda width, height: 5000 / 256 * max(width, height))
    return Estimates("4D-Humans", path, tracks_of(detections), lens)


def _people(entry: Any, image: str, where: str) -> list[Detection]:
    missing = [key for key in KEYS if not isinstance(entry, dict) or key not in entry]
    if missing:
        raise TwofoldError(f"{where} lacks {', '.join(missing)}, which 4D-Humans writes; run it again.")
    counts = {key: len(entry[key]) if hasattr(entry[key], "__len__") else -1 for key in ("smpl", "camera")}
    ids = [int(n) for n in np.asarray(entry["tid"]).ravel()]
    if any(count < len(ids) for count in counts.values()) or len(entry["tracked_time"]) < len(ids):
        raise TwofoldError(f"{where} has {len(ids)} people and fewer of their poses; run 4D-Humans again.")
    found: list[Detection] = []
    for p, person in enumerate(ids):
        if entry["tracked_time"][p] != 0:
            continue  # Nobody was seen: the program has guessed where the person is.
        smpl = entry["smpl"][p]
        if not isinstance(smpl, dict) or any(key not in smpl for key in ("global_orient", "body_pose", "betas")):
            raise TwofoldError(f"`smpl` in {where} should have global_orient, body_pose and betas; run it again.")
        root = as_axis_angle(np.asarray(smpl["global_orient"])[None].reshape(1, 1, 3, 3), 1, "global_orient", where)
        body = np.asarray(smpl["body_pose"])
        rest = as_axis_angle(body[None] if body.shape == (23, 3, 3) else body, 23, "body_pose", where)
        place = numbers(np.asarray(entry["camera"][p]).ravel(), (3,), "camera", where)
        betas = betas_of(np.asarray(smpl["betas"]).ravel(), 1, where)[0]
        found.append(Detection(image, person, torch.cat([root[0], rest[0]]), torch.from_numpy(place), betas))
    return found
