"""What pose estimators say of a video: people followed over images, and the lens they believed in."""

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from twofold.capture.layout import spans
from twofold.capture.readers.sequence import numbers, require_radians
from twofold.errors import TwofoldError
from twofold.geometry.rotations import matrix_to_axis_angle
from twofold.prepare.video.frames import ClipInfo

Lens = Callable[[int, int], tuple[float, float, float, float]]
"""fx, fy, cx, cy in pixels, for images with that width and height."""
_JUMP = 0.7
"""Metres: a person found farther from where one was in the image before is somebody else."""


@dataclass(frozen=True)
class PersonTrack:
    """One person through a video.

    Attributes:
        images: what each image is called, or its number.
        poses: axis-angle, root first, radians.
        translations: SMPL's own, metres.
        betas: shape coefficients of each image.
    """

    images: tuple[str, ...]
    poses: Float[Tensor, "n 24 3"]
    translations: Float[Tensor, "n 3"]
    betas: Float[Tensor, "n S"]


@dataclass(frozen=True)
class Estimates:
    """What a program found.

    Attributes:
        program: its name, for the sentences.
        path: where its results lie.
        tracks: the people, by the program's numbers for them.
        lens: the camera it believed in; None where it says nothing of one.
        counted: images are numbers from 0, one for each image of the video; else they are names.
        complete: there is one pose for each image, so that another number of them belongs to another video.
        smpl: betas and translations are of SMPL, so that another body cannot take them.
        remarks: sentences that the user should know.
    """

    program: str
    path: Path
    tracks: dict[int, PersonTrack]
    lens: Lens | None = None
    counted: bool = False
    complete: bool = False
    smpl: bool = True
    remarks: tuple[str, ...] = ()


@dataclass(frozen=True)
class PoseOptions:
    """What the user says about results.

    Attributes:
        track: whom of several people; None for who is seen longest.
        smplx: the user's SMPL-X file, where poses are of that model.
    """

    track: int | None = None
    smplx: Path | None = None


@dataclass(frozen=True)
class Detection:
    """One person in one image."""

    image: str
    person: int | None
    pose: Float[Tensor, "24 3"]
    translation: Float[Tensor, "3"]
    betas: Float[Tensor, "S"]


def wide_lens(focal: Callable[[int, int], float]) -> Lens:
    """A lens whose principal point is the middle of the image."""
    return lambda width, height: (focal(width, height), focal(width, height), width / 2, height / 2)


def tracks_of(detections: Sequence[Detection]) -> dict[int, PersonTrack]:
    """Detections person by person, images in order; people without a number are followed by where they are."""
    known = detections if all(d.person is not None for d in detections) else _followed(detections)
    found: dict[int, list[Detection]] = {}
    for detection in known:
        found.setdefault(detection.person or 0, []).append(detection)
    tracks: dict[int, PersonTrack] = {}
    for person, rows in found.items():
        images = tuple(row.image for row in rows)
        twice = next((image for image in images if images.count(image) > 1), None)
        if twice is not None:
            raise TwofoldError(f"Person {person} is in image {twice} twice; the results are damaged, make them again.")
        tracks[person] = PersonTrack(
            images, torch.stack([r.pose for r in rows]), torch.stack([r.translation for r in rows]),
            torch.stack([r.betas for r in rows]),
        )  # fmt: skip
    return tracks


def _followed(detections: Sequence[Detection]) -> list[Detection]:
    """Everybody is whoever was closest in the image before, within a step's reach."""
    last: dict[int, Tensor] = {}
    out: list[Detection] = []
    by_image: dict[str, list[Detection]] = {}
    for detection in detections:
        by_image.setdefault(detection.image, []).append(detection)
    for rows in by_image.values():
        free = dict(last)
        for row in rows:
            near = sorted((float((place - row.translation).norm()), person) for person, place in free.items())
            person = near[0][1] if near and near[0][0] < _JUMP else len(last)
            free.pop(person, None)
            last[person] = row.translation
            out.append(Detection(row.image, person, row.pose, row.translation, row.betas))
    return out


def chosen_track(found: Estimates, track: int | None) -> tuple[PersonTrack, str]:
    """The person that is meant, and a sentence where there are several.

    Raises:
        TwofoldError: there is nobody, or not the one that was asked for.
    """
    if not found.tracks:
        raise TwofoldError(f"{found.path} has nobody in it; run {found.program} on this video again.")
    listed = ", ".join(f"{person} ({len(t.images)} images)" for person, t in sorted(found.tracks.items())[:12])
    if track is not None:
        if track not in found.tracks:
            raise TwofoldError(f"{found.path} has no person {track}; --track takes one of {listed}.")
        return found.tracks[track], ""
    longest = max(found.tracks, key=lambda person: (len(found.tracks[person].images), -person))
    if len(found.tracks) == 1:
        return found.tracks[longest], ""
    return found.tracks[longest], (
        f"{found.path} has {len(found.tracks)} people: {listed}; person {longest}, who is seen longest, is taken, "
        "--track takes another."
    )


