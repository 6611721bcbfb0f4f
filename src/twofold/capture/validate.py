"""Every fault of a capture folder, found in one go and said in one sentence each.

The quick checks open no pixels; the thorough ones read every image.
"""

from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path
from typing import Literal, NamedTuple, TypeVar

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from twofold.body.skeleton import joint_transforms, shape_body
from twofold.capture.layout import (
    IGNORED,
    IMAGES,
    MASKS,
    MESHES,
    MOTION,
    Contents,
    file_stem,
    numbered_files,
    read_contents,
    spans,
    within_folder,
)
from twofold.errors import TwofoldError
from twofold.geometry.cameras import Camera, project
from twofold.images import read_grey, read_header, read_rgb, require_checksums
from twofold.npz import are_moderate, read_npz

Item = TypeVar("Item")
_IMAGE_MODES, _MASK_MODES = ("RGB", "RGBA", "L"), ("L", "1")
_MEANINGS = {
    IMAGES: "an 8-bit colour image",
    MASKS: "one 8-bit channel, 0 outside and 255 on the person",
    IGNORED: "one 8-bit channel, 255 where nothing is known of the person",
}
_FAR_TOO_SMALL = 0.1
"""A body whose joints span less than this share of its mask is given in other units, or far away."""
_PERSON = 128
"""Masks count as the person from here on, when a whole mask is judged."""


def validate(folder: Path | str) -> list[str]:
    """Everything that is wrong with a capture folder; an empty list if nothing is. Reads every image.

    Each fault is one sentence that says where (files as seen from `folder`), what, and what to do.
    """
    folder, faults = Path(folder), list[str]()
    try:
        contents, faults = read_contents(folder)
        return faults + quick_faults(contents) + pixel_faults(contents) + mesh_faults(folder)
    except TwofoldError as error:  # no capture, or a folder in it that may not be read
        return [*faults, str(error)]


def require(faults: list[str], folder: Path | str, shown: int = 8) -> None:
    """Raises one error that lists the first faults, if there are any.

    Raises:
        TwofoldError: one sentence for one fault; for several a line that says so and one for each of the first `shown`.
    """
    if not faults:
        return
    if len(faults) == 1:
        raise TwofoldError(f"The capture {folder} cannot be used: {faults[0]}")
    lines = [f"The capture {folder} cannot be used, it has {len(faults)} faults:"]
    lines += [f"  - {fault}" for fault in faults[:shown]]
    if len(faults) > shown:
        lines.append(f"  and {len(faults) - shown} more.")
    raise TwofoldError("\n".join(lines))


def quick_faults(contents: Contents) -> list[str]:
    """What files' names, image headers and projected joints show: missing, wrong-sized, behind, outside."""
    faults: list[str] = []
    for camera_name, times in contents.images.items():
        for kind, modes in ((IMAGES, _IMAGE_MODES), (MASKS, _MASK_MODES), (IGNORED, _MASK_MODES)):
            there = contents.files(kind, camera_name)
            missing = [time for time in times if time not in there]
            if missing and kind != IGNORED:
                faults.append(
                    f"{kind}/{camera_name} lacks the images of times {spans(missing)}; "
                    f"add them ({file_stem(missing[0])}.png and so on) or take these times out of the splits."
                )
            if camera_name in contents.cameras:
                paths = [there[time] for time in times if time in there]
                faults += _header_faults(contents.folder, paths, contents.cameras[camera_name], modes, _MEANINGS[kind])
    return faults + _placement_faults(contents)


def _header_faults(folder: Path, paths: list[Path], camera: Camera, modes: tuple[str, ...], meaning: str) -> list[str]:
    def check(path: Path) -> str:
        where = path.relative_to(folder).as_posix()
        try:
            header = read_header(path)
        except TwofoldError as error:
            return within_folder(folder, error)
        if (header.height, header.width) != (camera.height, camera.width):
            return (
                f"{where} has {header.width} x {header.height} pixels, its camera {camera.width} x {camera.height}; "
                "resize one."
            )
        if header.mode not in modes:
            return f"{where} should hold {meaning}; it is of the kind {header.mode}."
        return ""

    return _in_threads(check, paths)


