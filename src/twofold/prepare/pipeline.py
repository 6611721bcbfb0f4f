"""From raw clips to a capture folder: look at every image, fit a body, judge the fit, write what is good."""

import tempfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path

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
from twofold.geometry.rotations import axis_angle_to_matrix
from twofold.prepare.cameras.calibration import pinhole, undistorter
from twofold.prepare.cameras.triangulation import triangulate, turn_cameras
from twofold.prepare.detect.left_right import repair_swaps, repair_with_views
from twofold.prepare.detect.mask_refinement import refine_clip
from twofold.prepare.detect.people import People, people_finder
from twofold.prepare.detect.scan import Watched, save_picture, watch_clip, with_masks
from twofold.prepare.detections import Estimator, Track
from twofold.prepare.fitting.fit import fit, stated_focal
from twofold.prepare.fitting.observations import Evidence
from twofold.prepare.fitting.parameters import FittedMotion, choose, pose_motion, root_of
from twofold.prepare.fitting.physics import up_of
from twofold.prepare.fitting.pose_files import motion_at
from twofold.prepare.fitting.world_up import stand_upright, up_direction
from twofold.prepare.given import Finder, Given, chosen_landmarks, chosen_masks, own_lens, read_given, region_finder
from twofold.prepare.output.acceptance import (
    FARTHER,
    STEADIER,
    kept_times,
    require_length,
    require_person,
    require_whole,
    warnings_about,
)
from twofold.prepare.output.prepared import Prepared
from twofold.prepare.output.review import Agreement, compare_with_pictures
from twofold.prepare.standing import standing_facts, standing_faults
from twofold.prepare.turning import arc, camera_directions
from twofold.prepare.video.clips import (
    Clip,
    PrepareConfig,
    advice,
    are_uneven,
    focal_in_words,
    longer,
    open_clips,
    rate_of,
    require_options,
)

Progress = Callable[[float, str], None]


def prepare(
    clips: Sequence[Path],
    out: Path,
    body: Body,
    estimator: Callable[[], Estimator],
    config: PrepareConfig | None = None,
    progress: Progress | None = None,
    people: Callable[[Sequence[UInt8[np.ndarray, "h w 3"]]], People] | None = None,
    overwrite: bool = False,
    finder: Finder = people_finder,
) -> Prepared:
    """Makes a capture folder from one clip, or from several synchronised ones by calibrated cameras.

    Args:
        clips: videos or folders of images.
        out: the capture folder to make.
        body: to fit.
        estimator: makes a new estimator for each clip.
        config: options.
        progress: called with the fraction that is done and what is being done.
        people: counts who is in view; None to trust that it is one person.
        overwrite: a capture that lies at `out` is overwritten.
        finder: finds everybody in an image, where one of several people is chosen.

    Raises:
        TwofoldError: a clip cannot be read or cannot work, the calibration does not go with the clips, or `out` cannot
            be written; nothing is left behind then.
    """
    config, progress = config or PrepareConfig(), progress or (lambda done, what: None)
    require_options(clips, config)
    # The writer stands first, so that a place that cannot be written is known before any work.
    with (
        CaptureWriter(out, overwrite) as writer, plain_errors(out),
        tempfile.TemporaryDirectory(prefix=f".{out.name}-", dir=out.resolve().parent) as scratch,
    ):  # fmt: skip
        config = own_lens(clips, config, body)
        ready = open_clips(clips, config)
        given = read_given(ready, config, body)
        watched, remarks = _watch_all(ready, given, Path(scratch), estimator, finder, body, config, progress)
        remarks += [remark for piece in given for remark in piece.remarks]
        without = [time for time, source in enumerate(watched[0].sources) if source in set(given[0].absent)]
        config = replace(config, drop=tuple(sorted({*config.drop, *without})))
        chosen = any(piece is not None for piece in (config.person, config.masks, config.landmarks, config.poses))
        if people is not None and config.several_people == "refuse" and not chosen:
            for clip, seen in zip(ready, watched, strict=True):
                require_one_person(people(seen.sample), clip.path)
        found = _fit_all(ready, given, watched, body, config, progress, remarks)
        agreed = _judge_all(found, body, config, progress)
        prepared = _write(writer, out, found, agreed, body, config)
    progress(1.0, "done")
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
            f"{clip} shows several people of about the same size in {100 * people.several:.0f} % of its images, and "
            "which of them is meant nobody can tell; take --person largest, --person 1 (the leftmost in the first "
            "image, 2 the next), or your own --masks, or cut the clip to one person."
        )