def places_of(track: PersonTrack, found: Estimates, info: ClipInfo) -> tuple[dict[int, int], str]:
    """The row of each image of a clip (by `VideoFrame.source`), and a sentence on what was assumed; never by position.

    Raises:
        TwofoldError: the results name images that the clip does not have.
    """
    if found.counted:
        return _numbered(track, found, info, 0), ""
    names = {name: source for source, name in enumerate(info.names)}
    stems = [Path(image).stem for image in track.images]
    if names and all(stem in names for stem in stems):
        return {names[stem]: row for row, stem in enumerate(stems)}, ""
    last = [re.findall(r"[0-9]+", stem)[-1:] for stem in stems]
    if names or not all(last):
        odd = next((stem for stem in stems if stem not in names), stems[0])
        raise TwofoldError(
            f"{found.path} names the image {odd}, which the clip has not"
            + (f" (it has {info.names[0]} and so on)" if names else ", a video, whose images have numbers")
            + "; give the images that the poses were estimated on."
        )
    values = [int(found_[0]) for found_ in last]
    first = 1 if min(values) >= 1 and (min(values) == 1 or max(values) >= info.sources) else 0
    counted = PersonTrack(tuple(map(str, values)), track.poses, track.translations, track.betas)
    words = "" if min(values) == first == 0 or max(values) - first == info.sources - 1 else (
        f"The images in {found.path} are taken as counted from {first}; a folder of images instead of the video would "
        "tell for sure."
    )  # fmt: skip
    return _numbered(counted, found, info, first), words


def _numbered(track: PersonTrack, found: Estimates, info: ClipInfo, first: int) -> dict[int, int]:
    sources = [int(image) - first for image in track.images]
    slack = max(1, info.sources // 50)  # Some programs decode one image more.
    if sources and not (min(sources) >= 0 and max(sources) < info.sources + slack):
        raise TwofoldError(
            f"{found.path} has poses of images {min(sources) + first} to {max(sources) + first}, and the clip has "
            f"{info.sources}; give the results for this clip."
        )
    return {source: row for row, source in enumerate(sources) if source < info.sources}


def absent_words(found: Estimates, absent: Sequence[int]) -> str:
    """A sentence about images without a result."""
    return (
        f"{found.path} has no pose for {len(absent)} images ({spans(absent)}, counted from 0); these are left out."
        if absent
        else ""
    )


def as_axis_angle(value: object, joints: int, what: str, where: object) -> Float[Tensor, "n j 3"]:
    """Rotations as axis-angle vectors, given so, flat, or as matrices.

    Args:
        value: n x 3 j, n x j x 3 or n x j x 3 x 3.
        joints: j.
        what: they are called, and `where` they lie, for the sentences.
        where: see `what`.

    Raises:
        TwofoldError: they are none, or in degrees.
    """
    shape = np.shape(value) if isinstance(value, np.ndarray) else ()
    count = shape[0] if shape else 0
    if shape in ((count, joints, 3, 3), (count, 9 * joints)):
        matrices = numbers(value, shape, what, where).reshape(count, joints, 3, 3)
        off = np.abs(matrices @ matrices.swapaxes(-1, -2) - np.eye(3)).max(initial=0.0)
        if off > 1e-2:
            raise TwofoldError(f"{what} in {where} should be rotation matrices; they are off by {off:.2g}.")
        return matrix_to_axis_angle(torch.from_numpy(matrices))
    if shape == (count, joints, 3):
        value = np.asarray(value).reshape(count, 3 * joints)
    if isinstance(value, np.ndarray) and value.ndim == 2 and value.shape[1] in (156, 165) and joints == 24:
        raise TwofoldError(
            f"{what} in {where} has {value.shape[1]} numbers an image, as SMPL-H and SMPL-X have; give SMPL's 72."
        )
    flat = numbers(value, (None, 3 * joints), what, where)
    require_radians(flat.reshape(-1, 3), f"{what} of {where}")
    return torch.from_numpy(flat).reshape(count, joints, 3)


def entries_have(content: Any, *keys: str) -> bool:
    """Whether the content of a file is a dictionary of dictionaries, the first of which has these keys."""
    first = next(iter(content.values()), None) if isinstance(content, dict) else None
    return isinstance(first, dict) and set(keys) <= first.keys()


def betas_of(value: object, count: int, where: object) -> Float[Tensor, "n S"]:
    """Shape coefficients of each image, given once or for each; the first ten (BEV's eleventh is an age).

    Raises:
        TwofoldError: they are none.
    """
    array = np.asarray(value, dtype=None)
    rows = array[None] if array.ndim == 1 else array
    found = numbers(rows, (None, None), "betas", where)[:, :10]
    if len(found) not in (1, count):
        raise TwofoldError(f"betas in {where} are {len(found)} rows for {count} images; give one, or one an image.")
    return torch.from_numpy(np.broadcast_to(found, (count, found.shape[1])).copy())
