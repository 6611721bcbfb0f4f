"""Is a capture worth training on? Everything that is measured to answer that, for `rules` to judge."""

import hashlib
import itertools
import re
from collections import defaultdict
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from twofold.body.skeleton import ShapedBody, shape_body
from twofold.capture.coverage import coverage_of
from twofold.capture.folder import capture_of
from twofold.capture.layout import Contents, read_contents, spans
from twofold.capture.types import Capture, Frame, spread
from twofold.capture.validate import mesh_faults, pixel_faults, quick_faults
from twofold.check.conventions import Diagnosis, best_shift, diagnose, poses_elsewhere, sample_of
from twofold.check.findings import counted
from twofold.check.frame_measures import FrameFacts, frame_facts, stature, surface_points
from twofold.check.image_measures import Background, background_of, sees_a_face, shows_its_back
from twofold.check.motion_measures import MotionFacts, motion_facts
from twofold.errors import TwofoldError
from twofold.geometry.cameras import project
from twofold.prepare.standing import StandingFacts, standing_facts

MAX_LOOKED_AT = 100
"""Images that are looked at unless more are asked for: a tenth of a second each."""
MAX_VALIDATED = 1000
"""Images of a longer capture that are opened to find damaged ones; training opens them all."""
SAMPLES, MOMENT_SAMPLES, BACKGROUNDS, BACKS, MAX_EXCHANGED = 12, 24, 24, 20, 40
"""Frames on which conventions and frames are tried, backgrounds of a camera and views from behind that are looked at,
bad frames whose pose is looked for elsewhere."""
POOR = 0.65
"""Mean IoU of a camera below which its body is not where its person is. Automatic fits of real people reach 0.82 to
0.87; a wrong pose in the right place still has 0.5 to 0.6."""


@dataclass(frozen=True)
class CameraFacts:
    """What one camera is, and how well its images agree with the body.

    Attributes:
        name: of the camera.
        images: that any split shows.
        looked_at: of these.
        iou: mean over these.
        view_angle: across the longer side, degrees.
        aspect: fy over fx.
        off_center: from the middle of the image to the principal point, as a share of the longer side.
        distance: of the body, median, metres.
    """

    name: str
    images: int
    looked_at: int
    iou: float
    view_angle: float
    aspect: float
    off_center: float
    distance: float


@dataclass(frozen=True)
class Doubt:
    """Cameras whose bodies would fit better in another way.

    Attributes:
        cameras: their names; all of a capture where all are alike.
        diagnosis: what would fix them.
    """

    cameras: tuple[str, ...]
    diagnosis: Diagnosis


@dataclass(frozen=True)
class Facts:
    """Everything that was measured in a capture.

    Attributes:
        name: its title.
        folder: where it lies.
        credit: whom to name.
        fps: frames per second.
        images: in all splits, by split.
        train_times: frames that train.
        stature: of the person, metres.
        frames: the images that were looked at.
        cameras: what they are.
        motion: what it shows.
        standing: how the body stands in the frames of the splits.
        backgrounds: by camera, of those that train.
        backs: views from behind in which a face was looked for.
        faces: those in which one was found.
        doubts: what would fit better.
        delay: by how many frames the motion is late, and what the IoU gains with it.
        elsewhere: camera and time of images that show the pose of another frame, and that frame.
        twins: test images whose bytes equal a training image's: split, camera, time.
        repeated: training frames whose image equals the one before.
        coverage: share of the body's surface that training images show well.
    """

    name: str
    folder: Path
    credit: str
    fps: float
    images: dict[str, int]
    train_times: frozenset[int]
    stature: float
    frames: tuple[FrameFacts, ...]
    cameras: tuple[CameraFacts, ...]
    motion: MotionFacts
    standing: StandingFacts
    backgrounds: dict[str, Background]
    backs: tuple[tuple[str, int], ...]
    faces: tuple[tuple[str, int], ...]
    doubts: tuple[Doubt, ...]
    delay: tuple[int, float]
    elsewhere: tuple[tuple[str, int, int], ...]
    twins: tuple[tuple[str, str, int], ...]
    repeated: tuple[int, ...]
    coverage: float


