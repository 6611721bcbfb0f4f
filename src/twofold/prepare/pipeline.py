"""From raw clips to a capture folder: look at every picture, fit a body, judge the fit, write what is good."""

import tempfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from twofold.body.anny import anny_body
from twofold.body.skeleton import Body
from twofold.body.smpl import read_smpl
from twofold.capture.folder import CaptureWriter
from twofold.errors import TwofoldError
from twofold.files import plain_errors
from twofold.geometry.cameras import Camera
from twofold.prepare.cameras.calibration import pinhole, undistort, undistorter
from twofold.prepare.cameras.triangulation import triangulate, turn_cameras
from twofold.prepare.detect.landmark_files import landmarks_from_file, track_at
from twofold.prepare.detect.left_right import repair_swaps, repair_with_views
from twofold.prepare.detect.mask_files import masks_from_folder
from twofold.prepare.detect.people import People
from twofold.prepare.detect.scan import Watched, watch_clip
from twofold.prepare.detections import Estimator, Track
from twofold.prepare.fitting.fit import fit
from twofold.prepare.fitting.observations import Evidence
from twofold.prepare.fitting.parameters import Motion, choose, pose_motion
from twofold.prepare.fitting.pose_files import poses_from_file
from twofold.prepare.fitting.world_up import stand_upright, up_direction
from twofold.prepare.output.acceptance import (
    FARTHER,
    LARGER,
    STEADIER,
    PictureQuality,
    kept_times,
    require_length,
    require_person,
    require_whole,
    warnings_about,
    yaw_range,
)
from twofold.prepare.output.review import Agreement, compare_with_pictures
from twofold.prepare.video.clips import Clip, PrepareConfig, advice, longer, open_clips, require_options

Show = Callable[[float, str], None]


@dataclass(frozen=True)
class Prepared:
    """What came of it.

    Attributes:
        folder: the capture.
        kept: moments in the splits.
        qualities: a record of every picture.
        warnings: sentences for the user.
    """

    folder: Path
    kept: tuple[int, ...]
    qualities: tuple[PictureQuality, ...]
    warnings: tuple[str, ...]

    def summary(self) -> str:
        """What came of it in a few words."""
        moments = len({quality.time for quality in self.qualities})
        return (
            f"{len(self.kept)} of {moments} moments, silhouette IoU {self.mean('iou'):.2f}, landmarks off by "
            f"{self.mean('reprojection'):.1f} pixels ({self.mean('reprojection_percent'):.1f} % of the body's height)."
        )

    def mean(self, what: Literal["iou", "reprojection", "reprojection_percent"]) -> float:
        """Over the pictures of the moments that are kept."""
        kept = set(self.kept)
        return float(np.mean([getattr(q, what) for q in self.qualities if q.time in kept]))


def prepare(
    clips: Sequence[Path],
    out: Path,
    body: Body,
    estimator: Callable[[], Estimator],
    config: PrepareConfig | None = None,
    show: Show | None = None,
    people: Callable[[Sequence[UInt8[np.ndarray, "h w 3"]]], People] | None = None,
    overwrite: bool = False,
) -> Prepared:
    """Makes a capture folder from one clip, or from several of the same moments by calibrated cameras.

    Args:
        clips: videos or folders of pictures.
        out: the capture folder to make.
        body: to fit.
        estimator: makes a new estimator for each clip.
        config: options.
        show: told the share that is done and what is being done.
        people: counts who is in view; None to trust that it is one person.
        overwrite: a capture that lies at `out` gives way.

    Raises:
        TwofoldError: a clip cannot be read or cannot work, the calibration does not go with the clips, or `out` cannot
            be written; nothing is left behind then.
    """
    config, show = config or PrepareConfig(), show or (lambda done, what: None)
    require_options(clips, config)
    # The writer stands first, so that a place that cannot be written is known before any work.
    with (
        CaptureWriter(out, overwrite) as writer, plain_errors(out),
        tempfile.TemporaryDirectory(prefix=f".{out.name}-", dir=out.resolve().parent) as scratch,
    ):  # fmt: skip
        ready = open_clips(clips, config)
        watched = _watch_all(ready, Path(scratch), estimator, config, show)
        if people is not None and config.several_people == "refuse":
            for clip, seen in zip(ready, watched, strict=True):
                require_one_person(people(seen.sample), clip.path)
        found = _fit_all(ready, watched, body, config, show)
        agreed = _judge_all(found, body, config, show)
        prepared = _write(writer, out, found, agreed, body, config)
    show(1.0, "done")
    return prepared


def read_body(which: str) -> Body:
    """The free body for "anny", else the user's own SMPL file.

    Raises:
        TwofoldError: the body cannot be read.
    """
    return anny_body() if which == "anny" else read_smpl(which)


