"""The HDF5 files of the paper's own pipeline: one for training, and beside it those for novel views and novel poses.

Three kinds are read: in Vid2Avatar's manner (the one that trains the paper's method), in HumanNeRF's, and in NPC's. In
all of them every image has a world of its own. The training camera is put to rest; the cameras of the other files are
found through the body, which stands in the same pose in all images of one frame.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from twofold.capture.readers.hdf5_files import image_row, is_hdf5
from twofold.capture.readers.hdf5_kinds import Part, read_part
from twofold.capture.readers.sequence import ReadOptions, Sequence3D, SourceCamera, SourceImage, at_rest
from twofold.capture.readers.zju_files import root_joint
from twofold.capture.readers.zju_raw import subject_of
from twofold.errors import TwofoldError
from twofold.geometry.rotations import axis_angle_to_matrix, rigid_inverse, rigid_transform

_TRAINING = "training"
_ENDINGS = (".h5", ".hdf5")
_SAME_POSE = 1e-3
"""Radians: the pose of a frame is the same in all its images, but for rounding."""
_SAME_VIEW = 5e-3
"""Metres, and elements of a rotation."""


@dataclass(frozen=True)
class _World:
    """The motion in the training camera's world, and the cameras found so far."""

    poses: Float[Tensor, "t 24 3"]
    translations: Float[Tensor, "t 3"]
    cameras: dict[str, SourceCamera]


def recognizes(source: Path) -> bool:
    """Whether it is one of these files, or a folder with one."""
    return is_hdf5(source) or bool(_training_files(source))


def _training_files(folder: Path) -> list[Path]:
    if not folder.is_dir():
        return []
    return sorted(f for f in folder.iterdir() if f.suffix in _ENDINGS and _TRAINING in f.name)


def read(source: Path, options: ReadOptions) -> Sequence3D:
    """Reads cameras and motion, and notes where the images lie.

    Raises:
        TwofoldError: a file is damaged, lacks an array, or does not belong to the others.
    """
    path = source if source.is_file() else _only(_training_files(source), source)
    remarks: list[str] = []
    training = read_part(path, options.body, remarks)
    joint = root_joint(options.body, training.betas)
    count = len(training.poses)
    rest, poses, translations = at_rest(training.views, training.poses, training.translations, joint)
    world = _World(poses, translations, {})
    images: dict[tuple[str, int], SourceImage] = {}
    splits: dict[str, dict[str, list[int]]] = {"train": {}, "novel_view": {}, "novel_pose": {}}
    for frame in range(count):
        name = _camera(world.cameras, training.intrinsics[frame], rest)
        images[name, frame] = _image(training, frame)
        splits["train"].setdefault(name, []).append(frame)
    view_file, pose_file = (_beside(path, part) for part in ("novel_view", "novel_pose"))
    names: list[str] = []
    if view_file is not None:
        names = _add_views(read_part(view_file, options.body, remarks), world, joint, images, splits["novel_view"])
    if pose_file is not None and names:
        part = read_part(pose_file, options.body, remarks)
        world = _add_poses(part, world, names, joint, images, splits["novel_pose"])
    elif pose_file is not None:
        remarks.append(f"{pose_file.name} is left out: where its cameras stand is known by novel_view only.")
    if view_file is None:
        remarks.append(f"No file of novel views lies beside {path.name}, so there is nothing to test on.")
    return Sequence3D(
        name=path.stem, reader="hdf5", betas=training.betas, poses=world.poses, translations=world.translations,
        cameras=world.cameras, images=images, subject=subject_of(Path(path.stem.split("_")[0])),
        total=count, splits=splits, frame_names=training.names, remarks=remarks,
        notes={"kind": training.kind},
    )  # fmt: skip


def _only(files: list[Path], folder: Path) -> Path:
    if len(files) == 1:
        return files[0]
    raise TwofoldError(f"{folder} holds several training files ({files[0].name}, {files[1].name}); name one of them.")


def _beside(path: Path, part: str) -> Path | None:
    """The file of another part: the name with "training" replaced, also in the names of folders."""
    if _TRAINING not in path.name:
        return None
    candidates = (path.with_name(path.name.replace(_TRAINING, part)), Path(str(path).replace(_TRAINING, part)))
    return next((found for found in candidates if found.is_file()), None)


def _image(part: Part, index: int) -> SourceImage:
    return SourceImage(f"image {index} of {part.path}", partial(_read_image, part, index))


