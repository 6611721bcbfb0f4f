"""Calibrations of several cameras as files: Qualisys, OpenCV and EasyMocap, Pose2Sim, and our own JSON.

OpenCV's YAML is read by a few lines of our own: PyYAML refuses its version line and its matrix tag and takes numbers
like 1e-05 for words, and only keys with numbers, names and matrices are needed.
"""

import re
import xml.etree.ElementTree as ET
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from twofold.capture.layout import MAX_SIDE, intrinsics_faults, rigid_faults
from twofold.errors import TwofoldError
from twofold.inputs import read_json, read_text, read_toml, shown_path
from twofold.npz import are_moderate
from twofold.prepare.cameras.calibration import CalibratedCamera

KNOWN = (
    "Qualisys .qca.txt, EasyMocap or OpenCV intri.yml with extri.yml, Pose2Sim Calib.toml, "
    'or JSON with "cameras" as in capture.json'
)
_MAX_NAME = 100
_QUALISYS = 64
"""Qualisys counts 64 steps to a pixel."""

_FAR = 200.0
"""Metres between two cameras that nobody has: lengths are in millimetres or centimetres."""


def read_calibration(path: Path | str) -> dict[str, CalibratedCamera]:
    """The cameras of a calibration by name, in its order.

    Args:
        path: a file of a known kind (`KNOWN`), or the folder of intri.yml and extri.yml.

    Raises:
        TwofoldError: it is missing, of no known kind, or a camera of it makes no sense.
    """
    path = Path(path)
    cameras = _reader(path)(path)
    if not cameras:
        raise TwofoldError(f"{path} holds no camera; give {KNOWN}.")
    centers = np.stack([camera.center for camera in cameras.values()])
    apart = float(np.linalg.norm(centers - centers[0], axis=1).max())
    if apart > _FAR:
        raise TwofoldError(f"{path} has cameras {apart:.0f} m apart; give its translations in metres.")
    return cameras


def _reader(path: Path) -> Callable[[Path], dict[str, CalibratedCamera]]:
    if path.is_dir() or path.suffix.lower() in {".yml", ".yaml"}:
        return _read_opencv
    by_ending = {".toml": _read_toml, ".json": _read_json}
    if path.suffix.lower() in by_ending:
        return by_ending[path.suffix.lower()]
    if _text(path).lstrip("\ufeff \t\r\n").startswith("<"):
        return _read_qualisys
    raise TwofoldError(f"{path} is no calibration that is known here; give {KNOWN}.")


def _text(path: Path) -> str:
    try:
        return read_text(path)
    except TwofoldError as error:
        text = str(error).removesuffix(".").removesuffix("; save it as such")
        raise TwofoldError(f"{text}; give {KNOWN}.") from error


def _camera(
    where: str, name: str, intrinsics: Any, distortion: Any, world_to_camera: Any, size: tuple[int | None, int | None]
) -> CalibratedCamera:
    """One camera, if it makes sense; `where` begins the sentence if not, `size` is (height, width)."""
    k, given, rigid = _numbers(intrinsics), _numbers(distortion), _numbers(world_to_camera)
    height, width = size
    faults = rigid_faults(rigid if rigid is not None and rigid.shape == (4, 4) else None)
    faults += intrinsics_faults(k if k is not None and k.shape == (3, 3) else None, width or 0)
    if given is None or given.size not in (4, 5, 8, 12, 14) or given.ravel()[5:].any():
        faults.append("the distortion should be OpenCV's k1, k2, p1, p2 and k3; undistort the videos first.")
    sides = [side for side in size if side is not None]
    if min(sides, default=1) < 1 or max(sides, default=1) > MAX_SIDE:
        faults.append(f"its images have {width}x{height} pixels; give their size.")
    if faults or k is None or given is None or rigid is None:
        raise TwofoldError(f"{where}: camera {name}: {faults[0]}")
    # Files round their numbers: the nearest rotation is meant.
    left, _, right = np.linalg.svd(rigid[:3, :3])
    rigid[:3, :3] = left @ right
    return CalibratedCamera(name, k, np.pad(given.ravel()[:5], (0, max(0, 5 - given.size))), rigid, height, width)


def _numbers(value: Any) -> np.ndarray | None:
    """`value` as finite numbers, if it is that."""
    try:
        array = np.array(value)
    except ValueError:  # rows of unequal length
        return None
    return array.astype(np.float64) if array.dtype.kind in "fiu" and are_moderate(array) else None


def _rigid(rotation: np.ndarray, translation: np.ndarray) -> np.ndarray:
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = rotation, translation
    return matrix