def _watch_all(
    ready: Sequence[Clip],
    given: Sequence[Given],
    scratch: Path,
    estimator: Callable[[], Estimator],
    finder: Finder,
    body: Body,
    config: PrepareConfig,
    progress: Progress,
) -> tuple[list[Watched], list[str]]:
    """What is seen in each clip at the steps of time that all show, and sentences for the user."""
    watched: list[Watched] = []
    remarks: list[str] = []
    for k, (clip, own) in enumerate(zip(ready, given, strict=True)):
        undistort = None if clip.lens is None else undistorter(clip.lens, clip.info.height, clip.info.width)
        found = estimator()
        try:
            with region_finder(own, clip, body, config, finder) as region:
                seen = watch_clip(
                    clip.frames, clip.info.frames, found, scratch / clip.name, undistort,
                    [] if own.masks is None else own.masks.readings(),
                    lambda done, k=k: progress((0.25 * done + 0.3 * k) / len(ready), "looking at the images"), region,
                )  # fmt: skip
        finally:
            found.close()
        if own.masks is not None and own.masks.others:
            masks, sentence = chosen_masks(own.masks, seen.overlaps)
            seen = with_masks(seen, masks, undistort)
            remarks.append(sentence)
        remarks += [f"{clip.name}: {remark}" for remark in clip.frames.remarks]
        if seen.repeated:
            remarks.append(f"{clip.name}: {seen.repeated} images equal the one before them and are left out.")
        if config.refine_masks == "auto" and own.masks is None and seen.moved == 0:
            changed = refine_clip(
                seen.images, seen.masks, partial(save_picture, compress_level=1),
                lambda done, k=k: progress((0.25 + 0.05 * done + 0.3 * k) / len(ready), "refining the masks"),
            )  # fmt: skip
            seen = replace(seen, refined=changed)
        require_length(len(seen.images), str(clip.path))
        if config.landmarks is None:
            require_person(seen.track, str(clip.path))
        watched.append(seen)
    if len(watched) == 1:
        return watched, remarks
    # Synchronised clips end an image or two apart, and may lack one in between.
    shared = set[int].intersection(*(set(seen.steps) for seen in watched))
    together = [seen.at([i for i, step in enumerate(seen.steps) if step in shared]) for seen in watched]
    require_length(len(shared), "What all videos show at the same time")
    return together, remarks


@dataclass(frozen=True)
class _Found:
    """The fit: a motion in a world of its own, its cameras, and what they saw with the sides put right."""

    motion: FittedMotion
    cameras: dict[str, Camera]
    watched: list[Watched]
    fps: float
    swapped: dict[str, list[int]]
    calibrated: bool
    remarks: list[str]
    focal: str


def _fit_all(
    ready: Sequence[Clip],
    given: Sequence[Given],
    watched: Sequence[Watched],
    body: Body,
    config: PrepareConfig,
    progress: Progress,
    remarks: list[str],
) -> _Found:
    seconds = np.array(watched[0].seconds)
    fps = rate_of(seconds, ready[0].info.fps)
    tracks = [seen.track for seen in watched]
    calibrated = [clip.calibrated for clip in ready if clip.calibrated is not None]
    cameras = [clip.camera for clip in ready]
    in_space: Float[np.ndarray, "t 33 3"] | None = None
    own: list[Track | None] = [None] * len(ready)
    for k, (piece, seen) in enumerate(zip(given, watched, strict=True)):
        if piece.landmarks and config.landmarks is not None:
            own[k], sentence = chosen_landmarks(piece, seen.track, seen.sources, config.landmarks)
            remarks += [sentence] if sentence else []
    progress(0.3, "telling left from right")
    if len(tracks) > 1:
        repairs = repair_with_views(tracks, calibrated, seconds)
        tracks = [o or repair.track for o, repair in zip(own, repairs, strict=True)]
        calibrated = turn_cameras(calibrated, tracks)
        cameras = [pinhole(c, clip.info.height, clip.info.width) for c, clip in zip(calibrated, ready, strict=True)]
        in_space = triangulate(calibrated, tracks).points.astype(np.float32)
    else:
        repairs = [repair_swaps(tracks[0], seconds)]
        tracks = [own[0] or repairs[0].track]
    # Landmarks of the user's own are off by something else.
    offsets = [None if one is not None else seen.offsets for one, seen in zip(own, watched, strict=True)]
    times = seconds if are_uneven(seconds) else None
    evidence = [
        Evidence(*parts, times) for parts in zip(cameras, tracks, [s.masks for s in watched], offsets, strict=True)
    ]
    free = config.intrinsics is None and config.calibration is None
    if given[0].motion is not None:
        motion = motion_at(given[0].motion, watched[0].sources)
    else:
        # The file's own word on the focal length is worth more than a guess.
        stated = {"config": stated_focal()} if free and ready[0].info.focal is not None else {}
        motion = fit(
            body, evidence, fps, free, points_in_space=in_space, **stated,
            progress=lambda done: progress(0.3 + 0.4 * done, "fitting the body"),
        ).settled(body)  # fmt: skip
    scaled = [longer(camera, float(motion.log_focal.exp())) for camera in cameras]
    swapped = {c.name: np.flatnonzero(r.swapped).tolist() for c, r in zip(ready, repairs, strict=True)}
    motion = replace(motion, log_focal=torch.zeros(()))
    watched = [replace(seen, track=track) for seen, track in zip(watched, tracks, strict=True)]
    cameras = {clip.name: camera for clip, camera in zip(ready, scaled, strict=True)}
    focal = focal_in_words(ready[0], config, scaled[0])
    return _Found(motion, cameras, watched, fps, swapped, config.calibration is not None, remarks, focal)