def joint_positions(contents: Contents) -> Float[Tensor, "T 24 3"] | None:
    """Where the joints stand in every frame, world, metres; None where body or motion could not be read."""
    body, betas, poses, translations = contents.body, contents.betas, contents.poses, contents.translations
    if body is None or betas is None or poses is None or translations is None:
        return None
    joints = shape_body(body, betas).joints
    transforms = torch.vmap(joint_transforms, in_dims=(None, 0, 0))(joints, poses, translations)
    return (transforms[..., :3, :3] @ joints[:, :, None])[..., 0] + transforms[..., :3, 3]


def _placement_faults(contents: Contents) -> list[str]:
    """Cameras that have the body behind them or beside their image."""
    joints = joint_positions(contents)
    if joints is None:
        return []
    faults: list[str] = []
    for name, times in contents.images.items():
        camera = contents.cameras.get(name)
        shown = [time for time in times if time < len(joints)]
        if camera is None or not shown:
            continue
        pixels, depths = project(camera, joints[shown])
        behind = (depths <= 0).any(-1)
        outside = ~behind & ~_in_picture(pixels, camera).any(-1)
        if behind.any():
            faults.append(
                f"Camera {name} has the body behind it at times {spans(_where(shown, behind))}; check world_to_camera "
                f"(not its inverse; x right, y down, z forward) and the translations in {MOTION} (metres)."
            )
        if outside.any():
            faults.append(
                f"The body is outside the image of camera {name} at times {spans(_where(shown, outside))}; "
                f"check its intrinsics (pixels) and the translations in {MOTION} (metres)."
            )
    return faults


def pixel_faults(contents: Contents) -> list[str]:
    """What only the pixels show: damaged images, empty or full masks, masks that the body is nowhere near."""
    joints = joint_positions(contents)
    faults: list[str] = []
    for name, times in contents.images.items():
        images, masks = contents.files(IMAGES, name), contents.files(MASKS, name)
        shown, size = dict[int, ShownJoints](), (0, 0)
        if name in contents.cameras:
            camera = contents.cameras[name]
            size = (camera.height, camera.width)
            shown = {} if joints is None else _shown_joints(joints, camera)
        faults += _in_threads(partial(_decoding_fault, contents.folder), [images[t] for t in times if t in images])
        with_joints = [(masks[t], shown.get(t)) for t in times if t in masks]
        faults += _in_threads(partial(_mask_fault, contents.folder, size), with_joints)
        ignored = contents.files(IGNORED, name)
        pairs = [(ignored[t], masks[t]) for t in times if t in ignored and t in masks]
        faults += _in_threads(partial(_ignored_fault, contents.folder), pairs)
    return faults


class ShownJoints(NamedTuple):
    """Pixels (column, row) of the joints inside an image, and how far all of them reach, pixels."""

    inside: np.ndarray
    reach: float


def _shown_joints(joints: Float[Tensor, "T 24 3"], camera: Camera) -> dict[int, ShownJoints]:
    """By time."""
    pixels, depths = project(camera, joints)
    inside = _in_picture(pixels, camera) & (depths > 0)
    reach = (pixels.amax(1) - pixels.amin(1)).amax(-1)
    return {time: ShownJoints(pixels[time][inside[time]].numpy(), float(reach[time])) for time in range(len(joints))}


def _decoded(folder: Path, path: Path, mode: Literal["L", "RGB"]) -> tuple[np.ndarray | None, str]:
    """An image's pixels, or None and what is wrong with them; that is empty where a quick check has named it.

    Checksums alone would cost a tenth, but there are images whose checksums are right and whose pixels are not there,
    as there are some whose pixels can be decoded although a few are wrong.
    """
    try:
        read_header(path)
    except TwofoldError:
        return None, ""
    try:
        require_checksums(path)
        return (read_rgb if mode == "RGB" else read_grey)(path), ""
    except TwofoldError as error:
        return None, within_folder(folder, error)


def _decoding_fault(folder: Path, path: Path) -> str:
    return _decoded(folder, path, "RGB")[1]