def _read_image(part: Part, index: int) -> tuple[UInt8[np.ndarray, "h w 3"], UInt8[np.ndarray, "h w"]]:
    mask = image_row(part.path, part.mask_name, index, (*part.size, 1))[..., 0]
    return image_row(part.path, part.image_name, index, (*part.size, 3)), np.where(
        mask != 0, np.uint8(255), np.uint8(0)
    )


def _camera(cameras: dict[str, SourceCamera], intrinsics: Float[np.ndarray, "3 3"], view: Float[Tensor, "4 4"]) -> str:
    """The name of a camera, which may have been new."""
    matrix = view.numpy()
    for name, known in cameras.items():
        same = np.abs(known.world_to_camera - matrix).max() < _SAME_VIEW
        if same and np.abs(known.intrinsics - intrinsics).max() < 1e-4 * intrinsics[0, 0]:
            return name
    name = f"cam_{len(cameras):02d}"
    cameras[name] = SourceCamera(intrinsics, None, matrix)
    return name


def _root_frame(
    pose: Float[Tensor, "24 3"], translation: Float[Tensor, "3"], joint: Float[Tensor, "3"]
) -> Float[Tensor, "4 4"]:
    """The pelvis in the world: its rotation and place."""
    return rigid_transform(axis_angle_to_matrix(pose[0]), joint + translation)


def _add_views(
    part: Part,
    world: _World,
    joint: Float[Tensor, "3"],
    images: dict[tuple[str, int], SourceImage],
    split: dict[str, list[int]],
) -> list[str]:
    """Images of training frames by other cameras; returns these cameras in their order."""
    names: list[str] = []
    for index in range(len(part.poses)):
        off = (world.poses[:, 1:] - part.poses[index, 1:]).abs().amax((1, 2))
        frame = int(off.argmin())
        if float(off[frame]) > _SAME_POSE:
            raise TwofoldError(
                f"Image {index} of {part.path} shows a pose that no training frame has; the files belong to different "
                "recordings."
            )
        shown = part.views[index] @ _root_frame(part.poses[index], part.translations[index], joint)
        view = shown @ rigid_inverse(_root_frame(world.poses[frame], world.translations[frame], joint))
        name = _camera(world.cameras, part.intrinsics[index], view)
        if name not in names:
            names.append(name)
        if (name, frame) in images:
            raise TwofoldError(f"{part.path} shows frame {frame} twice by one camera; the file is damaged.")
        images[name, frame] = _image(part, index)
        split.setdefault(name, []).append(frame)
    return names


def _add_poses(
    part: Part,
    world: _World,
    names: Sequence[str],
    joint: Float[Tensor, "3"],
    images: dict[tuple[str, int], SourceImage],
    split: dict[str, list[int]],
) -> _World:
    """Frames after the training ones, each seen by all cameras of the novel views in their order."""
    count = len(names)
    if len(part.poses) % count:
        raise TwofoldError(
            f"{part.path} has {len(part.poses)} images, no multiple of the {count} cameras of the novel views; the "
            "files belong to different recordings."
        )
    poses, translations = [world.poses], [world.translations]
    for start in range(0, len(part.poses), count):
        frame = len(world.poses) + start // count
        group = range(start, start + count)
        if float((part.poses[start : start + count, 1:] - part.poses[start, 1:]).abs().max()) > _SAME_POSE:
            raise TwofoldError(
                f"Images {start} to {start + count - 1} of {part.path} should show one frame by {count} cameras, their "
                "poses differ; the files belong to different recordings."
            )
        rest = torch.from_numpy(world.cameras[names[0]].world_to_camera)
        _, pose, translation = at_rest(
            part.views[start : start + 1], part.poses[start : start + 1], part.translations[start : start + 1], joint,
            rest,
        )  # fmt: skip
        root = rigid_inverse(_root_frame(pose[0], translation[0], joint))
        for name, index in zip(names, group, strict=True):
            view = part.views[index] @ _root_frame(part.poses[index], part.translations[index], joint) @ root
            if float((view - torch.from_numpy(world.cameras[name].world_to_camera)).abs().max()) > 10 * _SAME_VIEW:
                raise TwofoldError(
                    f"Image {index} of {part.path} was not taken by the camera of novel views that is due; the files "
                    "belong to different recordings."
                )
            images[name, frame] = _image(part, index)
            split.setdefault(name, []).append(frame)
        poses.append(pose)
        translations.append(translation)
    return _World(torch.cat(poses), torch.cat(translations), world.cameras)