def _read_qualisys(path: Path) -> dict[str, CalibratedCamera]:
    """Qualisys' XML: 64 steps to a pixel, millimetres, the rotation from camera to world by columns, y and z backwards.

    The distortion is taken as it stands: OpenCV's coefficients. Pose2Sim divides them by 64 as well, which leaves
    nothing of them; taken as they stand, the straight edges in Pose2Sim's own videos become straighter.
    """
    text = _text(path)
    if "<!DOCTYPE" in text or "<!ENTITY" in text:
        raise TwofoldError(f"{path} defines entities of its own, which are never followed; take them out.")
    try:
        # As text, so that no other encoding is believed that it may claim.
        root = ET.fromstring(text.lstrip("\ufeff \t\r\n"))
    except (ET.ParseError, LookupError, ValueError) as error:
        raise TwofoldError(f"{path} is no valid XML ({error}); export the calibration again.") from error
    cameras: dict[str, CalibratedCamera] = {}
    for entry in root.iter("camera"):
        if entry.get("active", "1") == "0":
            continue
        name = shown_path(entry.get("serial", ""), _MAX_NAME)
        m = _attributes(path, name, entry, "transform", [f"r{i}{j}" for i in "123" for j in "123"]).reshape(3, 3)
        center = _attributes(path, name, entry, "transform", list("xyz")) / 1000
        keys = ["focalLengthU", "focalLengthV", "centerPointU", "centerPointV", "skew"]
        fx, fy, cx, cy, skew = _attributes(path, name, entry, "intrinsic", keys) / _QUALISYS
        left, top, right, bottom = _attributes(path, name, entry, "fov_video", ["left", "top", "right", "bottom"])
        keys = [
            f"{kind}Distortion{i}" for kind, i in (("radial", 1), ("radial", 2), ("tangental", 1), ("tangental", 2))
        ]
        distortion = _attributes(path, name, entry, "intrinsic", [*keys, "radialDistortion3"])
        rotation: Float[np.ndarray, "3 3"] = np.array([[1.0], [-1.0], [-1.0]]) * m
        intrinsics = np.array([[fx, skew, cx - left], [0, fy, cy - top], [0, 0, 1]])
        size = round(bottom - top) + 1, round(right - left) + 1
        cameras[name] = _camera(str(path), name, intrinsics, distortion, _rigid(rotation, rotation @ -center), size)
    return cameras


def _attributes(path: Path, camera: str, entry: ET.Element, tag: str, keys: list[str]) -> np.ndarray:
    child = entry.find(tag)
    try:
        numbers = np.array([float((child.attrib if child is not None else {})[key]) for key in keys])
        if not are_moderate(numbers):
            raise ValueError("not finite")
        return numbers
    except (KeyError, ValueError) as error:
        raise TwofoldError(
            f"{path}: camera {camera or '?'}: {tag} should give {', '.join(keys)} as numbers; export it again."
        ) from error


def _read_opencv(path: Path) -> dict[str, CalibratedCamera]:
    """EasyMocap's pair of files: K_name, dist_name, perhaps H_name and W_name; Rot_name or R_name, T_name."""
    folder = path if path.is_dir() else path.parent
    files = [_sibling(folder, stem) for stem in ("intri", "extri")]
    values = parse_opencv(_text(files[0])) | parse_opencv(_text(files[1]))
    listed = values.get("names")
    names = [key[2:] for key in values if key.startswith("K_") and len(key) <= _MAX_NAME]
    if isinstance(listed, list):
        names = [shown_path(name, _MAX_NAME) for name in listed]
    cameras: dict[str, CalibratedCamera] = {}
    for name in names:
        place = str(folder)
        rotation = _numbers(values.get(f"Rot_{name}"))
        turn, translation = _numbers(values.get(f"R_{name}")), _numbers(values.get(f"T_{name}"))
        if rotation is None and turn is not None:
            rotation = turn if turn.shape == (3, 3) else None
            rotation = Rotation.from_rotvec(turn.ravel()).as_matrix() if turn.size == 3 else rotation
        if f"K_{name}" not in values or rotation is None or rotation.shape != (3, 3):
            raise TwofoldError(
                f"{place}: camera {name}: intri.yml should give K_{name}, extri.yml Rot_{name}; add them."
            )
        if translation is None or translation.size != 3:
            raise TwofoldError(f"{place}: camera {name}: extri.yml should give T_{name}, 3 numbers; add it.")
        height, width = (_whole(values.get(f"{key}_{name}")) for key in "HW")
        distortion = values.get(f"dist_{name}", values.get(f"D_{name}", np.zeros(5)))
        rigid = _rigid(rotation, translation.ravel())
        cameras[name] = _camera(place, name, values[f"K_{name}"], distortion, rigid, (height, width))
    return cameras


def _sibling(folder: Path, stem: str) -> Path:
    for ending in (".yml", ".yaml"):
        if (folder / f"{stem}{ending}").exists():
            return folder / f"{stem}{ending}"
    raise TwofoldError(f"{folder} lacks {stem}.yml; EasyMocap's calibration is intri.yml and extri.yml side by side.")


