"""Captures prepared by a trial fit (`images/`, `masks/`, `capture.npz`) become capture folders.

The fitted body comes in a rest pose of its own, its arms hanging at an angle; it and its poses are brought to SMPL's
T-pose. The world is turned from the camera's axes to y up.
"""

import contextlib
import re
from collections.abc import Callable, Generator, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8
from torch import Tensor

from twofold.body.retarget import convert_pose, straighten
from twofold.body.skeleton import PARENTS, Body, pose_body, require_surface, shape_body
from twofold.capture.folder import CaptureWriter
from twofold.capture.layout import IMAGE_ENDINGS, IMAGES, MASKS, file_stem, spans
from twofold.errors import TwofoldError
from twofold.geometry.cameras import Camera, project
from twofold.geometry.upright import turn_world
from twofold.images import read_header
from twofold.npz import are_moderate, not_increasing, read_npz
from twofold.prepare.detect.mask_values import MaskValues, mask_values, read_mask
from twofold.prepare.output.held_objects import SeenBody, see_body, usual_colors
from twofold.prepare.output.object_tracks import Sighting, foreign_patches, moving_objects, without
from twofold.prepare.video.clips import are_uneven, rate_of
from twofold.prepare.video.frames import ClipInfo, describe, picture_files, read_picture
from twofold.prepare.video.numbering import numberings

CAMERA = "cam"
ARRAYS = "capture.npz"
_ARRAYS = (
    "intrinsics", "world_to_camera", "poses", "transl", "rest_vertices", "rest_joints", "parents", "weights", "faces",
    "silhouette_iou", "video_frame", "fps", "seconds",
)  # fmt: skip


USUAL_FPS = 30.0
"""Taken where nothing says how fast the frames were taken."""

Y_UP = torch.diag(torch.tensor([1.0, -1.0, -1.0], dtype=torch.float64))
"""From OpenCV's camera axes (y down, z forward) to a world with y up and z towards the viewer."""


