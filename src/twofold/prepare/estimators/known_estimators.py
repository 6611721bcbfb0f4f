"""Every kind of results of pose estimators that `--poses` takes: one file and one line for each."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from twofold.capture.readers.body_placement import from_model_origin, from_pelvis
from twofold.errors import TwofoldError
from twofold.inputs import is_there, shown_path
from twofold.joblib_files import read_joblib
from twofold.prepare.estimators import (
    easymocap_results,
    gvhmr_results,
    npz_poses,
    phalp_results,
    romp_results,
    wham_results,
)
from twofold.prepare.estimators.estimates import Estimates, PoseOptions

Placement = Callable[
    [Float[Tensor, "n 3"], Float[Tensor, "n 3"], Float[Tensor, "n 3"], Float[Tensor, "3"]],
    tuple[Float[Tensor, "n 3"], Float[Tensor, "n 3"]],
]


@dataclass(frozen=True)
class PoseEstimator:
    """A kind of results.

    Attributes:
        title: for people.
        recognizes: whether a path looks like it.
        read: everybody in it.
        placement: how its root rotation and translation are brought to SMPL's own; None where they are that.
    """

    title: str
    recognizes: Callable[[Path], bool]
    read: Callable[[Path, PoseOptions], Estimates]
    placement: Placement | None = None


def _in_pickle(matches: Callable[[Any], bool]) -> Callable[[Path], bool]:
    def recognizes(path: Path) -> bool:
        return path.is_file() and path.suffix in (".pkl", ".joblib") and matches(read_joblib(path, "poses"))

    return recognizes


ESTIMATORS: dict[str, PoseEstimator] = {
    "romp": PoseEstimator("ROMP", romp_results.recognizes, romp_results.read),
    "wham": PoseEstimator("WHAM", _in_pickle(wham_results.matches), wham_results.read),
    "phalp": PoseEstimator("4D-Humans", _in_pickle(phalp_results.matches), phalp_results.read),
    "gvhmr": PoseEstimator("GVHMR", gvhmr_results.recognizes, gvhmr_results.read, from_pelvis),
    "easymocap": PoseEstimator("EasyMocap", easymocap_results.recognizes, easymocap_results.read, from_model_origin),
    "npz": PoseEstimator("an npz file with poses and translations", npz_poses.recognizes, npz_poses.read),
}
"""In the order in which they are asked."""


def read_estimates(path: Path, options: PoseOptions) -> tuple[Estimates, Placement | None]:
    """Everybody in the results at `path`, and how they are brought to SMPL's own placement.

    Raises:
        TwofoldError: nothing lies there, it is of no known kind, or it is damaged.
    """
    if not is_there(path):
        raise TwofoldError(f"{shown_path(path)} does not exist; --poses takes a file or folder with poses.")
    kind = next((kind for kind in ESTIMATORS.values() if kind.recognizes(path)), None)
    if kind is None or (kind is ESTIMATORS["npz"] and path.suffix in (".pkl", ".joblib")):
        known = ", ".join(kind.title for kind in ESTIMATORS.values())
        raise TwofoldError(f"{shown_path(path)} is none of the results that --poses takes: {known}.")
    return kind.read(path, options), kind.placement


def placed(found: Estimates, placement: Placement | None, joint: Float[Tensor, "3"]) -> Estimates:
    """The same people in SMPL's own placement.

    Args:
        found: as they were read.
        placement: see `PoseEstimator`.
        joint: rest position of the body's root joint, metres.
    """
    if placement is None:
        return found
    tracks = {}
    for person, track in found.tracks.items():
        still = torch.zeros_like(track.translations)
        root, shift = placement(track.poses[:, 0], track.translations, still, joint.double())
        tracks[person] = replace(track, poses=torch.cat([root[:, None], track.poses[:, 1:]], 1), translations=shift)
    return replace(found, tracks=tracks)
