"""One HDF5 file of the paper's pipeline, of any of its three kinds, as cameras and poses of each image."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from twofold.body.skeleton import PARENTS, Body, joint_transforms
from twofold.capture.readers.body_placement import as_rows, from_pelvis
from twofold.capture.readers.hdf5_files import has_all, opened_hdf5, require_rows, small_array
from twofold.capture.readers.sequence import SourceCamera, camera_of, numbers, require_radians
from twofold.capture.readers.shape_fit import fit_betas, require_joints
from twofold.capture.readers.vid2avatar_folder import split_projection
from twofold.capture.readers.zju_files import require_shapes, root_joint
from twofold.errors import TwofoldError
from twofold.geometry.rotations import matrix_to_axis_angle

_OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])
"""OpenGL's camera axes (y up, looking along -z) to OpenCV's."""
_SAME_JOINTS = 0.02
"""Metres by which posed joints may differ from those stored."""


@dataclass(frozen=True)
class Part:
    """What a file says of each of its images.

    Attributes:
        path: of the file.
        kind: "vid2avatar", "humannerf" or "npc".
        image_name: of the array of images.
        mask_name: of that of masks.
        size: rows and columns.
        names: of the images.
        intrinsics: pixels.
        views: world to camera, metres; each image has a world of its own.
        poses: axis-angle, root first, radians.
        translations: SMPL's own, metres.
        betas: shape coefficients.
    """

    path: Path
    kind: str
    image_name: str
    mask_name: str
    size: tuple[int, int]
    names: tuple[str, ...]
    intrinsics: Float[np.ndarray, "n 3 3"]
    views: Float[Tensor, "n 4 4"]
    poses: Float[Tensor, "n 24 3"]
    translations: Float[Tensor, "n 3"]
    betas: Float[Tensor, "S"]


@dataclass(frozen=True)
class _Motion:
    cameras: list[SourceCamera]
    poses: Float[Tensor, "n 24 3"]
    translations: Float[Tensor, "n 3"]
    betas: Float[Tensor, "S"]


def read_part(path: Path, body: Body, remarks: list[str]) -> Part:
    """Everything but the images.

    Raises:
        TwofoldError: the file is damaged, of no known kind, or does not agree with itself.
    """
    with opened_hdf5(path) as file:
        kind = next((name for name, (keys, _) in KINDS.items() if has_all(file, keys)), None)
        if kind is None:
            there = ", ".join(sorted(file.keys())[:12]) or "nothing"
            raise TwofoldError(
                f"{path} is no file of the paper's pipeline: it holds {there}, expected images with cameras and poses, "
                "cameras_K and meshes_pose, or c2ws and skts."
            )
        motion = KINDS[kind][1](file, path, body, remarks)
        images = "imgs" if kind == "npc" else "images"
        height, width = _size(file, path, len(motion.cameras))
        require_rows(file, images, len(motion.cameras), (height, width, 3), path)
        require_rows(file, "masks", len(motion.cameras), (height, width, 1), path)
        names = _names(file, path, len(motion.cameras))
    return Part(
        path, kind, images, "masks", (height, width), names, np.stack([c.intrinsics for c in motion.cameras]),
        torch.from_numpy(np.stack([c.world_to_camera for c in motion.cameras])), motion.poses, motion.translations,
        motion.betas,
    )  # fmt: skip


def _array(file: Any, name: str, shape: tuple[int | None, ...], path: Path) -> Float[np.ndarray, "..."]:
    return numbers(small_array(file, name, path), shape, name, path)


def _poses(file: Any, name: str, rows: int | None, path: Path) -> Float[Tensor, "n 24 3"]:
    poses = _array(file, name, (rows, 72), path)
    require_radians(poses, path)
    return as_rows(torch.from_numpy(poses))


def _vid2avatar(file: Any, path: Path, body: Body, remarks: list[str]) -> _Motion:
    """Cameras as products of intrinsics and world-to-camera, metres; the body in SMPL's own placement."""
    poses = _poses(file, "poses", None, path)
    count = len(poses)
    translations = torch.from_numpy(_array(file, "normalize_trans", (count, 3), path))
    betas = torch.from_numpy(_array(file, "mean_shape", (None,), path))
    require_shapes(body, len(betas), path)
    products = _array(file, "cameras", (count, 4, 4), path)
    cameras = [split_projection(matrix, f"camera {i} in {path}") for i, matrix in enumerate(products)]
    if "joints" in file:
        _require_joints(body, betas, poses, translations, _array(file, "joints", (count, 24, 3), path), path)
    return _Motion(cameras, poses, translations, betas)


def _humannerf(file: Any, path: Path, body: Body, remarks: list[str]) -> _Motion:
    """Intrinsics and extrinsics apart; the body placed about the pelvis."""
    poses = _poses(file, "meshes_pose", None, path)
    count = len(poses)
    turns, shifts = (torch.from_numpy(_array(file, f"meshes_{key}", (count, 3), path)) for key in ("Rh", "Th"))
    require_radians(turns.numpy(), path)
    betas = torch.from_numpy(_array(file, "smpl_shape", (None,), path))
    require_shapes(body, len(betas), path)
    rest = _array(file, "meshes_tpose_joints", (count, 24, 3), path)
    require_joints(body, betas, torch.from_numpy(rest.mean(0)), path)
    intrinsics = _array(file, "cameras_K", (count, 4, 4), path)[:, :3, :3]
    views = _array(file, "cameras_E", (count, 4, 4), path)
    cameras = [camera_of(intrinsics[i], views[i], None, f"{path}, image {i}") for i in range(count)]
    root, translations = from_pelvis(turns, shifts, poses[:, 0], root_joint(body, betas))
    return _Motion(cameras, torch.cat([root[:, None], poses[:, 1:]], 1), translations, betas)


