"""Everything of the user's own that takes the place of an estimator: read and checked before any work is done."""

from collections.abc import Callable, Generator, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Float, UInt8

from twofold.body.skeleton import Body
from twofold.errors import TwofoldError
from twofold.geometry.cameras import project
from twofold.prepare.cameras.calibration import undistort
from twofold.prepare.detect.landmark_files import landmark_readings, track_at
from twofold.prepare.detect.mask_files import GivenMasks, masks_from_folder
from twofold.prepare.detect.people import Person
from twofold.prepare.detect.person import JOINT_LINES, Region, around_landmarks, around_lines, following
from twofold.prepare.detections import Track
from twofold.prepare.estimators.estimates import PoseOptions
from twofold.prepare.fitting.parameters import FittedMotion, place_joints, pose_motion
from twofold.prepare.fitting.pose_files import OwnPoses, poses_from_file, with_lens
from twofold.prepare.output.acceptance import LARGER, require_person
from twofold.prepare.video.clips import Clip, PrepareConfig, advice
from twofold.prepare.video.frames import describe
from twofold.prepare.video.numbering import best_reading

Find = Callable[[UInt8[np.ndarray, "h w 3"]], list[Person]]
Finder = Callable[[], AbstractContextManager[Find]]


@dataclass(frozen=True)
class Given:
    """What the user has for one clip.

    Attributes:
        masks: their own masks.
        landmarks: their own landmarks of every image of the clip, in words and pixels of undistorted images, for each
            way to read their numbers; the likeliest first.
        motion: their own poses, of every image of the clip.
        absent: images without such a pose.
        remarks: sentences about the poses.
    """

    masks: GivenMasks | None = None
    landmarks: tuple[tuple[str, Track], ...] = ()
    motion: FittedMotion | None = None
    absent: tuple[int, ...] = ()
    remarks: tuple[str, ...] = ()


def own_lens(clips: Sequence[Path], config: PrepareConfig, body: Body) -> PrepareConfig:
    """The configuration with the lens that the user's own poses were estimated with, where no other was given.

    Raises:
        TwofoldError: the poses are damaged or do not go with the clip.
    """
    if config.poses is None or config.intrinsics is not None or config.calibration is not None or len(clips) > 1:
        return config
    info = describe(clips[0], config.fps, config.max_size)
    lens = poses_from_file(config.poses, info, body, PoseOptions(config.track, config.smplx)).lens
    return config if lens is None else replace(config, intrinsics=lens(info.full_width, info.full_height))


def read_given(ready: Sequence[Clip], config: PrepareConfig, body: Body) -> list[Given]:
    """Reads all that the configuration names.

    Raises:
        TwofoldError: a piece is missing or damaged, or does not go with its clip.
    """
    found: list[Given] = []
    for clip in ready:
        masks = landmarks = None
        if config.masks is not None:
            masks = masks_from_folder(_piece(config.masks, clip, len(ready)), clip.info)
        if config.landmarks is not None:
            place = _piece(config.landmarks, clip, len(ready))
            landmarks = [(words, _undistorted(track, clip)) for words, track in landmark_readings(place, clip.info)]
            require_person(landmarks[0][1], str(config.landmarks), advice(config, LARGER, ("landmarks",)))
        poses = None if config.poses is None else _poses(config.poses, ready, config, body)
        if poses is None:
            found.append(Given(masks, tuple(landmarks or ())))
        else:
            said = poses.remarks if clip is ready[0] else ()
            found.append(Given(masks, tuple(landmarks or ()), poses.motion, poses.absent, said))
    return found


def _poses(path: Path, ready: Sequence[Clip], config: PrepareConfig, body: Body) -> OwnPoses:
    """The user's own poses, for the camera that is taken."""
    own = poses_from_file(path, ready[0].info, body, PoseOptions(config.track, config.smplx))
    if own.lens is None or len(ready) > 1:
        return own
    return with_lens(own, ready[0].camera, own.lens, ready[0].info, body)


def _piece(place: Path, clip: Clip, clips: int) -> Path:
    """Where the user's own pieces of a clip lie: at the place itself, or there under the clip's name."""
    if clips == 1:
        return place
    found = sorted(p for p in place.iterdir() if p.stem == clip.path.stem) if place.is_dir() else []
    if not found:
        raise TwofoldError(f"{place} has nothing called {clip.path.stem}; with several videos, name each after its.")
    return found[0]


def _undistorted(track: Track, clip: Clip) -> Track:
    if clip.lens is None:
        return track
    return replace(track, pixels=undistort(clip.lens, track.pixels.astype(np.float64)).astype(np.float32))


