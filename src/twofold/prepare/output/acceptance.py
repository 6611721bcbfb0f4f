"""How well the fitted body agrees with each picture, which pictures to leave out, and when a clip cannot work."""

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from twofold.capture.layout import spans
from twofold.errors import TwofoldError
from twofold.geometry.cameras import Camera
from twofold.geometry.rotations import axis_angle_to_matrix
from twofold.prepare.detections import LANDMARKS, Track

LEAST_IOU, MOST_REPROJECTION, LEAST_VISIBILITY = 0.7, 4.0, 0.5
"""A picture below, above, below these is left out: measured on real clips, failed fits lie well beyond."""

MOST_BAD = 0.3
"""A clip with a larger share of bad pictures is refused."""

LEAST_PICTURES = 12
"""Fewer show too little of a person to learn how it moves."""

FULL_TURN = 180.0
"""A body that turns through less, in degrees, has a side that no picture shows."""

LARGER = "film one whole person, well lit and large enough, and try again"
FARTHER = "film from farther away, so that the whole body stays in view"
STEADIER = "film one person who stays in full view, without quick turns"
"""What to do about a film that is itself at fault."""

_ENDS = ("nose", "left_ankle", "right_ankle", "left_wrist", "right_wrist")


@dataclass(frozen=True)
class PictureQuality:
    """How well one picture is understood.

    Attributes:
        camera: whose picture.
        time: which moment of the capture.
        iou: of the body's silhouette and the mask.
        reprojection: mean error of the landmarks that are seen, pixels.
        reprojection_percent: the same in percent of the person's height in the pictures.
        visibility: mean over the landmarks.
        cropped: the head, or a hand or foot, is beyond the picture's edge.
        fault: why it is left out; empty where it is kept.
    """

    camera: str
    time: int
    iou: float
    reprojection: float
    reprojection_percent: float
    visibility: float
    cropped: bool
    fault: str = ""

    def row(self) -> dict[str, float | str | bool | None]:
        """For the capture's notes; None where nothing was there to measure, as JSON has no infinity."""
        return {
            k: (round(v, 3) if math.isfinite(v) else None) if isinstance(v, float) else v
            for k, v in asdict(self).items()
        }


def picture_quality(
    camera_name: str,
    camera: Camera,
    time: int,
    iou: float,
    shown: Float[np.ndarray, "33 2"],
    pixels: Float[np.ndarray, "33 2"],
    visibility: Float[np.ndarray, "33"],
    height: float,
    alone: bool = True,
) -> PictureQuality:
    """The record of one picture.

    Args:
        camera_name: whose picture.
        camera: that camera.
        time: which moment.
        iou: of silhouette and mask.
        shown: where the fitted body's landmarks project to.
        pixels: where the estimator saw them; NaN where it did not.
        visibility: 0..1.
        height: of the person in this camera's pictures, pixels.
        alone: no other camera saw the person. Where one did, landmarks that are missed are the estimator's fault.
    """
    known = np.isfinite(pixels).all(-1)
    sure = known & (visibility > 0.5)
    error = float(np.linalg.norm(shown - pixels, axis=-1)[sure].mean()) if sure.any() else float("inf")
    percent = 100 * error / height
    cropped = any(_beyond(pixels[LANDMARKS.index(name)], camera, 0.01) for name in _ENDS)
    mean = float(visibility.mean())
    fault = ""
    if not known.any():
        fault = "nobody was found"
    elif mean < LEAST_VISIBILITY:
        fault = f"too little of the person is seen (visibility {mean:.2f}, at least {LEAST_VISIBILITY})"
    elif iou < LEAST_IOU:
        fault = f"the body does not cover the mask (IoU {iou:.2f}, at least {LEAST_IOU})"
    elif alone and percent > MOST_REPROJECTION:
        fault = f"the body misses the landmarks ({percent:.1f} % of its height, at most {MOST_REPROJECTION:g} %)"
    return PictureQuality(camera_name, time, iou, error, percent, mean, cropped, fault)


def _beyond(pixel: Float[np.ndarray, "2"], camera: Camera, margin: float) -> bool:
    """Whether a landmark lies outside the picture by more than a share of its size."""
    size = np.array([camera.width, camera.height])
    return bool(np.isfinite(pixel).all() and ((pixel < -margin * size) | (pixel > (1 + margin) * size)).any())


