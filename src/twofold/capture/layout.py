"""The layout of a capture folder, and its small files read with every fault noted.

What can be read is returned beside one sentence for each fault, so that a user can fix all of them at once.
"""

import os
import re
from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from twofold.body.skeleton import Body, shape_body, size_fault
from twofold.capture.types import SPLITS
from twofold.errors import TwofoldError
from twofold.geometry.cameras import Camera
from twofold.inputs import read_json, shown, shown_path, why_unreadable
from twofold.npz import are_moderate, not_increasing, read_npz

FORMAT, VERSION = "twofold-capture", 1
DESCRIPTION, BODY, MOTION = "capture.json", "body.npz", "motion.npz"
IMAGES, MASKS, IGNORED, MESHES = "images", "masks", "ignored", "meshes"
CHECK = "check"
"""What `twofold check` found lies here; nothing reads it."""
IMAGE_ENDINGS = (".png", ".jpg", ".jpeg")
CAMERA_NAME = re.compile(r"[A-Za-z0-9_][A-Za-z0-9_.-]{0,99}")
"""Camera names are folder names, so nothing that leaves the folder or breaks on another system."""
MAX_SIDE = 32_768
"""Rows or columns of an image."""
_MAX_FPS = 100_000
_MAX_FOCAL = 1000
"""Focal lengths in widths of the image; telescopes have fewer."""
_MAX_RUNS = 12
"""Of numbers, in a sentence."""


@dataclass(frozen=True)
class Contents:
    """What the small files of a capture folder hold; parts too faulty to be read are left out.

    Attributes:
        folder: where they lie.
        name: for titles.
        fps: frames per second.
        background: 0..1.
        credit: whom to name when showing it.
        cameras: by name.
        splits: images (camera, time) of each split, in the order given.
        body: the body model.
        betas: its shape coefficients.
        poses: axis-angle, radians, one frame a row.
        translations: metres.
        seconds: when each frame was taken, from the first one on, where the rate varies.
    """

    folder: Path
    name: str
    fps: float
    background: tuple[float, float, float]
    credit: str
    cameras: dict[str, Camera]
    splits: dict[str, tuple[tuple[str, int], ...]]
    body: Body | None
    betas: Float[Tensor, "S"] | None
    poses: Float[Tensor, "T 24 3"] | None
    translations: Float[Tensor, "T 3"] | None
    seconds: Float[Tensor, "T"] | None

    @property
    def images(self) -> dict[str, list[int]]:
        """Frames that any split shows, by camera, in order."""
        wanted: dict[str, set[int]] = {}
        for images in self.splits.values():
            for camera, time in images:
                wanted.setdefault(camera, set()).add(time)
        return {camera: sorted(times) for camera, times in wanted.items()}

    def files(self, kind: str, camera: str) -> dict[int, Path]:
        """The images there are of one camera, by time; `kind` is "images", "masks" or "ignored"."""
        return numbered_files(self.folder / kind / camera, IMAGE_ENDINGS)


def numbered_files(folder: Path, endings: tuple[str, ...]) -> dict[int, Path]:
    """Files called by a number of at least six digits, by that number; among several endings the first one wins."""
    if not os.path.isdir(folder):  # unlike Path.is_dir, it is false for names that are too long
        return {}
    try:
        found = {path.name: path for path in folder.iterdir()}
    except OSError as error:
        raise TwofoldError(f"The folder {folder} {why_unreadable(error)}.") from error
    numbered: dict[int, Path] = {}
    for ending in reversed(endings):
        for name, path in sorted(found.items()):
            stem = name.removesuffix(ending)
            if name.endswith(ending) and stem.isdecimal() and file_stem(int(stem)) == stem:
                numbered[int(stem)] = path
    return dict(sorted(numbered.items()))


def file_stem(time: int) -> str:
    """The name of a frame's files.

    >>> file_stem(7)
    '000007'
    """
    return f"{time:06d}"


def spans(times: Iterable[int]) -> str:
    """Numbers in few words; of very many the first.

    >>> spans([4, 0, 1, 2])
    '0-2, 4'
    """
    runs: list[list[int]] = []
    for time in sorted(set(times)):
        if runs and time == runs[-1][1] + 1:
            runs[-1][1] = time
        else:
            runs.append([time, time])
    more = sum(b - a + 1 for a, b in runs[_MAX_RUNS:])
    words = [f"{a}" if a == b else f"{a}-{b}" for a, b in runs[:_MAX_RUNS]]
    return ", ".join(words) + (f" and {more} more" if more else "")