def _npc(file: Any, path: Path, body: Body, remarks: list[str]) -> _Motion:
    """Camera-to-world in OpenGL's axes; poses as world-to-bone transforms, the shape as a rest pose.

    `bones`, the axis-angle vectors, are not used: the pipeline writes the root's into all rows.
    """
    to_bones = _array(file, "skts", (None, 24, 4, 4), path)
    poses = len(to_bones)
    to_world = _array(file, "c2ws", (None, 4, 4), path)
    count = len(to_world)
    focals, centers = (_array(file, name, (count, 2), path) for name in ("focals", "centers"))
    cameras: list[SourceCamera] = []
    for i in range(count):
        k = np.array([[focals[i, 0], 0, centers[i, 0]], [0, focals[i, 1], centers[i, 1]], [0, 0, 1]])
        cameras.append(camera_of(k, _inverse(to_world[i] @ _OPENGL, f"c2ws {i}", path), None, f"{path}, image {i}"))
    index = np.arange(count)
    if "img_pose_indices" in file:
        index = _array(file, "img_pose_indices", (count,), path).astype(np.int64)
    elif poses != count:
        raise TwofoldError(f"{path} has {poses} poses for {count} images and no img_pose_indices; write it anew.")
    if index.min(initial=0) < 0 or index.max(initial=0) >= poses:
        raise TwofoldError(f"img_pose_indices in {path} name poses outside 0..{poses - 1}; the file is damaged.")
    betas = fit_betas(body, torch.from_numpy(_array(file, "rest_pose", (24, 3), path)), path)
    to_world_bones = np.stack([[_inverse(m, "skts", path) for m in pose] for pose in to_bones])
    turned = torch.from_numpy(to_world_bones[..., :3, :3].copy())
    above = turned[:, list(PARENTS[1:])]
    local = torch.cat([turned[:, :1], above.transpose(-1, -2) @ turned[:, 1:]], 1)
    axis_angle = matrix_to_axis_angle(local)
    translations = torch.from_numpy(to_world_bones[:, 0, :3, 3].copy()) - root_joint(body, betas)
    if "kp3d" in file:
        _require_joints(body, betas, axis_angle, translations, _array(file, "kp3d", (poses, 24, 3), path), path)
    remarks.append(f"{path.name} stores no betas; they are fitted to its rest pose.")
    return _Motion(cameras, axis_angle[index], translations[index], betas)


KINDS: dict[str, tuple[tuple[str, ...], Callable[[Any, Path, Body, list[str]], _Motion]]] = {
    "vid2avatar": (("images", "cameras", "poses"), _vid2avatar),
    "humannerf": (("images", "cameras_K", "meshes_pose"), _humannerf),
    "npc": (("imgs", "c2ws", "skts"), _npc),
}
"""For each kind the arrays by which it is known, and its reader."""


def _inverse(matrix: Float[np.ndarray, "4 4"], what: str, path: Path) -> Float[np.ndarray, "4 4"]:
    rotation: Float[np.ndarray, "3 3"] = matrix[:3, :3]
    off = np.subtract(rotation @ rotation.T, np.eye(3))
    if np.abs(off).max() > 1e-2 or np.linalg.det(rotation) < 0:
        raise TwofoldError(f"{what} in {path} is no rigid transform; get the file again.")
    u, _, v = np.linalg.svd(rotation)
    inverse = np.eye(4)
    inverse[:3, :3] = (u @ v).T
    inverse[:3, 3] = np.negative(inverse[:3, :3] @ matrix[:3, 3])
    return inverse


def _require_joints(
    body: Body,
    betas: Float[Tensor, "S"],
    poses: Float[Tensor, "n 24 3"],
    translations: Float[Tensor, "n 3"],
    stored: Float[np.ndarray, "n 24 3"],
    path: Path,
) -> None:
    """Refuses a body whose posed joints are not those that are stored.

    Raises:
        TwofoldError: they are off by more than two centimetres.
    """
    rest = body.joints.double() + body.joint_basis.double()[..., : len(betas)] @ betas
    transforms = joint_transforms(rest, poses, translations)
    joints = (transforms[..., :3, :3] @ rest[:, :, None])[..., 0] + transforms[..., :3, 3]
    off = float((joints - torch.from_numpy(stored)).norm(dim=-1).max())
    if off > _SAME_JOINTS:
        raise TwofoldError(
            f"The body's joints are {100 * off:.0f} cm from those stored in {path}; name the SMPL file that it was "
            "made with by --body (of ZJU-MoCap the neutral one)."
        )


def _size(file: Any, path: Path, count: int) -> tuple[int, int]:
    shape = _array(file, "img_shape", (4,), path)
    rows = [int(n) for n in shape]
    if rows[0] != count or rows[3] != 3 or min(rows) < 1 or max(rows[1:3]) > 32_768:
        raise TwofoldError(f"img_shape in {path} should be {count}, rows, columns, 3; it is {rows}.")
    return rows[1], rows[2]


def _names(file: Any, path: Path, count: int) -> tuple[str, ...]:
    if "frames_name" not in file:
        return tuple(str(i) for i in range(count))
    found = small_array(file, "frames_name", path).ravel()
    if len(found) != count or found.dtype.kind != "S":
        raise TwofoldError(f"frames_name in {path} should hold {count} names; it holds {len(found)} of {found.dtype}.")
    return tuple(name.decode("utf-8", "replace") for name in found.tolist())
