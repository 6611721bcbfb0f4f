"""EasyMocap: a folder `smpl/` with a JSON file for each image; bodies are placed about the model's origin.

https://github.com/zju3dv/EasyMocap
"""

from pathlib import Path
from typing import Any

import numpy as np
import torch

from twofold.capture.readers.sequence import numbers, require_radians
from twofold.errors import TwofoldError
from twofold.inputs import read_json
from twofold.prepare.estimators.estimates import Detection, Estimates, PoseOptions, betas_of, tracks_of


def recognizes(path: Path) -> bool:
    """Whether it looks like them."""
    return path.is_dir() and any(entry.suffix == ".json" for entry in path.iterdir())


def read(path: Path, options: PoseOptions) -> Estimates:
    """Everybody, in the calibration's world. The translation that comes back is Th of R x + Th.

    Raises:
        TwofoldError: a file is damaged or of another model.
    """
    detections: list[Detection] = []
    for file in sorted(entry for entry in path.iterdir() if entry.suffix == ".json"):
        content = read_json(file)
        people = content.get("annots") if isinstance(content, dict) else content
        if not isinstance(people, list):
            raise TwofoldError(f"{file} should list people, or hold such a list as `annots`; make it again.")
        detections += [_person(entry, file) for entry in people]
    return Estimates("EasyMocap", path, tracks_of(detections))


def _person(entry: Any, file: Path) -> Detection:
    missing = [key for key in ("Rh", "Th", "poses", "shapes") if not isinstance(entry, dict) or key not in entry]
    if missing:
        raise TwofoldError(f"A person in {file} lacks {', '.join(missing)}, which EasyMocap writes; make it again.")
    turn, shift = (_flat(entry[key], key, (3,), file) for key in ("Rh", "Th"))
    poses = _flat(entry["poses"], "poses", (None,), file)
    if len(poses) == 69:  # newer versions leave the root out
        poses = np.concatenate([np.zeros(3), poses])
    if len(poses) != 72:
        words = {78: "SMPL-H", 87: "SMPL-X"}.get(len(poses))
        found = f" (as {words} has)" if words else ""
        raise TwofoldError(f"poses in {file} are {len(poses)} numbers{found}, SMPL has 72 or, without the root, 69.")
    require_radians(np.concatenate([poses, turn]).reshape(-1, 3), file)
    if np.abs(poses[:3]).max() > 1e-6:
        raise TwofoldError(f"The root in `poses` of {file} should be zero, Rh has its rotation; make it again.")
    pose = torch.from_numpy(np.concatenate([turn, poses[3:]])).reshape(24, 3)
    person = entry.get("id")
    betas = betas_of(_flat(entry["shapes"], "shapes", (None,), file), 1, file)[0]
    return Detection(file.stem, person if isinstance(person, int) else None, pose, torch.from_numpy(shift), betas)


def _flat(value: Any, what: str, shape: tuple[int | None, ...], file: Path) -> np.ndarray:
    try:
        return numbers(np.asarray(value).ravel(), shape, what, file)
    except ValueError as error:  # rows of unequal length
        raise TwofoldError(f"{what} in {file} should be numbers; make it again.") from error