def read_contents(folder: Path) -> tuple[Contents, list[str]]:
    """The small files of a capture folder, and what is wrong with them.

    Raises:
        TwofoldError: it is no capture folder at all, so that there is nothing to check.
    """
    if not os.path.isdir(folder):
        what = "is a file, expected a capture folder" if os.path.exists(folder) else "does not exist"
        raise TwofoldError(f"{shown_path(folder)} {what}; make a capture with `twofold studio` or correct the path.")
    if not os.path.exists(folder / DESCRIPTION):
        try:
            what = "lacks capture.json" if any(folder.iterdir()) else "is empty"
        except OSError as error:
            raise TwofoldError(f"The folder {folder} {why_unreadable(error)}.") from error
        raise TwofoldError(f"{folder} {what}, so it is no capture folder; docs/captures.md says what belongs in one.")
    description = read_json(folder / DESCRIPTION)
    if not isinstance(description, dict) or description.get("format") != FORMAT:
        raise TwofoldError(f'{folder / DESCRIPTION} does not say "format": "{FORMAT}"; it describes something else.')
    if description.get("version") != VERSION:
        raise TwofoldError(
            f"{folder / DESCRIPTION} has version {shown(description.get('version'))}, this program reads version "
            f"{VERSION}; install the program it was made with."
        )
    faults: list[str] = []
    body = _read_body(folder, faults)
    betas, poses, translations, seconds = _read_motion(folder, body, faults)
    cameras = _cameras(description.get("cameras"), faults)
    known = set(description["cameras"]) if isinstance(description.get("cameras"), dict) else set[str]()
    splits = _splits(description.get("splits"), known, None if poses is None else len(poses), faults)
    name, fps, background, credit = _titles(description, faults)
    contents = Contents(
        folder, name, fps, background, credit, cameras, splits, body, betas, poses, translations, seconds
    )  # fmt: skip
    return contents, faults


def _titles(description: dict[str, Any], faults: list[str]) -> tuple[str, float, tuple[float, float, float], str]:
    name, credit = description.get("name"), description.get("credit", "")
    if not isinstance(name, str) or not name:
        faults.append(f'{DESCRIPTION}: "name" should be a text, it is {shown(name)}.')
    if not isinstance(credit, str):
        faults.append(f'{DESCRIPTION}: "credit" should be a text (empty for your own images), it is {shown(credit)}.')
    fps = _numbers(description.get("fps"), ())
    if fps is None or not 1e-6 <= fps <= _MAX_FPS:
        given = shown(description.get("fps"))
        faults.append(f'{DESCRIPTION}: "fps" should be frames per second above 0, up to {_MAX_FPS}; it is {given}.')
    background = _numbers(description.get("background"), (3,))
    if background is None or background.min() < 0 or background.max() > 1:
        given = shown(description.get("background"))
        faults.append(f'{DESCRIPTION}: "background" should be three numbers from 0 to 1, it is {given}.')
        background = np.zeros(3)
    red, green, blue = background.tolist()
    return str(name), 1.0 if fps is None else float(fps), (red, green, blue), str(credit)


def _cameras(given: Any, faults: list[str]) -> dict[str, Camera]:
    if not isinstance(given, dict) or not given:
        faults.append(f'{DESCRIPTION}: "cameras" should name at least one camera.')
        return {}
    cameras: dict[str, Camera] = {}
    for name, entry in given.items():
        where = f"{DESCRIPTION}: camera {shown_path(name, 120)}"
        found = len(faults)
        if not CAMERA_NAME.fullmatch(name):
            faults.append(f"{where}: a camera's name is a folder's name; use 1 to 100 letters, digits, _, - and dots.")
        if not isinstance(entry, dict):
            faults.append(f"{where} should hold world_to_camera, intrinsics, height and width.")
            continue
        height, width = (_count(entry.get(side)) for side in ("height", "width"))
        if not height or not width:
            given_size = f"{shown(entry.get('height'))} and {shown(entry.get('width'))}"
            faults.append(f"{where}: height and width should be whole pixels, 1 to {MAX_SIDE}; they are {given_size}.")
        world_to_camera = _numbers(entry.get("world_to_camera"), (4, 4))
        intrinsics = _numbers(entry.get("intrinsics"), (3, 3))
        faults += [f"{where}: {fault}" for fault in rigid_faults(world_to_camera)]
        faults += [f"{where}: {fault}" for fault in intrinsics_faults(intrinsics, width)]
        if len(faults) == found and world_to_camera is not None and intrinsics is not None:
            tensors = [torch.as_tensor(m.astype(np.float32)) for m in (world_to_camera, intrinsics)]
            cameras[name] = Camera(tensors[0], tensors[1], height, width)
    return cameras