def measure_capture(
    folder: Path | str, most: int = MAX_LOOKED_AT, progress: Callable[[float], None] = lambda done: None
) -> tuple[Facts, Capture]:
    """Measures everything in a capture folder.

    Args:
        folder: the capture.
        most: this many images are checked, spread evenly, two thirds of them training images.
        progress: called with the fraction that is done.

    Raises:
        TwofoldError: it cannot be used at all. Every fault is listed; where the body merely stands in the wrong place,
            the convention that would fix it is named.
    """
    folder = Path(folder)
    contents = _usable(folder)
    capture = capture_of(contents)
    shaped = shape_body(capture.body, capture.betas)
    points = surface_points(shaped)
    every = [(split, frame) for split, frames in capture.splits.items() for frame in frames]
    train = [item for item in every if item[0] == "train"]
    other = sorted((i for i in every if i[0] != "train"), key=lambda i: (i[1].camera_name, i[1].frame_index))
    share = max(most - len(other), round(2 * most / 3))
    chosen = spread(train, share) + spread(other, max(most - min(share, len(train)), 0))
    looked: list[FrameFacts] = []
    for i, (split, frame) in enumerate(chosen):
        looked.append(frame_facts(frame, split, shaped, points))
        progress(0.75 * (i + 1) / len(chosen))
    by_place = {(frame.camera_name, frame.frame_index): frame for _, frame in chosen}
    doubts = _doubts(looked, by_place, points)
    progress(0.85)
    sound = [f for f in looked if not inverted(f)]
    poses, translations = _motion(contents)
    samples = [sample_of(by_place[f.camera, f.frame_index], points) for f in spread(sound, MOMENT_SAMPLES)]
    delay, gain, _ = best_shift(samples, poses, translations)
    elsewhere: list[tuple[str, int, int]] = []
    bad = [f for f in sound if f.iou < POOR]
    if len(bad) < 0.5 * len(sound):
        # Where most of them are bad, something else is the matter.
        samples = [sample_of(by_place[f.camera, f.frame_index], points) for f in spread(bad, MAX_EXCHANGED)]
        others = poses_elsewhere(
            samples, spread(sorted({f.frame_index for f in looked}), MAX_LOOKED_AT), poses, translations
        )
        elsewhere = [
            (f.camera, f.frame_index, other)
            for f, other in zip(spread(bad, MAX_EXCHANGED), others, strict=True)
            if other in {g.frame_index for g in bad}
        ]
    progress(0.95)
    by_camera = _grouped(frame for _, frame in chosen)
    training = [name for name in by_camera if any(f.camera_name == name for f in capture.train)]
    backs = spread([frame for _, frame in chosen if shows_its_back(frame, shaped)], BACKS)
    seconds = capture.seconds_of(range(len(poses)))
    motion = motion_facts(poses, translations, shaped.joints, capture.splits, seconds)
    facts = Facts(
        name=capture.name,
        folder=folder,
        credit=capture.credit,
        fps=capture.fps,
        images={split: len(frames) for split, frames in capture.splits.items()},
        train_times=frozenset(frame.frame_index for frame in capture.train),
        stature=stature(shaped),
        frames=tuple(looked),
        cameras=_cameras(contents, looked, by_camera, shaped),
        motion=motion,
        standing=standing_facts(poses, translations, shaped.joints, seconds, motion.frames),
        backgrounds={name: background_of(spread(by_camera[name], BACKGROUNDS)) for name in training[:4]},
        backs=tuple((f.camera_name, f.frame_index) for f in backs),
        faces=tuple((f.camera_name, f.frame_index) for f in backs if sees_a_face(f, shaped)),
        doubts=doubts,
        delay=(delay, gain),
        elsewhere=tuple(elsewhere),
        twins=_twins(capture),
        repeated=_repeated(capture.train),
        coverage=coverage_of(capture).share,
    )
    progress(1.0)
    return facts, capture