def require_length(pictures: int, clip: str) -> None:
    """Refuses clips that are too short.

    Raises:
        TwofoldError: there are fewer pictures than `LEAST_PICTURES`.
    """
    if pictures < LEAST_PICTURES:
        raise TwofoldError(
            f"{clip} has {pictures} pictures, expected at least {LEAST_PICTURES} (a few seconds of a moving person); "
            "film longer, or raise --fps if it was lowered."
        )


def require_person(track: Track, clip: str, advice: str = LARGER) -> None:
    """Refuses clips in which a person is seldom found.

    Args:
        track: as found.
        clip: for the message.
        advice: what to do, to end it.

    Raises:
        TwofoldError: as said.
    """
    share = float(track.found.mean())
    if share < 1 - MOST_BAD:
        found = "nobody" if share == 0 else f"a person in only {100 * share:.0f} % of the pictures"
        raise TwofoldError(f"{clip} shows {found}; {advice}.")


def require_whole(qualities: Sequence[PictureQuality], clip: str, advice: str = FARTHER) -> None:
    """Refuses clips in which the person is cut off by the picture's edge most of the time.

    Args:
        qualities: of the clip's pictures.
        clip: for the message.
        advice: what to do, to end it.

    Raises:
        TwofoldError: in more than half of the pictures.
    """
    share = float(np.mean([q.cropped for q in qualities]))
    if share > 0.5:
        raise TwofoldError(
            f"In {100 * share:.0f} % of the pictures of {clip} head, hands or feet are beyond the picture's edge; "
            f"{advice}."
        )


def kept_times(qualities: Sequence[PictureQuality], clip: str, advice: str = STEADIER) -> list[int]:
    """Moments at which no camera's picture is bad.

    Args:
        qualities: of all pictures.
        clip: for the message.
        advice: what to do, to end it.

    Raises:
        TwofoldError: too many are bad, with the commonest reasons.
    """
    faults: dict[int, str] = {}
    for quality in qualities:
        if quality.fault:
            faults.setdefault(quality.time, quality.fault)
    times = sorted({quality.time for quality in qualities})
    if len(faults) > MOST_BAD * len(times):
        example = min(faults)
        raise TwofoldError(
            f"{len(faults)} of {len(times)} pictures of {clip} could not be understood (moments {spans(faults)}); at "
            f"{example}, for one, {faults[example]}; {advice}."
        )
    return [time for time in times if time not in faults]


def yaw_range(pose: Float[Tensor, "t 24 3"], camera: Camera) -> float:
    """Through how many degrees the body is seen turned about its own upright axis by one camera, 0..360.

    The largest arc that no picture shows, of all directions the body faces, is taken from the full circle.
    """
    facing = axis_angle_to_matrix(pose[:, 0])[:, :, 2] @ camera.world_to_camera[:3, :3].T
    up = axis_angle_to_matrix(pose[:, 0])[:, :, 1].mean(0) @ camera.world_to_camera[:3, :3].T
    up = up / up.norm()
    toward = torch.tensor([0.0, 0.0, -1.0]).to(up)
    first = toward - (toward @ up) * up
    first = first / first.norm().clamp_min(1e-6)
    second = torch.linalg.cross(up, first)
    angles = torch.atan2(facing @ second, facing @ first).sort().values
    gaps = torch.diff(angles, append=angles[:1] + 2 * torch.pi)
    return float(360 - gaps.max() * 180 / torch.pi)


def warnings_about(yaw: float, moved: float, width: int, dropped: Sequence[int], several: bool) -> list[str]:
    """What a user should know although the clip works.

    Args:
        yaw: from `yaw_range`, over the training camera.
        moved: how far the background moves, pixels.
        width: of the pictures.
        dropped: moments left out.
        several: more than one camera saw the person, so that one camera's yaw says less.
    """
    words: list[str] = []
    if yaw < FULL_TURN:
        words.append(
            f"The body turns through only {yaw:.0f} degrees before the training camera; unseen sides are made up. "
            "Film a full turn for a back that is true."
        )
    if moved > 0.01 * width and not several:
        words.append(
            f"The background moves by up to {moved:.0f} pixels: the camera does not stand still. Everything is told "
            "relative to it, so the person seems to sway; put the camera on something firm."
        )
    if several:
        words.append(
            "Several cameras agree on these poses; the one that trains cannot see their depth. Train with "
            "--set training.rate_pose=1e-4, so that they move little."
        )
    if dropped:
        words.append(f"{len(dropped)} moments were left out: {spans(dropped)}.")
    return words