@contextmanager
def region_finder(
    given: Given, clip: Clip, body: Body, config: PrepareConfig, finder: Finder
) -> Generator[Callable[[UInt8[np.ndarray, "h w 3"], int], Region | None] | None]:
    """Where the person that is meant is in each image (see `watch_clip`).

    It is told by the first of: --person, own masks (then None, as these are at hand there), own landmarks, own poses;
    None too where nothing tells.
    """
    choice = config.person
    with finder() if isinstance(choice, int) or choice == "largest" else nullcontext() as find:
        if find is not None and choice is not None and choice != "masks":
            follow = following(choice, find, str(clip.path))
            yield lambda image, source: follow(image)
        elif given.masks is not None:
            yield None
        elif given.landmarks:
            region = around_landmarks(given.landmarks[0][1], clip.info.height, clip.info.width)
            yield lambda image, source: region(source)
        elif given.motion is not None:
            yield _around_poses(given.motion, clip, body)
        else:
            yield None


def _around_poses(
    motion: FittedMotion, clip: Clip, body: Body
) -> Callable[[UInt8[np.ndarray, "h w 3"], int], Region | None]:
    pixels, depth = project(clip.camera, place_joints(pose_motion(body, motion), body, motion))
    shown: Float[np.ndarray, "t 24 2"] = np.where((depth > 0)[..., None].numpy(), pixels.numpy(), np.nan)

    def region(image: UInt8[np.ndarray, "h w 3"], source: int) -> Region | None:
        if source >= len(shown):
            return None
        return around_lines(shown[source].astype(np.float64), JOINT_LINES, *image.shape[:2])

    return region


def chosen_masks(masks: GivenMasks, overlaps: Sequence[Sequence[float]]) -> tuple[GivenMasks, str]:
    """The masks in the way of reading their numbers that agrees best with the estimator's masks, and a sentence.

    Args:
        masks: that fit the clip in several ways.
        overlaps: of each reading, the IoU with the estimator's mask of each image, NaN where one is missing.
    """
    readings = masks.readings()
    scores = [np.array(row, np.float64) for row in overlaps]
    best, certain = best_reading(scores)
    words = [f"{r.numbering.words} (IoU {_mean(s):.3f})" for r, s in zip(readings, scores, strict=True)]
    return readings[best], _sentence(f"The masks in {masks.folder}", words, best, certain, "the estimator's masks")


def chosen_landmarks(given: Given, seen: Track, sources: Sequence[int], place: Path) -> tuple[Track, str]:
    """The landmarks of some images, read in the way that agrees best with the estimator's, and a sentence about that.

    How they lie in space is left to the estimator.

    Args:
        given: with landmarks.
        seen: the estimator's.
        sources: `VideoFrame.source` of the images.
        place: where the landmarks come from, for the sentence.
    """
    tracks = [track_at(track, sources) for _, track in given.landmarks]
    best, sentence = 0, ""
    if len(tracks) > 1:
        scores = [_nearness(track, seen) for track in tracks]
        best, certain = best_reading(scores)
        words = [
            f"{words} (off by {-100 * _mean(score):.1f} % of the height)"
            for (words, _), score in zip(given.landmarks, scores, strict=True)
        ]
        sentence = _sentence(f"The landmarks in {place}", words, best, certain, "the estimator's landmarks")
    track = tracks[best]
    return replace(track, world=np.where(np.isfinite(track.world), track.world, seen.world)), sentence


def _nearness(track: Track, seen: Track) -> Float[np.ndarray, "t"]:
    """Minus the median distance of the landmarks in each image, in heights of the person; NaN where none can be."""
    away = np.linalg.norm(track.pixels.astype(np.float64) - seen.pixels, axis=-1)
    rows = seen.pixels[..., 1].astype(np.float64)
    known = np.isfinite(away)
    out = np.full(len(away), np.nan)
    for t in np.flatnonzero(known.any(1)):
        out[t] = -np.median(away[t][known[t]]) / max(float(np.nanmax(rows[t]) - np.nanmin(rows[t])), 1.0)
    return out


def _mean(scores: Float[np.ndarray, "t"]) -> float:
    return float(np.nanmean(scores)) if np.isfinite(scores).any() else float("nan")


def _sentence(what: str, words: Sequence[str], best: int, certain: bool, others: str) -> str:
    listed = ", ".join(w for place, w in enumerate(words) if place != best)
    if certain:
        return f"{what} fit the clip in {len(words)} ways; taken as {words[best]}, closer to {others} than {listed}."
    return (
        f"{what} fit the clip in {len(words)} ways that cannot be told apart by {others}; taken as {words[best]}, not "
        f"as {listed}. Number them as the clip's images are, from 0, to be sure."
    )