def _usable(folder: Path) -> Contents:
    """A capture's contents, if there is no fault in them."""
    contents, faults = read_contents(folder)
    thinned = contents
    if sum(map(len, contents.images.values())) > MAX_VALIDATED:
        thinned = replace(
            contents, splits={k: tuple(spread(v, MAX_VALIDATED // 3)) for k, v in contents.splits.items()}
        )
    found = [*faults, *quick_faults(contents), *pixel_faults(thinned), *mesh_faults(folder)]
    if not found:
        return contents
    bodiless = replace(contents, body=None), replace(thinned, body=None)
    why = ""
    if not (faults or quick_faults(bodiless[0]) or pixel_faults(bodiless[1]) or mesh_faults(folder)):
        # All is there and sound, only the body is not where the images have it; perhaps it can be said why.
        why = _why_elsewhere(contents)
    lines = [f"The capture {folder} cannot be used, it has {counted(len(found), 'fault')}:"]
    raise TwofoldError("\n".join([*lines, *([f"  {why}"] if why else []), *(f"  - {f}" for f in alike(found))]))


def alike(faults: Sequence[str]) -> list[str]:
    """Faults, of which those that differ in their frame alone become one.

    >>> alike(["masks/a/000001.png is black.", "masks/a/000002.png is black.", "c is wrong."])
    ['masks/a/000001.png is black. (The same at times 2.)', 'c is wrong.']
    """
    groups: dict[str, list[tuple[str, str]]] = defaultdict(list)
    for fault in faults:
        stem = re.search(r"/(\d{6,})\.\w+ ", fault)
        groups[fault.replace(stem[1], "") if stem else fault].append((fault, stem[1] if stem else ""))
    lines: list[str] = []
    for (fault, _), *more in groups.values():
        lines.append(f"{fault} (The same at times {spans(int(time) for _, time in more)}.)" if more else fault)
    return lines


def _why_elsewhere(contents: Contents) -> str:
    capture = capture_of(contents)
    points = surface_points(shape_body(capture.body, capture.betas))
    frames = [frame for split in capture.splits.values() for frame in split]
    found = diagnose([sample_of(frame, points) for frame in spread(frames, SAMPLES)])
    if not found.conventions:
        return "No usual convention of axes, units or translations would bring body and masks together."
    wrong = " and ".join(c.wrong for c in found.conventions)
    advice = "; then ".join(c.advice for c in found.conventions)
    return (
        f"It looks as if {wrong}. {advice[0].upper()}{advice[1:]}, and silhouettes will agree by {found.iou:.2f} (IoU)."
    )


def _motion(contents: Contents) -> tuple[Float[Tensor, "T 24 3"], Float[Tensor, "T 3"]]:
    if contents.poses is None or contents.translations is None:
        raise AssertionError("faults were raised before")
    return contents.poses, contents.translations


def _doubts(
    looked: Sequence[FrameFacts], frames: dict[tuple[str, int], Frame], points: ShapedBody
) -> tuple[Doubt, ...]:
    """A guess about all cameras together or, where none fixes all, one about each that is poor."""
    groups = _by_camera(f for f in looked if not inverted(f))
    poor = [(name,) for name, group in groups.items() if np.mean([f.iou for f in group]) < POOR]
    doubts: list[Doubt] = []
    for names in [tuple(groups), *(poor if len(groups) > 1 else [])]:
        inside = [f for name in names for f in groups[name]]
        if len(inside) < 2:
            continue
        ratio = float(np.median([f.size_ratio for f in inside]))
        samples = [sample_of(frames[f.camera, f.frame_index], points) for f in spread(inside, SAMPLES)]
        doubts.append(Doubt(names, diagnose(samples, ratio)))
        if doubts[0].diagnosis.conventions:
            break
    return tuple(doubts)


def inverted(frame: FrameFacts) -> bool:
    """Whether its mask covers most of the image and of its border, as no person does."""
    return frame.mask.share > 0.5 and frame.mask.border_share > 0.6


def _cameras(
    contents: Contents, looked: Sequence[FrameFacts], frames: dict[str, list[Frame]], shaped: ShapedBody
) -> tuple[CameraFacts, ...]:
    facts: list[CameraFacts] = []
    for name, group in _by_camera(looked).items():
        camera = contents.cameras[name]
        longer = max(camera.height, camera.width)
        fx, fy = float(camera.intrinsics[0, 0]), float(camera.intrinsics[1, 1])
        across = fx if camera.width >= camera.height else fy
        middle = torch.tensor([(camera.width - 1) / 2, (camera.height - 1) / 2])
        places = torch.stack([shaped.joints[0] + frame.translation for frame in frames[name]])
        facts.append(
            CameraFacts(
                name=name,
                images=len(contents.images[name]),
                looked_at=len(group),
                iou=float(np.mean([f.iou for f in group])),
                view_angle=float(np.degrees(2 * np.arctan(longer / 2 / across))),
                aspect=fy / fx,
                off_center=float((camera.intrinsics[:2, 2] - middle).norm()) / longer,
                distance=float(project(camera, places)[1].median()),
            )
        )
    return tuple(facts)


def _by_camera(looked: Iterable[FrameFacts]) -> dict[str, list[FrameFacts]]:
    groups: dict[str, list[FrameFacts]] = defaultdict(list)
    for facts in looked:
        groups[facts.camera].append(facts)
    return dict(groups)


def _grouped(frames: Iterable[Frame]) -> dict[str, list[Frame]]:
    groups: dict[str, list[Frame]] = defaultdict(list)
    for frame in sorted(frames, key=lambda f: f.frame_index):
        groups[frame.camera_name].append(frame)
    return dict(groups)


def _twins(capture: Capture) -> tuple[tuple[str, str, int], ...]:
    """Test images that are training images under another name."""
    sizes: dict[int, list[Frame]] = defaultdict(list)
    for frame in capture.train:
        sizes[frame.image_file.stat().st_size].append(frame)
    found: list[tuple[str, str, int]] = []
    for split, frames in capture.splits.items():
        for frame in frames if split != "train" else ():
            alike = sizes.get(frame.image_file.stat().st_size, [])
            if alike and _digest(frame) in {_digest(other) for other in alike}:
                found.append((split, frame.camera_name, frame.frame_index))
    return tuple(found)


def _repeated(train: Sequence[Frame]) -> tuple[int, ...]:
    """Frames whose image is the one before, byte for byte, as frozen or stretched videos have them."""
    found: list[int] = []
    ordered = sorted(train, key=lambda f: (f.camera_name, f.frame_index))
    for one, other in itertools.pairwise(ordered):
        same_size = one.image_file.stat().st_size == other.image_file.stat().st_size
        if one.camera_name == other.camera_name and same_size and _digest(one) == _digest(other):
            found.append(other.frame_index)
    return tuple(found)


def _digest(frame: Frame) -> bytes:
    return hashlib.blake2b(frame.image_file.read_bytes()).digest()