def _mask_fault(folder: Path, size: tuple[int, int], item: tuple[Path, ShownJoints | None]) -> str:
    """What is wrong with one mask.

    Args:
        folder: the capture's.
        size: height and width that it should have.
        item: its file, and the joints in the image, None where they are not known.
    """
    path, joints = item
    mask, damaged = _decoded(folder, path, "L")
    if mask is None:
        return damaged
    where = path.relative_to(folder).as_posix()
    if mask.max() == 0:
        return f"{where} is all black, so nobody is there; fix it or take this time out of the splits."
    if mask.max() < _PERSON:
        return f"{where} reaches only {mask.max()}; the person should be 255."
    if mask.min() >= _PERSON:
        return f"{where} is all white, as if the person filled the image; fix it or take this time out of the splits."
    columns, rows = np.flatnonzero((mask >= _PERSON).any(0)), np.flatnonzero((mask >= _PERSON).any(1))
    if joints is not None and len(joints.inside) and mask.shape == size:
        low, high = np.array([columns[0], rows[0]]), np.array([columns[-1], rows[-1]])
        if not ((joints.inside >= low) & (joints.inside <= high)).all(-1).any():
            return f"{where} and the posed body do not meet; check that mask, pose and camera are of the same frame."
        tall = float((high - low).max())
        if joints.reach < _FAR_TOO_SMALL * tall:
            return (
                f"{where} shows a person of {tall:.0f} pixels, the posed body has {joints.reach:.1f}; check the "
                "translations and the camera's (metres), and its focal length (pixels)."
            )
    return ""


def _ignored_fault(folder: Path, files: tuple[Path, Path]) -> str:
    """What is wrong with one layer of ignored pixels, given its file and the mask's."""
    ignored_file, mask_file = files
    layer, damaged = _decoded(folder, ignored_file, "L")
    mask, _ = _decoded(folder, mask_file, "L")
    if layer is None or mask is None:
        return damaged
    ignored, person = layer >= _PERSON, mask >= _PERSON
    if ignored.shape == person.shape and person.any() and not (person & ~ignored).any():
        where = ignored_file.relative_to(folder).as_posix()
        return f"{where} ignores all of the person; take this time out of the splits."
    return ""


def mesh_faults(folder: Path) -> list[str]:
    """What is wrong with the true surfaces, where there are any."""
    faults: list[str] = []
    for path in numbered_files(folder / MESHES, (".npz",)).values():
        try:
            read_mesh(path)
        except TwofoldError as error:
            faults.append(within_folder(folder, error))
    return faults


def read_mesh(path: Path) -> tuple[Float[Tensor, "V 3"], Int[Tensor, "F 3"]]:
    """A true surface: vertices in the world, metres, and triangles.

    Raises:
        TwofoldError: the file is missing or damaged, lacks one of both, or its numbers make no surface.
    """
    arrays = read_npz(path, ("vertices", "faces"))
    vertices, faces = arrays.get("vertices"), arrays.get("faces")
    if vertices is None or faces is None or vertices.shape[1:] != (3,) or faces.shape[1:] != (3,):
        raise TwofoldError(f"{path} should hold vertices (V x 3, metres) and faces (F x 3).")
    if vertices.dtype.kind not in "fiu" or not are_moderate(vertices):
        raise TwofoldError(f"{path}: vertices are not finite numbers; make this mesh again.")
    if faces.dtype.kind not in "iu" or not len(faces) or faces.min() < 0 or faces.max() >= len(vertices):
        raise TwofoldError(f"{path}: faces name vertices outside 0..{len(vertices) - 1}; make this mesh again.")
    return torch.as_tensor(vertices.astype(np.float32)), torch.as_tensor(faces.astype(np.int64))


def _in_picture(pixels: Float[Tensor, "*b 2"], camera: Camera) -> Tensor:
    size = torch.tensor([camera.width, camera.height])
    return ((pixels >= -0.5) & (pixels <= size - 0.5)).all(-1)


def _where(times: list[int], chosen: Tensor) -> list[int]:
    return [time for time, yes in zip(times, chosen.tolist(), strict=True) if yes]


def _in_threads(check: Callable[[Item], str], items: Iterable[Item]) -> list[str]:
    """The faults that `check` finds, in the order of the items. Decoding images leaves Python's lock free."""
    with ThreadPoolExecutor() as pool:
        return [fault for fault in pool.map(check, items) if fault]
