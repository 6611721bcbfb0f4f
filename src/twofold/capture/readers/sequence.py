"""What every reader of a foreign data set gives: cameras, a motion of SMPL's joints, images read when wanted."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from twofold.body.skeleton import Body
from twofold.capture.readers.body_placement import moved_world
from twofold.errors import TwofoldError
from twofold.geometry.rotations import rigid_inverse
from twofold.images import read_grey, read_rgb
from twofold.npz import are_moderate

Split = Mapping[str, Mapping[str, Sequence[int]]]
"""For "train", "novel_view" and "novel_pose" the frames that each camera shows."""
MaskChoice = Literal["union", "mask", "mask_cihp"]
_FARTHEST = 500.0
"""Metres from the world's origin to a camera; estimators with very long lenses place people 100 metres away."""
_SAME = 1e-4
"""Camera matrices that differ by less (metres, pixels over the focal length) are the same."""


@dataclass(frozen=True)
class SourceCamera:
    """A camera at rest, as a data set describes it (OpenCV: x right, y down, z forward).

    Attributes:
        intrinsics: pixels.
        distortion: OpenCV's k1, k2, p1, p2, k3; None where images are undistorted already.
        world_to_camera: rigid, metres.
    """

    intrinsics: Float[np.ndarray, "3 3"]
    distortion: Float[np.ndarray, "5"] | None
    world_to_camera: Float[np.ndarray, "4 4"]


@dataclass(frozen=True)
class SourceImage:
    """One image of a data set with its mask.

    Attributes:
        where: its name, for the sentences.
        read: its colours (8-bit sRGB) and its mask (0 outside .. 255 on the person), as they lie in the data set.
    """

    where: str
    read: Callable[[], tuple[UInt8[np.ndarray, "h w 3"], UInt8[np.ndarray, "h w"]]]


@dataclass(frozen=True)
class ReadOptions:
    """What the user says about a data set.

    Attributes:
        body: the body model of its poses.
        masks: which of ZJU-MoCap's masks are taken.
        frames: how many frames of a raw recording are needed, from the first one; None for all.
    """

    body: Body
    masks: MaskChoice = "union"
    frames: int | None = None


@dataclass(frozen=True)
class Sequence3D:
    """A data set as it was read; nothing of its images is in memory.

    Attributes:
        name: for titles.
        reader: the format's name.
        betas: SMPL's shape coefficients of this person.
        poses: of every frame; axis-angle, root first, radians.
        translations: SMPL's own, metres.
        cameras: by name, in the data set's order; the first one trains.
        images: by camera and frame.
        subject: of ZJU-MoCap, such as "377"; empty where it is not known.
        total: frames of the recording, of which `poses` may be a part.
        gravity: whether an axis of the world points up; else only the person's stance tells.
        splits: where the data set itself is split.
        frame_names: what the data set calls the frames.
        remarks: sentences that the user should know.
        notes: what is worth keeping.
    """

    name: str
    reader: str
    betas: Float[Tensor, "S"]
    poses: Float[Tensor, "t 24 3"]
    translations: Float[Tensor, "t 3"]
    cameras: Mapping[str, SourceCamera]
    images: Mapping[tuple[str, int], SourceImage]
    subject: str = ""
    total: int = 0
    gravity: bool = False
    splits: Split | None = None
    frame_names: Sequence[str] = ()
    remarks: Sequence[str] = ()
    notes: Mapping[str, object] = field(default_factory=dict)


def image_from_files(image: Path, masks: Sequence[Path], labels: bool) -> SourceImage:
    """An image in a file, with the union of the masks in some files.

    Args:
        image: the file.
        masks: at least one file.
        labels: whatever is not 0 is the person (as images of part labels have it); else 0 to 255.
    """

    def read() -> tuple[UInt8[np.ndarray, "h w 3"], UInt8[np.ndarray, "h w"]]:
        colours = read_rgb(image)
        mask = np.zeros(colours.shape[:2], np.uint8)
        for file in masks:
            grey = _labels(file) if labels else read_grey(file)
            if grey.shape != mask.shape:
                raise TwofoldError(
                    f"{file} has {grey.shape[1]} x {grey.shape[0]} pixels, its image {image.name} "
                    f"{mask.shape[1]} x {mask.shape[0]}; give masks of the images' size."
                )
            mask = np.maximum(mask, grey)
        return colours, mask

    return SourceImage(str(image), read)


def _labels(file: Path) -> UInt8[np.ndarray, "h w"]:
    # In colour, because the brightness of label (0, 0, 1) is rounded to 0.
    return np.where((read_rgb(file) != 0).any(-1), np.uint8(255), np.uint8(0))


def numbers(value: object, shape: tuple[int | None, ...], what: str, where: object) -> Float[np.ndarray, "..."]:
    """`value` as an array of finite numbers in double precision.

    Args:
        value: list or array.
        shape: expected; None for any length.
        what: it is called.
        where: it lies.

    Raises:
        TwofoldError: it is something else, has another shape, or holds a number that is not finite.
    """
    words = " x ".join("n" if n is None else str(n) for n in shape) or "one number"
    try:
        array = np.asarray(value)
    except ValueError:  # rows of unequal length
        array = np.asarray(None)
    if array.dtype.kind not in "fiu":
        raise TwofoldError(f"{what} in {where} should be numbers of shape {words}, it is {type(value).__name__}.")
    if len(array.shape) != len(shape) or any(n not in (m, None) for m, n in zip(array.shape, shape, strict=True)):
        found = " x ".join(map(str, array.shape)) or "one number"
        raise TwofoldError(f"{what} in {where} should have the shape {words}, it has {found}.")
    if not are_moderate(array):
        raise TwofoldError(f"{what} in {where} holds a number that is not finite or is huge; get the file again.")
    return array.astype(np.float64)