def rigid_faults(matrix: np.ndarray | None) -> list[str]:
    """What keeps a 4x4 matrix from being a rotation followed by a translation."""
    if matrix is None:
        return ["world_to_camera should be 4 rows of 4 finite numbers."]
    faults: list[str] = []
    rotation = matrix[:3, :3]
    if np.abs(rotation @ rotation.T - np.eye(3)).max() > 1e-3:
        faults.append("the left upper 3x3 of world_to_camera is no rotation; take scale and shear out of it.")
    elif np.linalg.det(rotation) < 0:
        faults.append("world_to_camera mirrors the world; camera axes are x right, y down, z forward (OpenCV).")
    if np.abs(matrix[3] - [0, 0, 0, 1]).max() > 1e-6:
        faults.append("the last row of world_to_camera should be 0 0 0 1; perhaps the matrix is transposed.")
    return faults


def intrinsics_faults(matrix: np.ndarray | None, width: int) -> list[str]:
    """What keeps a 3x3 matrix from being [fx s cx; 0 fy cy; 0 0 1] in pixels."""
    if matrix is None:
        return ["intrinsics should be 3 rows of 3 finite numbers."]
    faults: list[str] = []
    focal = matrix[0, 0], matrix[1, 1]
    farthest = _MAX_FOCAL * (width if width > 0 else MAX_SIDE)
    if min(focal) <= 0:
        faults.append(f"the focal lengths should be above 0, they are {focal[0]:g} and {focal[1]:g}.")
    elif min(focal) < 0.05 * width:
        faults.append(f"the focal length {min(focal):g} is far too short for {width} columns; give it in pixels.")
    elif max(focal) > farthest:
        faults.append(f"the focal length {max(focal):g} is longer than any lens has; give it in pixels.")
    if np.abs(matrix[:2, 2]).max() > farthest:
        faults.append("the principal point is far outside the image; give it in pixels.")
    if np.abs(matrix[2] - [0, 0, 1]).max() > 1e-6 or abs(matrix[1, 0]) > 1e-6:
        faults.append("intrinsics should read [fx s cx; 0 fy cy; 0 0 1]; perhaps the matrix is transposed.")
    return faults


def _splits(
    given: Any, cameras: set[str], moments: int | None, faults: list[str]
) -> dict[str, tuple[tuple[str, int], ...]]:
    if not isinstance(given, dict):
        faults.append(f'{DESCRIPTION}: "splits" should name the images of {", ".join(SPLITS)}.')
        return dict.fromkeys(SPLITS, ())
    for name in set(given) - set(SPLITS):
        faults.append(f"{DESCRIPTION}: there is no split {shown(name)}; the splits are {', '.join(SPLITS)}.")
    splits = {"train": _split("train", given.get("train", []), cameras, moments, faults)}
    damaged = any(" split train" in fault for fault in faults)
    splits |= {split: _split(split, given.get(split, []), cameras, moments, faults) for split in SPLITS[1:]}
    train, train_times = set(splits["train"]), {time for _, time in splits["train"]}
    if not train and damaged:
        return splits
    if not train:
        faults.append(f"{DESCRIPTION}: the train split is empty; there is nothing to learn from.")
    elif len(train_times) == 1:
        faults.append(
            f"{DESCRIPTION}: the train split shows one frame only (time {min(train_times)}); "
            "at least two poses are needed to learn how a person moves."
        )
    seen = {time for camera, time in splits["novel_view"] if (camera, time) in train}
    unseen = {time for _, time in splits["novel_view"]} - train_times
    again = {time for _, time in splits["novel_pose"]} & train_times
    if seen:
        faults.append(f"{DESCRIPTION}: novel_view holds training images at {spans(seen)}; leave them out of one.")
    if unseen and train:
        faults.append(f"{DESCRIPTION}: novel_view shows frames not trained on, {spans(unseen)}; use novel_pose.")
    if again:
        faults.append(f"{DESCRIPTION}: novel_pose shows training frames, {spans(again)}; they are not novel.")
    return splits


def _split(
    split: str, given: Any, cameras: set[str], moments: int | None, faults: list[str]
) -> tuple[tuple[str, int], ...]:
    where = f"{DESCRIPTION}: split {split}"
    images: list[tuple[str, int]] = []
    for entry in given if isinstance(given, list) else [None]:
        if not isinstance(entry, dict) or not isinstance(entry.get("times"), list):
            faults.append(f'{where} should be a list of {{"camera": name, "times": [numbers]}}.')
            continue
        camera, times = entry.get("camera"), entry["times"]
        if not isinstance(camera, str) or camera not in cameras:
            known = shown_path(", ".join(sorted(cameras)))
            faults.append(f"{where} names the unknown camera {shown(camera)}; known are {known}.")
            continue
        if not CAMERA_NAME.fullmatch(camera):
            continue  # a fault of the camera
        if not all(type(time) is int and time >= 0 for time in times):
            faults.append(f"{where}: the times of camera {camera} should be whole numbers from 0 up.")
            continue
        beyond = {time for time in times if moments is not None and time >= moments}
        if beyond:
            faults.append(
                f"{where}: camera {camera} shows times {spans(beyond)}, {MOTION} ends at {(moments or 0) - 1}."
            )
        images += [(camera, time) for time in times if time not in beyond]
    twice = [time for (_, time), count in Counter(images).items() if count > 1]
    if twice:
        faults.append(f"{where} names the same image twice at times {spans(twice)}; once is enough.")
    return tuple(dict.fromkeys(images))


