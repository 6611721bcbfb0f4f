"""Vid2Avatar's preprocessed folders: `image/`, `mask/`, `poses.npy`, `normalize_trans.npy`, `cameras_normalize.npz`.

There the body is moved to the origin in every frame and the camera moves instead, and the world is scaled so that the
camera lies on a ball of radius 3. Both are undone: one camera at rest, metres.
"""

import re
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from scipy.linalg import rq

from twofold.capture.readers.body_placement import as_rows
from twofold.capture.readers.sequence import (
    ReadOptions,
    Sequence3D,
    SourceCamera,
    SourceImage,
    at_rest,
    camera_of,
    image_from_files,
    numbers,
    require_radians,
)
from twofold.capture.readers.zju_files import require_shapes, root_joint
from twofold.errors import TwofoldError
from twofold.images import read_header
from twofold.inputs import is_there
from twofold.npy import read_npy
from twofold.npz import read_npz

IMAGES, MASKS, POSES, TRANSLATIONS, SHAPE = "image", "mask", "poses.npy", "normalize_trans.npy", "mean_shape.npy"
NORMALIZED, METRIC = "cameras_normalize.npz", "cameras.npz"
_ENDINGS = (".png", ".jpg", ".jpeg")


def recognizes(folder: Path) -> bool:
    """Whether it looks like one."""
    cameras = is_there(folder / NORMALIZED) or is_there(folder / METRIC)
    return is_there(folder / IMAGES) and cameras and (is_there(folder / POSES) or is_there(folder / TRANSLATIONS))


def read(folder: Path, options: ReadOptions) -> Sequence3D:
    """Reads cameras and motion, and notes where the images lie.

    Raises:
        TwofoldError: a file is missing or damaged, or they are of different lengths.
    """
    remarks: list[str] = []
    poses = numbers(read_npy(folder / POSES, "poses"), (None, 72), "poses", folder / POSES)
    require_radians(poses, folder / POSES)
    shifts = numbers(
        read_npy(folder / TRANSLATIONS, "translations"), (len(poses), 3), "normalize_trans", folder / TRANSLATIONS
    )
    shape = np.asarray(read_npy(folder / SHAPE, "shape coefficients"))
    betas = torch.from_numpy(numbers(shape.ravel(), (None,), "mean_shape", folder / SHAPE))
    require_shapes(options.body, len(betas), folder / SHAPE)
    files = _sorted_images(folder / IMAGES)
    if len(files) != len(poses):
        raise TwofoldError(
            f"{folder / IMAGES} has {len(files)} images, {folder / POSES} poses of {len(poses)} frames; they belong "
            "together by their order, so give both of one run of the preparation."
        )
    masks = {file.stem: file for file in _sorted_images(folder / MASKS)}
    lacking = [file.name for file in files if file.stem not in masks]
    if lacking:
        raise TwofoldError(f"{folder / MASKS} lacks the masks of {len(lacking)} images ({lacking[0]} and so on).")
    count = len(poses)
    cameras = _cameras(folder, count)
    views = torch.from_numpy(np.stack([camera.world_to_camera for camera in cameras]))
    rest, turned, moved = at_rest(
        views, as_rows(torch.from_numpy(poses)), torch.from_numpy(shifts),
        root_joint(options.body, betas),
    )  # fmt: skip
    if read_header(masks[files[0].stem]).mode != "L":
        remarks.append(
            f"The masks in {folder / MASKS} have three channels, as Vid2Avatar's own: those are widened outlines of "
            "the fitted body, no segmentation. Put masks of the person there for a sharp avatar."
        )
    if (gender := _gender(folder)) is not None:
        remarks.append(f"{folder / 'gender.npy'} says {gender}; --body should name that SMPL file.")
    images: dict[tuple[str, int], SourceImage] = {}
    shown: dict[str, SourceCamera] = {}
    for frame in range(count):
        name = _named(shown, SourceCamera(cameras[frame].intrinsics, None, rest.numpy()))
        images[name, frame] = image_from_files(files[frame], [masks[files[frame].stem]], labels=False)
    return Sequence3D(
        name=folder.resolve().name, reader="vid2avatar", betas=betas, poses=turned, translations=moved,
        cameras=shown, images=images, total=len(poses), remarks=remarks,
        frame_names=[file.stem for file in files], notes={"scale_undone": _scale(folder)},
    )  # fmt: skip