def import_prepared(
    source: Path | str,
    out: Path | str,
    every_held_out: int = 10,
    drop_below_iou: float = 0.0,
    overwrite: bool = False,
    held_objects: Literal["keep", "remove"] = "remove",
    fps: float | None = None,
    credit: str = "",
    remark: Callable[[str], None] = lambda sentence: None,
) -> Path:
    """Makes a capture folder from a prepared one. One camera trains; held-out frames become the novel poses.

    Args:
        source: the prepared folder.
        out: the capture folder to make.
        every_held_out: every Nth frame is held out, the middle one of N, so that its neighbours train.
        drop_below_iou: frames whose fitted body covers the mask worse than this are in no split; the notes name them.
        overwrite: a capture that lies at `out` is overwritten.
        held_objects: "remove" takes what is thick and sticks out of the body, such as a ball, out of the masks, and
            marks it and what passes in front of the body as ignored; "keep" leaves the masks as they are.
        fps: frames per second; None takes `seconds` or `fps` of capture.npz, else 30, and says so.
        credit: whom to name when showing the images.
        remark: called with each sentence that the user should know.

    Returns:
        `out`.

    Raises:
        TwofoldError: an array or image is missing or of the wrong shape, an image or mask cannot be read or does not
            show the fitted body, or `out` cannot be written; nothing is left behind then.
    """
    source, out = Path(source), Path(out)
    if not 0 <= drop_below_iou <= 1:
        raise TwofoldError(
            f"Frames are left out below an IoU of 0 to 1, not below {drop_below_iou:g}; give such a number."
        )
    if every_held_out < 3:
        raise TwofoldError(f"One frame of {every_held_out} cannot be held out between two that train; take 3 or more.")
    if fps is not None and not 0.01 <= fps <= 1000:
        raise TwofoldError(f"The frame rate {fps:g} makes no sense; give frames per second, 10 for example.")
    arrays = _read_arrays(source)
    fps, seconds = _times(arrays, fps, source / ARRAYS, remark)
    body, poses, translations = _to_t_pose(arrays)
    kept, left_out = _kept(arrays["silhouette_iou"], drop_below_iou)
    info = _described(source, len(poses), remark)
    images = _files(picture_files(source / IMAGES), info, kept, source / IMAGES, remark)
    stems = tuple(images[time].stem for time in kept)
    named = replace(info, names=stems) if len(stems) == len(poses) else info
    masks = _files(picture_files(source / MASKS), named, kept, source / MASKS, remark)
    values = mask_values([masks[time] for time in kept])
    for sentence in values.remarks:
        remark(sentence)
    world_to_camera = torch.as_tensor(arrays["world_to_camera"].astype(np.float64))
    poses, translations, world_to_camera = turn_world(Y_UP, body.joints[0], poses, translations, world_to_camera)
    intrinsics = torch.as_tensor(arrays["intrinsics"].astype(np.float32))
    camera = Camera(world_to_camera.float(), intrinsics, info.height, info.width)
    held_out = [time for time in kept if time % every_held_out == every_held_out // 2]
    with _named_as_given(images, masks), CaptureWriter(out, overwrite) as writer:
        for time in kept:
            _write_image(writer, time, images[time], info)
        shares = dict.fromkeys(kept, 0.0)
        whole = set(kept)
        if held_objects == "remove":
            files = _Files(images, masks, info, values)
            for time, mask, hidden, share in _without_objects(body, poses, translations, camera, files, seconds):
                shares[time] = round(share, 4)
                writer.mask(CAMERA, time, mask)
                writer.ignored(CAMERA, time, hidden * np.uint8(255))
                whole.remove(time)
        for time in sorted(whole):
            if _as_stored(masks[time], values):
                writer.mask_file(CAMERA, time, masks[time])
            else:
                writer.mask(CAMERA, time, read_mask(masks[time], values))
        writer.finish(
            name=source.name,
            body=body,
            betas=torch.zeros(0),
            poses=poses.float(),
            translations=translations.float(),
            cameras={CAMERA: camera},
            splits={
                "train": {CAMERA: [time for time in kept if time not in held_out]},
                "novel_pose": {CAMERA: held_out},
            },
            fps=fps,
            seconds=torch.from_numpy(seconds) if are_uneven(seconds) else None,
            credit=credit,
            notes={
                "prepared_from": source.name,
                "every_held_out": every_held_out,
                "drop_below_iou": drop_below_iou,
                "left_out": left_out,
                "held_objects": held_objects,
                "objects_ignored": [time for time in kept if time not in whole],
                "objects_share_of_mask": list(shares.values()),
                "video_frame": arrays["video_frame"].tolist(),
                "silhouette_iou": [round(float(iou), 3) for iou in arrays["silhouette_iou"]],
            },
            thorough=True,
        )
    if any(shares.values()):
        remark(
            f"Held objects were taken out in {len(kept) - len(whole)} of {len(kept)} frames, at most "
            f"{100 * max(shares.values()):.1f} % of the person's mask; --held-objects keep leaves them."
        )
    return out


def _times(
    arrays: dict[str, np.ndarray], fps: float | None, where: Path, remark: Callable[[str], None]
) -> tuple[float, Float[np.ndarray, "T"]]:
    """Frames per second, and when each frame was taken."""
    if (seconds := arrays.get("seconds")) is not None:
        if fps is not None:
            raise TwofoldError(f"{where} says when each frame was taken; leave --fps out.")
        if back := not_increasing(seconds):
            raise TwofoldError(f"seconds in {where} should increase from frame to frame; not so at {spans(back)}.")
        seconds = seconds.astype(np.float64) - seconds[:1]
        rate = rate_of(seconds, USUAL_FPS)
        remark(f"{where.name} says when each frame was taken: {rate:.3g} frames a second on average.")
        return rate, seconds
    if fps is None and "fps" in arrays and arrays["fps"].size == 1 and 0.01 <= float(arrays["fps"].item()) <= 1000:
        fps = float(arrays["fps"].item())
    if fps is None:
        remark(f"Nothing says how many frames a second there are; {USUAL_FPS:g} is taken, --fps sets it.")
    fps = USUAL_FPS if fps is None else fps
    return fps, np.arange(len(arrays["poses"])) / fps


def _described(source: Path, frames: int, remark: Callable[[str], None]) -> ClipInfo:
    """What there is to know of the images, as of a clip's that has one for each pose."""
    info = describe(source / IMAGES)
    for sentence in info.remarks:
        remark(sentence)
    return replace(info, sources=frames, frames=frames, names=())


def _files(
    files: Sequence[Path], info: ClipInfo, times: Sequence[int], folder: Path, remark: Callable[[str], None]
) -> dict[int, Path]:
    """The file of each frame; see `numberings`."""
    found = numberings(files, info, folder.name)
    if len(found) > 1:
        words = found[0].words
        remark(f"The files in {folder} fit the poses in {len(found)} ways; taken as {words}. Number them from 0.")
    missing = [time for time in times if time not in found[0].places]
    if missing:
        raise TwofoldError(
            f"{folder} lacks the images of frames {spans(missing)} ({missing[0]:04d} and so on); "
            f"{ARRAYS} has poses for them, so add them or prepare the capture again."
        )
    return {time: found[0].places[time] for time in times}


def _write_image(writer: CaptureWriter, time: int, file: Path, info: ClipInfo) -> None:
    header = read_header(file)
    plain = header.mode in ("RGB", "L") and not header.deep and header.upright
    if plain and file.suffix.lower() in IMAGE_ENDINGS:
        writer.image_file(CAMERA, time, file)
    else:
        writer.image(CAMERA, time, read_picture(file, info))


def _as_stored(file: Path, values: MaskValues) -> bool:
    """Whether a mask file says what the capture's own do: 8 bits of grey, 255 on the person."""
    header = read_header(file)
    plain = header.mode in ("L", "1") and not header.deep and header.upright and not values.labels
    return plain and file.suffix.lower() in IMAGE_ENDINGS


@contextlib.contextmanager
def _named_as_given(images: dict[int, Path], masks: dict[int, Path]) -> Generator[None, None, None]:
    """Faults of images under the names that they have in the prepared folder, where they can be fixed."""
    try:
        yield
    except TwofoldError as error:
        text = str(error)
        for kind, files in ((IMAGES, images), (MASKS, masks)):
            for time, file in files.items():
                text = re.sub(rf"\b{kind}/{CAMERA}/{file_stem(time)}\.\w+", lambda _, file=file: str(file), text)
        raise TwofoldError(text) from error


@dataclass(frozen=True)
class _Files:
    """Where images and masks lie and what they mean."""

    images: dict[int, Path]
    masks: dict[int, Path]
    info: ClipInfo
    values: MaskValues

    def read(self, time: int) -> tuple[UInt8[np.ndarray, "h w 3"], UInt8[np.ndarray, "h w"]]:
        return read_picture(self.images[time], self.info), read_mask(self.masks[time], self.values)


def _without_objects(
    body: Body,
    poses: Float[Tensor, "T 24 3"],
    translations: Float[Tensor, "T 3"],
    camera: Camera,
    files: _Files,
    seconds: Float[np.ndarray, "T"],
) -> Iterator[tuple[int, UInt8[np.ndarray, "h w"], Bool[np.ndarray, "h w"], float]]:
    """Time, mask without held objects, hidden pixels and their share of the mask, of frames with objects.

    Images are read several times, so that a long capture needs no memory for them.
    """
    shaped, focal = shape_body(body, torch.zeros(0)), float(camera.intrinsics[0, 0])
    size = (camera.height, camera.width)

    def see(time: int) -> SeenBody | None:
        posed = pose_body(shaped, poses[time].float(), translations[time].float())
        pixels, depth = project(camera, posed.vertices)
        if depth.min() <= 0:
            return None
        return see_body(pixels.numpy(), depth.numpy(), posed.faces.numpy(), focal, *size)

    colors: list[np.ndarray] = []
    visible: list[np.ndarray] = []
    times: list[int] = []
    for time in files.images:
        image, mask = files.read(time)
        seen = see(time) if image.shape[:2] == size and mask.shape == size else None
        if seen is None:
            continue  # The writer tells what is wrong with it.
        column, row = np.where(seen.visible[:, None], seen.pixels, 0).T
        colors.append(image[row, column])
        visible.append(seen.visible & (mask[row, column] > 127))
        times.append(time)
    if not times:
        return
    usual, trusted = usual_colors(np.stack(colors), np.stack(visible))
    sightings: list[Sighting | None] = []
    for time in times:
        seen = see(time)
        image, mask = files.read(time)
        sightings.append(None if seen is None else foreign_patches(mask, image, seen, usual, trusted))
    for time, objects in zip(times, moving_objects(sightings, seconds[times].tolist()), strict=True):
        if objects:
            yield time, *without(files.read(time)[1], objects)


def _read_arrays(source: Path) -> dict[str, np.ndarray]:
    """The arrays of `capture.npz`, their shapes checked."""
    if not source.is_dir():
        raise TwofoldError(f"{source} is no folder; expected a prepared one with images, masks and {ARRAYS}.")
    where = source / ARRAYS
    arrays = read_npz(where, _ARRAYS)
    frames, vertices = (len(arrays[n]) if n in arrays and arrays[n].ndim else 0 for n in ("poses", "rest_vertices"))
    arrays.setdefault("silhouette_iou", np.ones(frames))
    arrays.setdefault("video_frame", np.arange(frames))
    _one_camera(arrays, frames, where)
    if "parents" in arrays and arrays["parents"].shape == (24,) and arrays["parents"].dtype.kind in "fiu":
        # The root has no parent: -1, which unsigned numbers hold as their largest one.
        root = float(arrays["parents"][0])
        arrays["parents"] = np.array([root if 0 <= root < 24 else -1.0, *arrays["parents"][1:].tolist()])
    faces = arrays["faces"].shape if "faces" in arrays else (0, 3)
    shapes = {
        "intrinsics": (3, 3), "world_to_camera": (4, 4), "poses": (frames, 24, 3), "transl": (frames, 3),
        "rest_vertices": (vertices, 3), "rest_joints": (24, 3), "parents": (24,), "weights": (vertices, 24),
        "faces": (faces[0], 3), "silhouette_iou": (frames,), "video_frame": (frames,),
        **({"seconds": (frames,)} if "seconds" in arrays else {}),
    }  # fmt: skip
    for name, shape in shapes.items():
        if name not in arrays:
            raise TwofoldError(f"{where} lacks {name}; prepare the capture again.")
        if arrays[name].shape != shape or arrays[name].dtype.kind not in "fiu":
            found = f"{arrays[name].dtype} of {arrays[name].shape}"
            raise TwofoldError(f"{name} in {where} should be numbers of shape {shape}, it is {found}.")
        if not are_moderate(arrays[name]):
            raise TwofoldError(f"{name} in {where} holds a number that is not finite; prepare the capture again.")
    if tuple(arrays["parents"].tolist()) != PARENTS:
        raise TwofoldError(f"The joints in {where} do not hang together as SMPL's 24 do; bring them to that order.")
    require_surface(arrays["rest_vertices"], arrays["faces"], arrays["weights"], str(where), "rest_vertices")
    return arrays


def _to_t_pose(arrays: dict[str, np.ndarray]) -> tuple[Body, Float[Tensor, "T 24 3"], Float[Tensor, "T 3"]]:
    """Body, poses and translations relative to SMPL's T-pose, in double precision except for the body."""
    names = ("rest_vertices", "rest_joints", "weights", "poses", "transl")
    rest, rest_joints, weights, poses, translations = (
        torch.as_tensor(arrays[name].astype(np.float64)) for name in names
    )
    vertices, joints, turns = straighten(rest, rest_joints, weights)
    body = Body(
        name="anny",
        template=vertices.float(),
        faces=torch.as_tensor(arrays["faces"].astype(np.int64)),
        weights=weights.float(),
        joints=joints.float(),
        shape_basis=torch.zeros(len(vertices), 3, 0),
        joint_basis=torch.zeros(24, 3, 0),
        pose_basis=torch.zeros(len(vertices), 3, 0),
    )
    return body, convert_pose(poses, turns), translations


def _kept(iou: np.ndarray, threshold: float) -> tuple[list[int], list[int]]:
    """Frames whose fit is good enough, and the others."""
    kept = np.flatnonzero(iou >= threshold).tolist()
    if len(kept) < 2:
        best = f"the best reaches {iou.max():.2f}" if len(iou) else "there are none"
        raise TwofoldError(f"Fewer than two frames are fitted to {threshold:g}, {best}; lower the threshold.")
    return kept, np.flatnonzero(iou < threshold).tolist()


def _one_camera(arrays: dict[str, np.ndarray], frames: int, where: Path) -> None:
    """Camera matrices given for each frame become one, where they are all the same."""
    for name, shape in (("intrinsics", (3, 3)), ("world_to_camera", (4, 4))):
        given = arrays.get(name)
        if given is None or given.shape != (frames, *shape) or given.dtype.kind not in "fiu" or not frames:
            continue
        if np.abs(given - given[0]).max() > 1e-3 * max(float(np.abs(given[0]).max()), 1.0):
            raise TwofoldError(
                f"{name} in {where} change from frame to frame; a capture's camera has one. Bring the images to one "
                "camera (crop and scale them alike), or take the motion of the camera into poses and transl."
            )
        arrays[name] = given[0]