def _judge_all(found: _Found, body: Body, config: PrepareConfig, progress: Progress) -> list[Agreement]:
    agreed: list[Agreement] = []
    count = len(found.cameras)
    for k, (name, camera) in enumerate(found.cameras.items()):
        standing = _standing(found.motion, body, camera)
        agreement = compare_with_pictures(
            name, camera, found.watched[k], body, found.motion, standing, config.held_objects, count == 1,
            lambda done, k=k: progress(0.7 + 0.28 * (k + done) / count, "judging the fit"),
        )  # fmt: skip
        require_whole(agreement.qualities, name, advice(config, FARTHER, ("landmarks",)))
        agreed.append(agreement)
    return agreed


def _standing(motion: FittedMotion, body: Body, camera: Camera) -> float:
    """How tall the person would stand in the image at its usual distance, pixels."""
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
    watched, seconds = found.watched, np.array(found.watched[0].seconds)
    qualities = [quality for agreement in agreed for quality in agreement.qualities]
    kept, left_out = kept_times(qualities, ", ".join(found.cameras), advice(config, STEADIER), config.drop)
    poses, translations, cameras = _upright(found, body)
    train = config.train_camera or next(iter(cameras))
    held_out = [time for number, time in enumerate(kept) if number % config.held_out == config.held_out // 2]
    trained = [time for time in kept if time not in set(held_out)]
    for name, seen, agreement in zip(cameras, watched, agreed, strict=True):
        for time in kept:
            writer.image_file(name, time, seen.images[time])
            writer.mask_file(name, time, seen.masks[time])
            if time in agreement.ignored:
                writer.ignored_file(name, time, agreement.ignored[time])
    index = list(cameras).index(train)
    pelvises = translations[trained] + root_of(body, found.motion.betas)
    roots, center = axis_angle_to_matrix(poses[trained, 0]), cameras[train].center
    yaw = arc(camera_directions(roots, pelvises, center.expand(len(roots), 3))[0])
    moved, width = watched[index].moved, cameras[train].width
    joints = body.joints + body.joint_basis[..., : len(found.motion.betas)] @ found.motion.betas
    standing = standing_facts(poses, translations, joints, seconds, kept)
    warnings = [*found.remarks, *warnings_about(yaw, moved, width, left_out, len(cameras) > 1)]
    warnings += [f"{fault.what}. {fault.advice}" for fault in standing_faults(standing)]
    objects = {name: a.removed for name, a in zip(cameras, agreed, strict=True)}
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
        seconds=torch.from_numpy(seconds) if are_uneven(seconds) else None,
        credit=config.credit,
        notes={
            "made_by": "twofold prepare",
            "clips": list(cameras),
            "every_held_out": config.held_out,
            "left_out": sorted(left_out),
            "left_out_because": {str(time): left_out[time] for time in sorted(left_out)},
            "sides_exchanged": found.swapped,
            "clip_picture": {name: list(seen.sources) for name, seen in zip(cameras, watched, strict=True)},
            "objects_ignored": {n: sorted(a.ignored) for n, a in zip(cameras, agreed, strict=True)},
            "objects_share_of_mask": {n: {str(t): round(s, 4) for t, s in r.items()} for n, r in objects.items()},
            "masks_refined_share": {
                n: s.refined for n, s in zip(cameras, watched, strict=True) if s.refined is not None
            },
            "seconds": [round(second, 4) for second in watched[0].seconds],
            "yaw_degrees": round(yaw, 1),
            "background_moves_pixels": None if moved is None else round(moved, 1),
            "standing": asdict(standing),
            "warnings": warnings,
            "quality": [quality.row() for quality in qualities],
        },
    )
    shares = [share for removed in objects.values() for time, share in removed.items() if time in set(kept)]
    refined = tuple(seen.refined for seen in watched if seen.refined is not None)
    return Prepared(out, tuple(kept), tuple(qualities), tuple(warnings), standing, tuple(shares), refined, found.focal)


def _upright(found: _Found, body: Body) -> tuple[Tensor, Tensor, Mapping[str, Camera]]:
    motion = found.motion
    poses, betas = motion.full_pose(), motion.betas
    # Where one camera's clip tells the vertical, the fit has found it.
    up = up_of(motion.slope) if bool(motion.slope.any()) else up_direction(poses, found.calibrated)
    posed = pose_motion(body, motion)
    some = posed.place(choose(body, torch.arange(0, len(body.template), 7)))
    lowest = float(torch.quantile((some @ up).amin(1), 0.1))
    root = root_of(body, betas)
    return stand_upright(up, root, lowest, poses, motion.translation, found.cameras)