def require_radians(pose: Float[np.ndarray, "*b 72"] | Float[np.ndarray, "*b 3"], where: object) -> None:
    """Refuses rotations that are given in degrees.

    Raises:
        TwofoldError: a joint is turned by more than two full turns.
    """
    turns = np.linalg.norm(pose.reshape(-1, 3), axis=-1)
    if len(turns) and turns.max() > 4 * np.pi:
        raise TwofoldError(
            f"A joint in {where} is turned by {turns.max():.0f} radians; poses are axis-angle in radians, these look "
            "like degrees."
        )


def camera_of(intrinsics: object, world_to_camera: object, distortion: object | None, where: object) -> SourceCamera:
    """A camera, its matrices checked and its rotation made exactly one.

    Args:
        intrinsics: 3 x 3.
        world_to_camera: 4 x 4.
        distortion: five coefficients, or None.
        where: it lies, for the sentences.

    Raises:
        TwofoldError: a matrix is none of its kind.
    """
    k = numbers(intrinsics, (3, 3), "The intrinsics K", where)
    if min(k[0, 0], k[1, 1]) <= 1 or abs(k[2, 2]) < 1e-9 or np.abs(k[2, :2]).max() > 1e-6 * abs(k[2, 2]):
        raise TwofoldError(
            f"The intrinsics in {where} should be [fx s cx; 0 fy cy; 0 0 1] in pixels, they are {_short(k)}."
        )
    k = k / k[2, 2]
    view = numbers(world_to_camera, (4, 4), "The extrinsics", where)
    rotation = view[:3, :3]
    if np.abs(rotation @ rotation.T - np.eye(3)).max() > 1e-3 or np.linalg.det(rotation) < 0:
        raise TwofoldError(f"The rotation of the camera in {where} is none (or mirrors), it is {_short(rotation)}.")
    u, _, v = np.linalg.svd(rotation)  # Files in single precision are slightly off.
    whole = np.eye(4)
    whole[:3, :3], whole[:3, 3] = u @ v, view[:3, 3]
    if np.linalg.norm(whole[:3, 3]) > _FARTHEST:
        raise TwofoldError(
            f"The camera in {where} stands {np.linalg.norm(whole[:3, 3]):.0f} metres from the world's origin; its "
            "translation looks like millimetres where metres are expected."
        )
    bent = None
    if distortion is not None:
        bent = np.zeros(5)
        given = np.asarray(distortion, np.float64).ravel() if _are_numbers(distortion) else np.full(0, np.nan)
        if len(given) not in (4, 5) or not are_moderate(given):
            raise TwofoldError(f"The distortion in {where} should be k1, k2, p1, p2, k3, it has {len(given)} numbers.")
        bent[: len(given)] = given
    return SourceCamera(k, bent if bent is not None and bent.any() else None, whole)


def _are_numbers(value: object) -> bool:
    try:
        return np.asarray(value).dtype.kind in "fiu"
    except ValueError:
        return False


def _short(matrix: np.ndarray) -> str:
    return "; ".join(" ".join(f"{n:.4g}" for n in row) for row in matrix)


def same_camera(one: SourceCamera, other: SourceCamera) -> bool:
    """Whether two descriptions are of one camera, up to what single precision rounds."""
    focal = one.intrinsics[0, 0]
    bent = [np.zeros(5) if c.distortion is None else c.distortion for c in (one, other)]
    return bool(
        np.abs(one.intrinsics - other.intrinsics).max() < _SAME * focal
        and np.abs(one.world_to_camera - other.world_to_camera).max() < 10 * _SAME
        and np.abs(bent[0] - bent[1]).max() < _SAME
    )


def at_rest(
    views: Float[Tensor, "t 4 4"],
    poses: Float[Tensor, "t 24 3"],
    translations: Float[Tensor, "t 3"],
    joint: Float[Tensor, "3"],
    rest: Float[Tensor, "4 4"] | None = None,
) -> tuple[Float[Tensor, "4 4"], Float[Tensor, "t 24 3"], Float[Tensor, "t 3"]]:
    """One camera for frames that each have their own: the body moves instead, so that no image changes.

    Args:
        views: world to camera, of each frame.
        poses: axis-angle, radians.
        translations: SMPL's own, metres.
        joint: rest position of the root joint, metres.
        rest: the camera that stays; by default that of the first frame.
    """
    rest = views[0] if rest is None else rest
    carry = rigid_inverse(rest) @ views
    root, moved = moved_world(carry[:, :3, :3], carry[:, :3, 3], poses[:, 0], translations, joint)
    return rest, torch.cat([root[:, None], poses[:, 1:]], 1), moved


def mean_betas(betas: Float[np.ndarray, "t S"], remarks: list[str]) -> Float[np.ndarray, "S"]:
    """One shape for one person: the mean over the frames."""
    mean = betas.mean(0)
    off = float(np.abs(betas - mean).max()) if len(betas) else 0.0
    if off > 0.05:
        remarks.append(f"The betas differ from frame to frame by up to {off:.2f}; their mean is taken.")
    return mean