def require_one_person(people: People, clip: Path) -> None:
    """Refuses clips of several people.

    Raises:
        TwofoldError: a second person of comparable size is in view for a good part of the clip.
    """
    if people.too_many:
        raise TwofoldError(
            f"{clip} shows several people of about the same size in {100 * people.several:.0f} % of its pictures, and "
            "which of them is meant nobody can tell; cut the clip to one person, or take --several-people ignore."
        )


def _watch_all(
    ready: Sequence[Clip], scratch: Path, estimator: Callable[[], Estimator], config: PrepareConfig, show: Show
) -> list[Watched]:
    watched: list[Watched] = []
    for k, clip in enumerate(ready):
        own = None if config.masks is None else masks_from_folder(_piece(config.masks, clip, len(ready)), clip.info)
        straighten = None if clip.lens is None else undistorter(clip.lens, clip.info.height, clip.info.width)
        finder = estimator()
        try:
            seen = watch_clip(
                clip.frames, clip.info.frames, finder, scratch / clip.name, straighten, own,
                lambda done, k=k: show(0.3 * (k + done) / len(ready), "looking at the pictures"),
            )  # fmt: skip
        finally:
            finder.close()
        require_length(len(seen.images), str(clip.path))
        if config.landmarks is None:
            require_person(seen.track, str(clip.path))
        watched.append(seen)
    moments = min(len(seen.images) for seen in watched)
    # Synchronised clips end a picture or two apart.
    return [_cut(seen, moments) for seen in watched]


def _cut(seen: Watched, moments: int) -> Watched:
    track = replace(seen.track, **{name: value[:moments] for name, value in vars(seen.track).items()})
    return replace(
        seen, images=seen.images[:moments], masks=seen.masks[:moments], sources=seen.sources[:moments], track=track
    )


@dataclass(frozen=True)
class _Found:
    """The fit: a motion in a world of its own, its cameras, and what they saw with the sides put right."""

    motion: Motion
    cameras: dict[str, Camera]
    watched: list[Watched]
    fps: float
    swapped: dict[str, list[int]]
    calibrated: bool
    remarks: list[str]


def _fit_all(
    ready: Sequence[Clip], watched: Sequence[Watched], body: Body, config: PrepareConfig, show: Show
) -> _Found:
    fps = ready[0].info.fps
    seconds = np.arange(len(watched[0].images)) / fps
    tracks = [seen.track for seen in watched]
    calibrated = [clip.calibrated for clip in ready if clip.calibrated is not None]
    cameras = [clip.camera for clip in ready]
    in_space: Float[np.ndarray, "t 33 3"] | None = None
    own = [_own_landmarks(clip, seen, config, len(ready)) for clip, seen in zip(ready, watched, strict=True)]
    show(0.3, "telling left from right")
    if len(tracks) > 1:
        repairs = repair_with_views(tracks, calibrated, seconds)
        tracks = [o or repair.track for o, repair in zip(own, repairs, strict=True)]
        calibrated = turn_cameras(calibrated, tracks)
        cameras = [pinhole(c, clip.info.height, clip.info.width) for c, clip in zip(calibrated, ready, strict=True)]
        in_space = triangulate(calibrated, tracks).points.astype(np.float32)
    else:
        repairs = [repair_swaps(tracks[0], seconds)]
        tracks = [own[0] or repairs[0].track]
    evidence = [
        Evidence(camera, track, seen.masks) for camera, track, seen in zip(cameras, tracks, watched, strict=True)
    ]
    free = config.intrinsics is None and config.calibration is None
    if config.poses is not None:
        motion = poses_from_file(config.poses, ready[0].info, watched[0].sources, body)
    else:
        motion = fit(
            body, evidence, fps, free, points_in_space=in_space,
            watch=lambda done: show(0.3 + 0.4 * done, "fitting the body"),
        ).settled(body)  # fmt: skip
    scaled = [longer(camera, float(motion.log_focal.exp())) for camera in cameras]
    swapped = {c.name: np.flatnonzero(r.swapped).tolist() for c, r in zip(ready, repairs, strict=True)}
    motion = replace(motion, log_focal=torch.zeros(()))
    watched = [replace(seen, track=track) for seen, track in zip(watched, tracks, strict=True)]
    cameras = {clip.name: camera for clip, camera in zip(ready, scaled, strict=True)}
    remarks = [f"{clip.name}: {remark}" for clip in ready for remark in clip.frames.remarks]
    return _Found(motion, cameras, watched, fps, swapped, config.calibration is not None, remarks)


def _piece(place: Path, clip: Clip, clips: int) -> Path:
    """Where the user's own pieces of a clip lie: at the place itself, or there under the clip's name."""
    if clips == 1:
        return place
    found = sorted(p for p in place.iterdir() if p.stem == clip.path.stem) if place.is_dir() else []
    if not found:
        raise TwofoldError(f"{place} has nothing called {clip.path.stem}; with several videos, name each after its.")
    return found[0]