def _named(cameras: dict[str, SourceCamera], camera: SourceCamera) -> str:
    """The name of a camera with these intrinsics, which may have been new."""
    for name, known in cameras.items():
        if np.abs(known.intrinsics - camera.intrinsics).max() < 1e-3:
            return name
    name = "cam" if not cameras else f"cam_lens{len(cameras) + 1}"
    cameras[name] = camera
    return name


def _cameras(folder: Path, count: int) -> list[SourceCamera]:
    """Metric cameras of each frame: `world_mat_i`, or `cam_i`, is K times world-to-camera."""
    file, stem = (NORMALIZED, "world_mat") if is_there(folder / NORMALIZED) else (METRIC, "cam")
    names = [f"{stem}_{i}" for i in range(count)]
    arrays = read_npz(folder / file, names)
    missing = [name for name in names if name not in arrays]
    if missing:
        raise TwofoldError(
            f"{folder / file} lacks {missing[0]} ({len(missing)} of {count} frames); it needs one matrix a frame."
        )
    return [split_projection(arrays[name], f"{name} in {folder / file}") for name in names]


def split_projection(matrix: np.ndarray, where: str) -> SourceCamera:
    """Intrinsics and a rigid world-to-camera out of their product.

    Args:
        matrix: 4 x 4 or 3 x 4, of any scale and sign.
        where: it lies, for the sentences.

    Raises:
        TwofoldError: it is no projection.
    """
    rows = np.asarray(matrix)[:3] if np.ndim(matrix) == 2 else np.asarray(matrix)
    product = numbers(rows, (3, 4), "The projection", where)
    if abs(np.linalg.det(product[:, :3])) < 1e-9:
        raise TwofoldError(f"{where} is no product of intrinsics and a rotation (it is singular); get the file again.")
    product = product * np.sign(np.linalg.det(product[:, :3]))
    upper, rotation = rq(product[:, :3])
    signs = np.diag(np.sign(np.diag(upper)))
    intrinsics, rotation = upper @ signs, signs @ rotation
    view = np.eye(4)
    view[:3, :3] = rotation
    view[:3, 3] = np.linalg.solve(intrinsics, product[:, 3])
    return camera_of(_without_rounding(intrinsics / intrinsics[2, 2]), view, None, where)


def _without_rounding(intrinsics: Float[np.ndarray, "3 3"]) -> Float[np.ndarray, "3 3"]:
    """Without the skew that single precision leaves."""
    if abs(intrinsics[0, 1]) < 1e-3 * intrinsics[0, 0]:
        intrinsics[0, 1] = 0.0
    intrinsics[1, 0] = intrinsics[2, 0] = intrinsics[2, 1] = 0.0
    return intrinsics


def _scale(folder: Path) -> float:
    """By how much lengths were divided; 1 where nothing says."""
    if not is_there(folder / NORMALIZED):
        return 1.0
    arrays = read_npz(folder / NORMALIZED, ["scale_mat_0"])
    found = arrays.get("scale_mat_0")
    return float(found[0, 0]) if found is not None and found.shape == (4, 4) and np.isfinite(found[0, 0]) else 1.0


def _gender(folder: Path) -> str | None:
    """What an extra file says, which Vid2Avatar itself does not write."""
    if not is_there(folder / "gender.npy"):
        return None
    try:
        found = re.search(rb"(female|male|neutral)", (folder / "gender.npy").read_bytes()[:4096].replace(b"\0", b""))
    except OSError:
        return None
    return found[1].decode() if found else None


def _sorted_images(folder: Path) -> list[Path]:
    """Images by name.

    Raises:
        TwofoldError: there are none.
    """
    found = sorted(f for f in folder.iterdir() if f.suffix.lower() in _ENDINGS) if folder.is_dir() else []
    if not found:
        raise TwofoldError(f"{folder} should hold one image a frame (0000.png and so on); it has none.")
    return found
