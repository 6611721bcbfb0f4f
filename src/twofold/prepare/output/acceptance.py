"""How well the fitted body agrees with each image, which images to leave out, and when a clip cannot work."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass

import numpy as np
from jaxtyping import Float

from twofold.capture.layout import spans
from twofold.errors import TwofoldError
from twofold.geometry.cameras import Camera
from twofold.prepare.detect.background import MOVING
from twofold.prepare.detections import LANDMARKS, Track
from twofold.prepare.turning import FULL_TURN

MIN_IOU = 0.7
"""A frame whose silhouette overlaps its mask by less is fitted badly: limbs are somewhere else. Measured on real
clips, failed fits lie well below."""
MAX_BAD = 0.3
"""With a larger share of bad frames the rest cannot outvote them."""
MAX_REPROJECTION, MIN_VISIBILITY = 4.0, 0.5
"""An image above, below these is left out: measured on real clips, failed fits lie well beyond."""

MIN_IMAGES = 12
"""Fewer show too little of a person to learn how it moves."""

LARGER = "film one whole person, well lit and large enough, and try again"
FARTHER = "film from farther away, so that the whole body stays in view"
STEADIER = "film one person who stays in full view, without quick turns"
"""What to do about a film that is itself at fault."""

DROPPED = "asked for with --drop"

_ENDS = ("nose", "left_ankle", "right_ankle", "left_wrist", "right_wrist")


@dataclass(frozen=True)
class ImageQuality:
    """How well one image is understood.

    Attributes:
        camera: whose image.
        frame_index: which frame of the capture.
        iou: of the body's silhouette and the mask.
        reprojection: mean error of the landmarks that are seen, pixels.
        reprojection_percent: the same in percent of the person's height in the images.
        visibility: mean over the landmarks.
        cropped: the head, or a hand or foot, is beyond the image's edge.
        fault: why it is left out; empty where it is kept.
    """

    camera: str
    frame_index: int
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


def image_quality(
    camera_name: str,
    camera: Camera,
    time: int,
    iou: float,
    shown: Float[np.ndarray, "33 2"],
    pixels: Float[np.ndarray, "33 2"],
    visibility: Float[np.ndarray, "33"],
    height: float,
    alone: bool = True,
) -> ImageQuality:
    """The record of one image.

    Args:
        camera_name: whose image.
        camera: that camera.
        time: which frame.
        iou: of silhouette and mask.
        shown: where the fitted body's landmarks project to.
        pixels: where the estimator saw them; NaN where it did not.
        visibility: 0..1.
        height: of the person in this camera's images, pixels.
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
    elif mean < MIN_VISIBILITY:
        fault = f"too little of the person is seen (visibility {mean:.2f}, at least {MIN_VISIBILITY})"
    elif iou < MIN_IOU:
        fault = f"the body does not cover the mask (IoU {iou:.2f}, at least {MIN_IOU})"
    elif alone and percent > MAX_REPROJECTION:
        fault = f"the body misses the landmarks ({percent:.1f} % of its height, at most {MAX_REPROJECTION:g} %)"
    return ImageQuality(camera_name, time, iou, error, percent, mean, cropped, fault)


def _beyond(pixel: Float[np.ndarray, "2"], camera: Camera, margin: float) -> bool:
    """Whether a landmark lies outside the image by more than a share of its size."""
    size = np.array([camera.width, camera.height])
    return bool(np.isfinite(pixel).all() and ((pixel < -margin * size) | (pixel > (1 + margin) * size)).any())


def require_length(images: int, clip: str) -> None:
    """Refuses clips that are too short.

    Raises:
        TwofoldError: there are fewer images than `MIN_IMAGES`.
    """
    if images < MIN_IMAGES:
        raise TwofoldError(
            f"{clip} has {images} images, expected at least {MIN_IMAGES} (a few seconds of a moving person); "
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
    if share < 1 - MAX_BAD:
        found = "nobody" if share == 0 else f"a person in only {100 * share:.0f} % of the images"
        raise TwofoldError(f"{clip} shows {found}; {advice}.")


def require_whole(qualities: Sequence[ImageQuality], clip: str, advice: str = FARTHER) -> None:
    """Refuses clips in which the person is cut off by the image's edge most of the time.

    Args:
        qualities: of the clip's images.
        clip: for the message.
        advice: what to do, to end it.

    Raises:
        TwofoldError: in more than half of the images.
    """
    share = float(np.mean([q.cropped for q in qualities]))
    if share > 0.5:
        raise TwofoldError(
            f"In {100 * share:.0f} % of the images of {clip} head, hands or feet are beyond the image's edge; {advice}."
        )


def kept_times(
    qualities: Sequence[ImageQuality], clip: str, advice: str = STEADIER, drop: Sequence[int] = ()
) -> tuple[list[int], dict[int, str]]:
    """Frames at which no camera's image is bad, and why each other one is left out.

    Args:
        qualities: of all images.
        clip: for the message.
        advice: what to do, to end it.
        drop: frames that the user wants left out; these do not count as bad.

    Raises:
        TwofoldError: too many are bad, with the commonest reasons; or fewer than two are left.
    """
    reasons = dict.fromkeys(drop, DROPPED)
    for quality in qualities:
        if quality.fault:
            reasons.setdefault(quality.frame_index, quality.fault)
    times = sorted({quality.frame_index for quality in qualities})
    faults = {time: reason for time, reason in reasons.items() if reason != DROPPED}
    if len(faults) > MAX_BAD * len(times):
        example = min(faults)
        raise TwofoldError(
            f"{len(faults)} of {len(times)} images of {clip} could not be understood (frames {spans(faults)}); at "
            f"{example}, for one, {faults[example]}; {advice}."
        )
    kept = [time for time in times if time not in reasons]
    if len(kept) < 3:
        raise TwofoldError(f"--drop leaves {len(kept)} images of {clip}; leave out fewer.")
    return kept, reasons


def warnings_about(
    yaw: float, moved: float | None, width: int, left_out: Mapping[int, str], several: bool
) -> list[str]:
    """What a user should know although the clip works.

    Args:
        yaw: from `turning.arc`, over the training camera.
        moved: how far the background moves, pixels; None where that is unknown.
        width: of the images.
        left_out: frames left out, and why.
        several: more than one camera saw the person, so that one camera's yaw says less.
    """
    words: list[str] = []
    if yaw < FULL_TURN:
        words.append(
            f"The body turns through only {yaw:.0f} degrees before the training camera; the colours of unseen sides "
            "are guesses. Film a full turn for a back that is true."
        )
    if moved is not None and moved > MOVING * width and not several:
        words.append(
            f"The background moves by up to {moved:.0f} pixels: the camera does not stand still. Everything is given "
            "relative to it, so the person seems to sway; put the camera on something firm."
        )
    if several:
        words.append(
            "Several cameras agree on these poses; the one that trains cannot see their depth. Train with "
            "--set method.rates.pose=1e-4, so that they move little."
        )
    if left_out:
        words.append(f"{len(left_out)} frames were left out: {reasons_in_words(left_out)}.")
    return words


def reasons_in_words(left_out: Mapping[int, str]) -> str:
    """Frames by why they are left out; what was measured at one of them stands for all.

    >>> reasons_in_words({3: "nobody was found", 5: "nobody was found", 4: "too blurred (0.2)"})
    '3, 5 (nobody was found); 4 (too blurred)'
    """
    groups: dict[str, list[int]] = {}
    for time, reason in sorted(left_out.items()):
        groups.setdefault(reason.split(" (")[0], []).append(time)
    return "; ".join(f"{spans(times)} ({reason})" for reason, times in groups.items())