def _whole(value: Any) -> int | None:
    numbers = _numbers(value)
    return round(float(numbers.item())) if numbers is not None and numbers.size == 1 else None


_KEY = re.compile(r"""^["']?([^\s"':#%-][^"':]*)["']?\s*:(?:\s+(.*))?$""")


def parse_opencv(text: str) -> dict[str, np.ndarray | list[str] | float | str]:
    r"""What OpenCV's FileStorage wrote as YAML: matrices, lists of names, numbers and words, by key.

    >>> parse_opencv("%YAML:1.0\n---\nnames:\n  - '01'\nT_01: !!opencv-matrix\n  rows: 1\n  cols: 2\n  data: [1., 2.]")
    {'names': ['01'], 'T_01': array([[1., 2.]])}
    """
    blocks: dict[str, list[str]] = {}
    lines: list[str] = []
    for line in text.lstrip("\ufeff").splitlines():
        if line.startswith(("%", "---", "...", "#")) or not line.strip():
            continue
        key = _KEY.match(line)
        if key:
            lines = blocks.setdefault(key[1].strip(), [])
            lines.clear()
            lines.append(key[2] or "")
        else:
            lines.append(line.strip())
    return {key: _value("\n".join(block).strip()) for key, block in blocks.items()}


def _value(text: str) -> np.ndarray | list[str] | float | str:
    if text.startswith("!!opencv-matrix"):
        size = [re.search(rf"^{key}:\s*(\d{{1,9}})\b", text, re.MULTILINE) for key in ("rows", "cols")]
        data = re.search(r"data:\s*\[(.*?)\]", text, re.DOTALL)
        numbers = [_number(word) for word in re.split(r"[,\s]+", data[1].strip())] if data else []
        rows, columns = (int(match[1]) if match else 0 for match in size)
        whole = rows * columns == len(numbers) and all(isinstance(number, float) for number in numbers)
        return np.array(numbers, dtype=np.float64).reshape(rows, columns) if whole else text
    if text.startswith("["):
        return [_bare(word) for word in text.strip("[]").split(",") if word.strip()]
    if text.startswith("- "):
        return [_bare(word) for word in re.findall(r"^-\s+(.*)$", text, re.MULTILINE)]
    return _number(text) if not text.startswith(("'", '"')) else _bare(text)


def _number(word: str) -> float | str:
    try:
        return float(re.sub(r"^([+-]?)\.(nan|inf)$", r"\1\2", word.strip(), flags=re.IGNORECASE))
    except ValueError:
        return word


def _bare(word: str) -> str:
    return word.strip().strip("'\"")


def _read_toml(path: Path) -> dict[str, CalibratedCamera]:
    """Pose2Sim's Calib.toml: one table a camera; Rodrigues rotation and translation from world to camera, metres."""
    tables = read_toml(path)
    cameras: dict[str, CalibratedCamera] = {}
    for key, table in tables.items():
        if not isinstance(table, dict) or "matrix" not in table:
            continue
        name = shown_path(str(table.get("name", key)), _MAX_NAME)
        if table.get("fisheye"):
            raise TwofoldError(f"{path}: camera {name} is a fisheye lens; undistort its video first.")
        turn, translation, size = (_numbers(table.get(k)) for k in ("rotation", "translation", "size"))
        if turn is None or turn.size != 3 or translation is None or translation.size != 3:
            raise TwofoldError(f"{path}: camera {name} should have rotation and translation, 3 numbers each; add them.")
        shape = (None, None) if size is None or size.size != 2 else (round(size[1]), round(size[0]))
        rigid = _rigid(Rotation.from_rotvec(turn.ravel()).as_matrix(), translation.ravel())
        distortion = table.get("distortions", [0.0] * 5)
        cameras[name] = _camera(str(path), name, table["matrix"], distortion, rigid, shape)
    return cameras


def _read_json(path: Path) -> dict[str, CalibratedCamera]:
    """Our own: "cameras" as in capture.json, each with "distortion" (five numbers) where its lens has some."""
    content = read_json(path)
    entries = content.get("cameras") if isinstance(content, dict) else None
    if not isinstance(entries, dict):
        raise TwofoldError(f'{path} should hold "cameras" by name, as capture.json does; add them.')
    cameras: dict[str, CalibratedCamera] = {}
    for key, entry in entries.items():
        name = shown_path(key, _MAX_NAME)
        given = entry if isinstance(entry, dict) else {}
        height, width = (given.get(key) if type(given.get(key)) is int else None for key in ("height", "width"))
        distortion = given.get("distortion", [0.0] * 5)
        cameras[name] = _camera(
            str(path), name, given.get("intrinsics"), distortion, given.get("world_to_camera"), (height, width)
        )
    return cameras
