"""The clips that a capture is made from, each with the camera that took it."""

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np
import torch
from jaxtyping import Float

from twofold.capture.layout import intrinsics_faults
from twofold.errors import TwofoldError
from twofold.geometry.cameras import Camera
from twofold.geometry.lens import largest_distortion
from twofold.prepare.cameras.calibration import (
    CalibratedCamera,
    for_pictures,
    match_cameras,
    pinhole,
    size_of_principal_point,
)
from twofold.prepare.cameras.calibration_files import read_calibration
from twofold.prepare.video.focal import FULL_FRAME
from twofold.prepare.video.frames import ClipInfo, Frames

Choice = Literal["largest", "masks"] | int
"""The largest person of the first image, the one that the user's own masks show, or the N-th from the left."""

FOCAL_GUESS = 0.9
"""Times the longer side of an image: between a phone's main lens (0.75 to 0.85 in video) and a camera's usual one."""

_SAME_RATE = 1.01
"""Rates that differ by less are the same: time stamps are rounded."""

_LENS_MATTERS = 0.5
"""Images are undistorted where the lens moves a point by more pixels than this."""


@dataclass(frozen=True)
class PrepareConfig:
    """What to make of the clips.

    Attributes:
        fps: images a second to use; None for all.
        max_size: longer side of the images, pixels; larger ones are made smaller.
        intrinsics: fx, fy, cx, cy in pixels of the clip itself; None to find the focal length.
        calibration: file or folder with the cameras of several clips.
        train_camera: which clip trains where there are several, by its name; None for the first.
        held_out: every Nth frame is held out for testing.
        held_objects: whether balls and the like are taken out of the masks.
        credit: whom to name when showing the images.
        masks: the user's own, instead of the estimator's.
        landmarks: likewise.
        poses: likewise; nothing is fitted then.
        track: whom of several people in these poses; None for who is seen longest.
        smplx: the user's SMPL-X file, where these poses are of that model.
        several_people: whether a second person in view ends it.
        person: which of several people is meant; None for whom the user's own masks, landmarks or poses show, else for
            the only one.
        drop: frames that are left out of the splits.
        refine_masks: "auto" compares the estimator's masks with the background where the camera stands still.
    """

    fps: float | None = None
    max_size: int = 960
    intrinsics: tuple[float, float, float, float] | None = None
    calibration: Path | None = None
    train_camera: str | None = None
    held_out: int = 10
    held_objects: Literal["keep", "remove"] = "remove"
    credit: str = ""
    masks: Path | None = None
    landmarks: Path | None = None
    poses: Path | None = None
    track: int | None = None
    smplx: Path | None = None
    several_people: Literal["refuse", "ignore"] = "refuse"
    person: Choice | None = None
    drop: tuple[int, ...] = ()
    refine_masks: Literal["auto", "off"] = "auto"


_HINTS = {
    "masks": "is each white on the person of its own image?",
    "landmarks": "are they of this clip, in pixels of its full size?",
    "poses": "are they of this clip and body, in metres and radians, before the camera?",
    "calibration": "do its cameras' names go with the videos', and is it of this recording and of images of this size?",
    "intrinsics": "are they of this camera, in pixels of the video's full size?",
}
"""What to ask about each piece of the user's own."""


def advice(config: PrepareConfig, film: str, pieces: Sequence[str] = tuple(_HINTS)) -> str:
    """What to do about images that are not understood, the end of a sentence.

    Args:
        config: what was given.
        film: what to do where nothing was given that could be at fault: then it is the film.
        pieces: which of the user's own pieces could be at fault.
    """
    given = [(piece, getattr(config, piece)) for piece in pieces if getattr(config, piece) is not None]
    if not given:
        return film
    words = [
        f"--{piece} {','.join(f'{n:g}' for n in value) if isinstance(value, tuple) else value} ({_HINTS[piece]})"
        for piece, value in given
    ]
    return "the likeliest cause is " + ", or ".join(words)


@dataclass(frozen=True)
class Clip:
    """One clip, ready to be looked at.

    Attributes:
        name: of its camera.
        path: where it lies.
        frames: its images.
        info: what will come of it.
        camera: that took it, for images without distortion.
        lens: how to take the distortion out of an image; None where there is next to none.
        calibrated: the camera in the calibration's precision; None where it was guessed.
    """

    name: str
    path: Path
    frames: Frames
    info: ClipInfo
    camera: Camera
    lens: CalibratedCamera | None
    calibrated: CalibratedCamera | None


def read_intrinsics(text: str | None) -> tuple[float, float, float, float] | None:
    """fx, fy, cx, cy from "fx,fy,cx,cy".

    Raises:
        TwofoldError: that is not what it says.
    """
    if text is None:
        return None
    try:
        fx, fy, cx, cy = (float(part) for part in text.split(","))
    except ValueError:
        raise TwofoldError(
            f"--intrinsics should be four numbers fx,fy,cx,cy in pixels, such as 1050,1050,540,960; it is {text!r}."
        ) from None
    _require_lens((fx, fy, cx, cy))
    return fx, fy, cx, cy