def _read_body(folder: Path, faults: list[str]) -> Body | None:
    try:
        return Body.from_arrays(read_npz(folder / BODY, Body.names()), BODY)
    except TwofoldError as error:
        faults.append(within_folder(folder, error))
        return None


_OPTIONAL = ("true_poses", "true_translations", "seconds")
"""Arrays that `motion.npz` need not have."""


def _read_motion(
    folder: Path, body: Body | None, faults: list[str]
) -> tuple[Tensor | None, Tensor | None, Tensor | None, Tensor | None]:
    names = ("betas", "poses", "translations", "true_poses", "true_translations", "seconds")
    try:
        arrays = read_npz(folder / MOTION, names)
    except TwofoldError as error:
        faults.append(within_folder(folder, error))
        return None, None, None, None
    moments = len(arrays["poses"]) if "poses" in arrays and arrays["poses"].ndim else 0
    shapes: dict[str, tuple[int | None, ...]] = {
        "betas": (None,), "poses": (moments, 24, 3), "translations": (moments, 3),
        "true_poses": (moments, 24, 3), "true_translations": (moments, 3), "seconds": (moments,),
    }  # fmt: skip
    read: dict[str, Tensor] = {}
    for name, shape in shapes.items():
        if name not in arrays:
            if name not in _OPTIONAL:
                faults.append(f"{MOTION} lacks {name}.")
            continue
        array, words = arrays[name], " x ".join("any" if n is None else str(n) for n in shape)
        if array.dtype.kind not in "fiu" or not _fits(array.shape, shape):
            faults.append(f"{MOTION}: {name} should be numbers of shape {words}, it is {array.dtype} of {array.shape}.")
        elif not np.isfinite(array).all():
            bad = np.flatnonzero(~np.isfinite(array).reshape(len(array), -1).all(1)).tolist()
            where = "elements" if name == "betas" else "times"
            faults.append(f"{MOTION}: {name} is not finite at {where} {spans(bad)}; estimate or leave these out.")
        elif name != "seconds" and not are_moderate(array):
            faults.append(f"{MOTION}: {name} holds numbers beyond a thousand million; give metres and radians.")
        elif name.endswith("poses") and (turns := np.linalg.norm(array, axis=-1)).size and turns.max() > 4 * np.pi:
            bad = np.flatnonzero((turns > 4 * np.pi).any(-1)).tolist()
            faults.append(f"{MOTION}: {name} turns joints by more than two turns at times {spans(bad)}; give radians.")
        elif name == "seconds" and (back := not_increasing(array)):
            faults.append(f"{MOTION}: seconds should increase from frame to frame; not so at times {spans(back)}.")
        elif name == "seconds":
            read[name] = torch.as_tensor(array.astype(np.float64) - array[:1].astype(np.float64))
        else:
            read[name] = torch.as_tensor(array.astype(np.float32))
    betas = read.get("betas")
    if body is not None and betas is not None and len(betas) > body.shape_basis.shape[-1]:
        faults.append(f"{MOTION}: there are {len(betas)} betas, the body takes {body.shape_basis.shape[-1]} at most.")
        betas = None
    elif body is not None and betas is not None and (size := size_fault(shape_body(body, betas).vertices.numpy())):
        faults.append(f"{MOTION}: betas {size}; take those that were fitted to this body.")
        betas = None
    return betas, read.get("poses"), read.get("translations"), read.get("seconds")


def _fits(shape: tuple[int, ...], expected: tuple[int | None, ...]) -> bool:
    return len(shape) == len(expected) and all(m in (n, None) for n, m in zip(shape, expected, strict=True))


def _count(value: Any) -> int:
    """`value` if it is a number of rows or columns, else 0."""
    return value if type(value) is int and 0 < value <= MAX_SIDE else 0


def _numbers(value: Any, shape: tuple[int, ...]) -> np.ndarray | None:
    """`value` as an array, if it is one of finite numbers of this shape."""
    try:
        array = np.asarray(value)
    except ValueError:  # rows of unequal length
        return None
    if array.dtype.kind not in "fiu" or array.shape != shape or not are_moderate(array):
        return None
    return array.astype(np.float64)


def within_folder(folder: Path, error: TwofoldError) -> str:
    """Its sentence, with paths as seen from the capture folder, as all other faults have them."""
    return str(error).replace(f"{folder}/", "")
