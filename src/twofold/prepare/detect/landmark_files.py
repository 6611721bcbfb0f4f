"""Landmarks that the user found: of any of the usual layouts, in one file or a file for each image."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from twofold.errors import TwofoldError
from twofold.inputs import read_json, shown
from twofold.npz import read_npz
from twofold.prepare.detections import LANDMARKS, Track
from twofold.prepare.video.frames import ClipInfo, files_with, natural_order
from twofold.prepare.video.numbering import numberings

_COCO = (
    "nose", "left_eye", "right_eye", "left_ear", "right_ear", "left_shoulder", "right_shoulder", "left_elbow",
    "right_elbow", "left_wrist", "right_wrist", "left_hip", "right_hip", "left_knee", "right_knee", "left_ankle",
    "right_ankle",
)  # fmt: skip
_OPENPOSE = (
    "nose", "", "right_shoulder", "right_elbow", "right_wrist", "left_shoulder", "left_elbow", "left_wrist", "",
    "right_hip", "right_knee", "right_ankle", "left_hip", "left_knee", "left_ankle", "right_eye", "left_eye",
    "right_ear", "left_ear", "left_foot_index", "", "left_heel", "right_foot_index", "", "right_heel",
)  # fmt: skip
LAYOUTS = {
    33: LANDMARKS,
    17: _COCO,
    18: (*_OPENPOSE[:8], *_OPENPOSE[9:19]),
    25: _OPENPOSE,
    26: (*_COCO, "", "", "", "left_foot_index", "right_foot_index", "", "", "left_heel", "right_heel"),
    133: (*_COCO, "left_foot_index", "", "left_heel", "right_foot_index", "", "right_heel", *("",) * 110),
}
"""What landmarks are called, by how many there are: BlazePose, COCO, OpenPose's older 18 and BODY_25, HALPE_26 and
COCO-WholeBody; those without a name are not used."""
_MAX_BYTES = 256 * 2**20
"""Of a JSON file: 133 landmarks in 30,000 images."""
_MAX_NAME = 255
_FARTHEST = 1e9
"""Pixels; what lies beyond was not found."""
NEEDED = ("left_shoulder", "right_shoulder", "left_hip", "right_hip")


def landmarks_from_file(path: Path | str, info: ClipInfo) -> Track:
    """The likeliest of `landmark_readings`."""
    return landmark_readings(path, info)[0][1]


def landmark_readings(path: Path | str, info: ClipInfo) -> list[tuple[str, Track]]:
    """Landmarks of every image of a clip as it is before any are left out (`VideoFrame.source`), scaled as they are.

    World landmarks are NaN. What is missing is NaN with visibility 0; so are images without landmarks.

    Args:
        path: one of
            * npz: `landmarks` (F x K x 3: column, row, confidence 0..1) and, unless the layout is known by K, `names`;
            * JSON: an object with the same two, null for what is missing;
            * JSON: a list of objects with `image_id` and `keypoints` (3 K numbers), as AlphaPose and COCO write it;
            * a folder with a JSON file for each image, as OpenPose and Pose2Sim write it.
            Of several people in an image the largest is taken.
        info: the clip; columns and rows are those of its full size.

    Returns:
        Each way in which they can belong to the images, in words, with the landmarks; the likeliest first.

    Raises:
        TwofoldError: it is missing or damaged, of an unknown layout, lacks shoulders or hips, belongs to another clip
            or another size, or counts columns and rows from 0 to 1.
    """
    path = Path(path)
    if path.is_dir():
        found = _from_folder(path, info)
    elif path.suffix.lower() == ".json":
        found = _from_json(path, info)
    else:
        found = _shifted(*_from_arrays(read_npz(path, ("landmarks", "names")), path), info)
    tracks: list[tuple[str, Track]] = []
    for words, values, names in found:
        if abs(len(values) - info.sources) > max(1, info.sources // 50):
            raise TwofoldError(
                f"{path} has landmarks of {len(values)} images, and the clip has {info.sources}; give them for every "
                "one."
            )
        _check_place(values, info, path)
        tracks.append((words, _track(values, names, info)))
    return tracks


_Reading = tuple[str, Float[np.ndarray, "f k 3"], tuple[str, ...]]


def _shifted(values: Float[np.ndarray, "f k 3"], names: tuple[str, ...], info: ClipInfo) -> list[_Reading]:
    """Rows from the first image on; where some are missing, they may be missing at the start."""
    found: list[_Reading] = [("in order from the first image", values, names)]
    if 0 < (missing := info.sources - len(values)) <= max(1, info.sources // 50):
        nothing = np.full((missing, *values.shape[1:]), np.nan)
        found.append(("in order up to the last image", np.concatenate([nothing, values]), names))
    return found


def track_at(track: Track, sources: Sequence[int]) -> Track:
    """The landmarks of some images, by their places; those beyond the end are not found.

    Args:
        track: of all images.
        sources: `VideoFrame.source` of those wanted.
    """
    places = np.array(sources, int)
    inside = places < len(track)
    places = np.where(inside, places, 0)
    return Track(
        np.where(inside[:, None, None], track.pixels[places], np.nan).astype(np.float32),
        np.where(inside[:, None], track.visibility[places], 0).astype(np.float32),
        np.where(inside[:, None, None], track.world[places], np.nan).astype(np.float32),
    )


def _from_arrays(arrays: dict[str, Any], path: Path) -> tuple[Float[np.ndarray, "f k 3"], tuple[str, ...]]:
    if "landmarks" not in arrays:
        raise TwofoldError(
            f"{path} lacks the array `landmarks` (images x landmarks x 3); docs/prepare.md describes it."
        )
    values = _numbers(arrays["landmarks"])
    if values is None or values.ndim != 3 or values.shape[2] != 3 or 0 in values.shape:
        shape = "of unequal rows" if values is None else " x ".join(map(str, values.shape))
        raise TwofoldError(
            f"{path}: `landmarks` is {shape}, expected images x landmarks x 3 (column, row, confidence)."
        )
    if "names" not in arrays:
        return values, _layout(values.shape[1], path)
    names = tuple(str(name) for name in np.ravel(np.asarray(arrays["names"])))
    if len(names) != values.shape[1]:
        raise TwofoldError(f"{path} has {values.shape[1]} landmarks and {len(names)} `names`; give one for each.")
    lacking = [name for name in NEEDED if name not in names]
    if lacking:
        raise TwofoldError(f"{path} lacks the landmark {lacking[0]}; shoulders and hips are needed, under these names.")
    return values, names


def _from_json(path: Path, info: ClipInfo) -> list[_Reading]:
    content = read_json(path, _MAX_BYTES)
    if isinstance(content, dict):
        return _shifted(*_from_arrays(content, path), info)
    entries = content if isinstance(content, list) and all(isinstance(e, dict) for e in content) else []
    if not entries or not all("keypoints" in entry and "image_id" in entry for entry in entries):
        raise TwofoldError(f"{path} holds no landmarks in a known form; docs/prepare.md describes those that are read.")
    people: dict[str, list[Any]] = {}
    for entry in entries:
        name = str(entry["image_id"])
        if len(name) > _MAX_NAME:
            raise TwofoldError(f"{path} names an image {shown(name)}; write the landmarks anew.")
        people.setdefault(name, []).append(entry["keypoints"])
    names = {path / name: name for name in sorted(people, key=natural_order)}
    return [
        (n.words, *_assembled({place: people[names[file]] for place, file in n.places.items()}, info, path))
        for n in numberings(list(names), info, "images with landmarks")
    ]


def _from_folder(folder: Path, info: ClipInfo) -> list[_Reading]:
    files = files_with(folder, (".json",), "JSON files; expected one with landmarks for each image")
    seen: dict[Path, list[Any]] = {}
    for file in files:
        content = read_json(file)
        people = content.get("people") if isinstance(content, dict) else None
        if not isinstance(people, list) or not all(isinstance(p, dict) and "pose_keypoints_2d" in p for p in people):
            raise TwofoldError(
                f"{file} has no `people` with `pose_keypoints_2d`, which OpenPose writes; make it again."
            )
        seen[file] = [person["pose_keypoints_2d"] for person in people]
    return [
        (n.words, *_assembled({place: seen[file] for place, file in n.places.items()}, info, folder))
        for n in numberings(files, info, "files of landmarks")
    ]


def _assembled(
    people: dict[int, list[Any]], info: ClipInfo, path: Path
) -> tuple[Float[np.ndarray, "f k 3"], tuple[str, ...]]:
    """The largest person of each image; NaN where nobody is."""
    chosen: dict[int, np.ndarray] = {}
    for place, candidates in people.items():
        for candidate in candidates:
            values = _numbers(candidate)
            if values is None or values.ndim != 1 or values.size == 0 or values.size % 3:
                raise TwofoldError(f"{path}: the landmarks of image {place} are not column, row, confidence in turn.")
            person = values.reshape(-1, 3)
            if place not in chosen or _extent(person) > _extent(chosen[place]):
                chosen[place] = person
    counts = {len(person) for person in chosen.values()}
    if len(counts) != 1:
        what = "nobody in any image" if not counts else f"{min(counts)} landmarks here and {max(counts)} there"
        raise TwofoldError(f"{path} has {what}; find the landmarks again.")
    names = _layout(counts.pop(), path)
    values = np.full((max(*people, info.sources - 1, 0) + 1, len(names), 3), np.nan)
    for place, person in chosen.items():
        values[place] = person
    return values, names


def _layout(count: int, path: Path) -> tuple[str, ...]:
    if count not in LAYOUTS:
        known = ", ".join(map(str, sorted(LAYOUTS)))
        raise TwofoldError(
            f"{path} has {count} landmarks without names; known layouts have {known}; give `names` (docs/prepare.md)."
        )
    return LAYOUTS[count]


def _numbers(value: Any) -> np.ndarray | None:
    """An array of numbers, null as NaN; None if it is none."""
    try:
        given = np.asarray(value)
        if given.dtype.kind == "c":
            return None
        numbers = given.astype(np.float64)
        return np.where(np.abs(numbers) <= _FARTHEST, numbers, np.nan)  # NaN, of nothing that was found, stays
    except (TypeError, ValueError, OverflowError):
        return None


def _extent(person: Float[np.ndarray, "k 3"]) -> float:
    seen = person[np.nan_to_num(person[:, 2]) > 0.05, :2]
    return float(np.prod(np.ptp(seen, axis=0))) if len(seen) else -1.0


def _check_place(values: Float[np.ndarray, "f k 3"], info: ClipInfo, path: Path) -> None:
    seen = values[np.nan_to_num(values[..., 2]) > 0][:, :2]
    seen = seen[np.isfinite(seen).all(1)]
    if not len(seen):
        raise TwofoldError(f"{path} holds no landmark with a confidence above 0; find the landmarks again.")
    if np.all(np.abs(seen) <= 2):
        raise TwofoldError(
            f"{path} has columns and rows between 0 and 1; multiply them by the image's width and height."
        )
    size = np.array([info.full_width, info.full_height])
    if np.mean(((seen >= -0.1 * size) & (seen <= 1.1 * size)).all(1)) < 0.5:
        raise TwofoldError(
            f"Most landmarks in {path} lie outside the images of {size[0]} x {size[1]}; find them in these images."
        )


def _track(values: Float[np.ndarray, "f k 3"], names: tuple[str, ...], info: ClipInfo) -> Track:
    """In BlazePose's order, in pixels of the images that come."""
    ours = np.full((len(values), len(LANDMARKS), 3), np.nan)
    for place, name in enumerate(names):
        if name in LANDMARKS:
            ours[:, LANDMARKS.index(name)] = values[:, place]
    scale = np.array([info.width / info.full_width, info.height / info.full_height])
    pixels = (ours[..., :2] + 0.5) * scale - 0.5  # The middle of the first pixel is 0, its edge -0.5.
    visibility = np.clip(np.nan_to_num(ours[..., 2]), 0, 1)
    visibility[~np.isfinite(pixels).all(2)] = 0
    pixels[visibility == 0] = np.nan
    world = np.full((len(values), len(LANDMARKS), 3), np.nan, np.float32)
    return Track(pixels.astype(np.float32), visibility.astype(np.float32), world)