def read_frames(text: str | None) -> tuple[int, ...]:
    """Frame numbers from a list with ranges.

    >>> read_frames("3,7-9")
    (3, 7, 8, 9)

    Raises:
        TwofoldError: that is not what it says.
    """
    numbers: set[int] = set()
    for part in (text or "").replace(" ", "").split(",") if text else []:
        match = re.fullmatch(r"([0-9]{1,9})(?:-([0-9]{1,9}))?", part)
        first, last = (int(match[1]), int(match[2] or match[1])) if match else (1, 0)
        if first > last or last - first > 1_000_000:
            raise TwofoldError(f"--drop should list frames and ranges of them, such as 3,7-9; it is {text!r}.")
        numbers |= set(range(first, last + 1))
    return tuple(sorted(numbers))


def _require_lens(lens: tuple[float, float, float, float]) -> None:
    if not (np.isfinite(lens).all() and min(lens[:2]) > 0):
        given = ",".join(f"{number:g}" for number in lens)
        raise TwofoldError(
            f"--intrinsics should be finite numbers fx,fy,cx,cy in pixels with fx and fy above 0; they are {given}."
        )


def require_options(clips: Sequence[Path], config: PrepareConfig) -> None:
    """Refuses options that do not go together.

    Raises:
        TwofoldError: as it says.
    """
    if not clips:
        raise TwofoldError("Expected at least one video or folder of images; none was given.")
    if len(clips) > 1 and config.calibration is None:
        raise TwofoldError(
            f"{len(clips)} videos were given, which need --calibration FILE to say where their cameras stand; "
            "give one, or prepare a single video."
        )
    if config.intrinsics is not None:
        _require_lens(config.intrinsics)
        if config.calibration is not None:
            raise TwofoldError(
                "--intrinsics and --calibration were both given; the calibration has them, take it alone."
            )
    names = clip_names(clips)
    if config.train_camera is not None and config.train_camera not in names:
        raise TwofoldError(f"--train-camera {config.train_camera} is none of the clips; they are {', '.join(names)}.")
    if config.person == "masks" and config.masks is None:
        raise TwofoldError("--person masks takes the person in your own masks; give them with --masks, too.")
    if isinstance(config.person, int) and config.person < 1:
        raise TwofoldError(f"--person counts people from the left, from 1; it is {config.person}.")
    if config.poses is None and (config.track is not None or config.smplx is not None):
        raise TwofoldError("--track and --smplx belong to the results of a pose estimator; give these with --poses.")
    if config.held_out < 3:
        raise TwofoldError(f"One frame of {config.held_out} cannot be held out between two that train; take 3 or more.")


def open_clips(clips: Sequence[Path], config: PrepareConfig) -> list[Clip]:
    """The clips with their cameras, calibrated or guessed.

    Raises:
        TwofoldError: a clip or the calibration cannot be read, or they do not go together.
    """
    lenses: list[CalibratedCamera] | None = None
    if config.calibration is not None:
        lenses = match_cameras(read_calibration(config.calibration), [_stem(clip) for clip in clips])
    ready: list[Clip] = []
    for k, (name, clip) in enumerate(zip(clip_names(clips), clips, strict=True)):
        frames = Frames(clip, config.fps, config.max_size, even=len(clips) > 1)
        info = frames.info
        if lenses is None:
            ready.append(Clip(name, clip, frames, info, _guessed(info, config), None, None))
            continue
        lens = for_pictures(lenses[k], next(iter(Frames(clip, config.fps))).image)
        small = _smaller(lens, info)
        straight = largest_distortion(small.intrinsics, small.distortion, info.height, info.width) <= _LENS_MATTERS
        camera = small.without_distortion()
        seen = pinhole(camera, info.height, info.width)
        ready.append(Clip(name, clip, frames, info, seen, None if straight else small, camera))
    rates = [clip.info.fps for clip in ready]
    if max(rates) > _SAME_RATE * min(rates):
        words = ", ".join(f"{clip.name} {clip.info.fps:.4g}" for clip in ready)
        raise TwofoldError(f"The videos have different frame rates ({words}); give one that all reach with --fps.")
    frames = min(clip.info.frames for clip in ready)
    if beyond := [time for time in config.drop if not 0 <= time < frames]:
        raise TwofoldError(
            f"--drop names frame {beyond[0]}, and {ready[0].path.name} has {frames}, counted from 0; correct the list."
        )
    return ready