def _own_landmarks(clip: Clip, seen: Watched, config: PrepareConfig, clips: int) -> Track | None:
    """The user's own landmarks; how they lie in space is left to the estimator."""
    if config.landmarks is None:
        return None
    track = landmarks_from_file(_piece(config.landmarks, clip, clips), clip.info)
    track = track_at(track, seen.sources)
    require_person(track, str(config.landmarks), advice(config, LARGER, ("landmarks",)))
    pixels = track.pixels
    if clip.lens is not None:
        pixels = undistort(clip.lens, pixels.astype(np.float64)).astype(np.float32)
    return replace(track, pixels=pixels, world=np.where(np.isfinite(track.world), track.world, seen.track.world))


def _judge_all(found: _Found, body: Body, config: PrepareConfig, show: Show) -> list[Agreement]:
    agreed: list[Agreement] = []
    count = len(found.cameras)
    for k, (name, camera) in enumerate(found.cameras.items()):
        standing = _standing(found.motion, body, camera)
        agreement = compare_with_pictures(
            name, camera, found.watched[k], body, found.motion, standing, config.held_objects, count == 1,
            lambda done, k=k: show(0.7 + 0.28 * (k + done) / count, "judging the fit"),
        )  # fmt: skip
        require_whole(agreement.qualities, name, advice(config, FARTHER, ("landmarks",)))
        agreed.append(agreement)
    return agreed


def _standing(motion: Motion, body: Body, camera: Camera) -> float:
    """How tall the person would stand in the picture at its usual distance, pixels."""
    vertices = pose_motion(body, motion).vertices
    height = float(vertices[:, 1].max() - vertices[:, 1].min())
    root = motion.translation @ camera.world_to_camera[:3, :3].T + camera.world_to_camera[:3, 3]
    return height * float(camera.intrinsics[1, 1]) / max(float(root[:, 2].median()), 0.1)


def _write(
    writer: CaptureWriter,
    out: Path,
    found: _Found,
    agreed: Sequence[Agreement],
    body: Body,
    config: PrepareConfig,
) -> Prepared:
    watched = found.watched
    qualities = [quality for agreement in agreed for quality in agreement.qualities]
    kept = kept_times(qualities, ", ".join(found.cameras), advice(config, STEADIER))
    poses, translations, cameras = _upright(found, body)
    train = _training_camera(list(cameras), config.train_camera)
    held_out = [time for number, time in enumerate(kept) if number % config.held_out == config.held_out // 2]
    trained = [time for time in kept if time not in set(held_out)]
    for name, seen, agreement in zip(cameras, watched, agreed, strict=True):
        for time in kept:
            writer.image_file(name, time, seen.images[time])
            writer.mask_file(name, time, seen.masks[time])
            if time in agreement.ignored:
                writer.ignored_file(name, time, agreement.ignored[time])
    index = list(cameras).index(train)
    dropped = sorted(set(range(len(poses))) - set(kept))
    yaw = yaw_range(poses[trained], cameras[train])
    moved, width = watched[index].moved, cameras[train].width
    warnings = [*found.remarks, *warnings_about(yaw, moved, width, dropped, len(cameras) > 1)]
    writer.finish(
        name=out.name,
        body=body,
        betas=found.motion.betas,
        poses=poses,
        translations=translations,
        cameras=cameras,
        splits={
            "train": {train: trained},
            "novel_view": {name: trained for name in cameras if name != train},
            "novel_pose": dict.fromkeys(cameras, held_out),
        },
        fps=found.fps,
        credit=config.credit,
        notes={
            "made_by": "twofold prepare",
            "clips": list(cameras),
            "every_held_out": config.held_out,
            "left_out": dropped,
            "sides_exchanged": found.swapped,
            "clip_picture": {name: list(seen.sources) for name, seen in zip(cameras, watched, strict=True)},
            "objects_ignored": {n: sorted(a.ignored) for n, a in zip(cameras, agreed, strict=True)},
            "yaw_degrees": round(yaw, 1),
            "background_moves_pixels": round(moved, 1),
            "warnings": warnings,
            "quality": [quality.row() for quality in qualities],
        },
    )
    return Prepared(out, tuple(kept), tuple(qualities), tuple(warnings))


def _upright(found: _Found, body: Body) -> tuple[Tensor, Tensor, Mapping[str, Camera]]:
    motion = found.motion
    poses, betas = motion.full_pose(), motion.betas
    up = up_direction(poses, found.calibrated)
    posed = pose_motion(body, motion)
    some = posed.place(choose(body, torch.arange(0, len(body.template), 7)))
    lowest = float(torch.quantile((some @ up).amin(1), 0.1))
    root = body.joints[0] + body.joint_basis[0, :, : len(betas)] @ betas
    return stand_upright(up, root, lowest, poses, motion.translation, found.cameras)


def _training_camera(names: Sequence[str], wanted: str | None) -> str:
    if wanted is None:
        return names[0]
    if wanted not in names:
        raise TwofoldError(f"--train-camera {wanted} is none of the clips; they are {', '.join(names)}.")
    return wanted