def rate_of(seconds: Float[np.ndarray, "t"], fps: float) -> float:
    """Frames per second: `fps` if their times agree with it, else what these are on average.

    >>> rate_of(np.array([0.0, 0.1, 0.2]), 10.0), rate_of(np.array([0.0, 0.1, 0.4]), 10.0)
    (10.0, 5.0)
    """
    if len(seconds) < 2 or seconds[-1] <= seconds[0]:
        return fps
    measured = float((len(seconds) - 1) / (seconds[-1] - seconds[0]))
    return fps if 1 / _SAME_RATE <= measured / fps <= _SAME_RATE else measured


def are_uneven(seconds: Float[np.ndarray, "t"]) -> bool:
    """Whether the longest gap between frames exceeds the shortest by more than half the usual one.

    >>> are_uneven(np.array([0.0, 0.1, 0.2])), are_uneven(np.array([0.0, 0.1, 0.4]))
    (False, True)
    """
    gaps = np.diff(seconds)
    return len(gaps) > 1 and bool(np.ptp(gaps) > 0.5 * np.median(gaps))


def _stem(clip: Path) -> str:
    return clip.stem if clip.is_file() else clip.name


def clip_names(clips: Sequence[Path]) -> list[str]:
    """Cameras' names out of the clips': letters, digits, '_', '-' and '.' only."""
    kept = ["".join(c if c.isascii() and (c.isalnum() or c in "_-.") else "_" for c in _stem(clip)) for clip in clips]
    return [name.lstrip("-.") or "cam" for name in kept]


def _guessed(info: ClipInfo, config: PrepareConfig) -> Camera:
    """A camera at the world's origin.

    Raises:
        TwofoldError: the lens that was given belongs to no image of this size.
    """
    across, down = info.width / info.full_width, info.height / info.full_height
    if config.intrinsics is None:
        fx = fy = (info.focal or FOCAL_GUESS) * max(info.width, info.height)
        cx, cy = (info.width - 1) / 2, (info.height - 1) / 2
    else:
        fx, fy, cx, cy = config.intrinsics
        faults = intrinsics_faults(np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]]), info.full_width)
        meant = size_of_principal_point(cx, cy, info.full_height, info.full_width)
        # Of cropped images the middle is elsewhere, but in no such proportion.
        if meant is not None and 0.9 < (meant[0] / info.full_height) / (meant[1] / info.full_width) < 1.1:
            faults.append(
                f"their principal point is the middle of images of about {meant[1]}x{meant[0]}, and the video has "
                f"{info.full_width}x{info.full_height}; scale all four to the video's size."
            )
        if faults:
            raise TwofoldError(f"--intrinsics {fx:g},{fy:g},{cx:g},{cy:g} do not go with the video: {faults[0]}")
        fx, fy, cx, cy = fx * across, fy * down, (cx + 0.5) * across - 0.5, (cy + 0.5) * down - 0.5
    return Camera(torch.eye(4), torch.tensor([[fx, 0, cx], [0, fy, cy], [0, 0, 1]]), info.height, info.width)


def _smaller(lens: CalibratedCamera, info: ClipInfo) -> CalibratedCamera:
    """The lens as it is in the smaller images; distortion does not change with the size."""
    scale = np.array([info.width / info.full_width, info.height / info.full_height])
    intrinsics = lens.intrinsics.copy()
    intrinsics[:2] *= scale[:, None]
    intrinsics[:2, 2] += 0.5 * (scale - 1)
    return replace(lens, intrinsics=intrinsics, height=info.height, width=info.width)


def focal_in_words(clip: Clip, config: PrepareConfig, camera: Camera) -> str:
    """Where the focal length of the one camera comes from, a sentence; empty for calibrated cameras.

    Args:
        clip: with the camera as it was at first.
        config: what was given.
        camera: as it was found.
    """
    focal, longest = float(camera.intrinsics[0, 0]), max(clip.info.width, clip.info.height)
    size = f"{focal:.0f} pixels of images of {clip.info.width} x {clip.info.height}"
    if config.calibration is not None:
        return ""
    if config.intrinsics is not None:
        return f"The focal length is {size}, as given."
    if clip.info.focal is not None:
        stated = f"{clip.info.focal * FULL_FRAME:.0f} mm of a full-frame camera"
        return f"The focal length is {size}; the file states {stated}, {clip.info.focal * longest:.0f} pixels."
    return (
        f"The focal length was estimated as {size}, from a guess of {FOCAL_GUESS * longest:.0f}; distances are as "
        "uncertain as it is, so give --intrinsics where they are known."
    )


def longer(camera: Camera, factor: float) -> Camera:
    """The camera with another focal length."""
    intrinsics = camera.intrinsics.clone()
    intrinsics[0, 0], intrinsics[1, 1] = intrinsics[0, 0] * factor, intrinsics[1, 1] * factor
    return Camera(camera.world_to_camera, intrinsics, camera.height, camera.width)
