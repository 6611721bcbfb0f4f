"""MonoHuman's key frames: two training frames, one from the front and one from the back, whose images it looks into."""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float, UInt8
from torch import Tensor
from torch.nn import functional as F

from twofold.capture.types import Capture, Frame
from twofold.errors import TwofoldError
from twofold.geometry.rotations import axis_angle_to_matrix

FRONT, BACK = math.radians(150), math.radians(30)
"""A body shows its front where the angle of its z-axis to the camera's is at least the first, its back at most the
second, radians."""
MIN_SIDE = 64
"""Smaller images are padded with black, so that features can be taken of them, pixels."""


@dataclass(frozen=True)
class KeyFrames:
    """What is kept of the key frames.

    Attributes:
        images: on black, 0..255; smaller ones are padded at the right and below.
        poses: axis-angle, root first, radians.
        translations: SMPL's own, metres.
        projections: world points to homogeneous pixels.
    """

    images: UInt8[Tensor, "v 3 h w"]
    poses: Float[Tensor, "v 24 3"]
    translations: Float[Tensor, "v 3"]
    projections: Float[Tensor, "v 3 4"]


def read_key_frames(capture: Capture, times: tuple[int, ...] = ()) -> KeyFrames:
    """The key frames of a capture.

    Args:
        capture: among whose training frames they are.
        times: their frame indices, front and back; none: by `chosen_frames`.

    Raises:
        TwofoldError: an index is not among the training frames.
    """
    frames = named_frames(capture, times) if times else chosen_frames(capture.train)
    height = max(MIN_SIDE, *(frame.camera.height for frame in frames))
    width = max(MIN_SIDE, *(frame.camera.width for frame in frames))
    images: list[Tensor] = []
    for frame in frames:
        image = (255 * frame.composited(torch.zeros(3))).round().to(torch.uint8).permute(2, 0, 1)
        images.append(F.pad(image, (0, width - image.shape[2], 0, height - image.shape[1])))
    cameras = [frame.camera for frame in frames]
    return KeyFrames(
        images=torch.stack(images),
        poses=torch.stack([frame.pose for frame in frames]),
        translations=torch.stack([frame.translation for frame in frames]),
        projections=torch.stack([camera.intrinsics @ camera.world_to_camera[:3] for camera in cameras]),
    )


def named_frames(capture: Capture, times: tuple[int, ...]) -> list[Frame]:
    """The first training frame of each frame index.

    Raises:
        TwofoldError: there is none.
    """
    found: dict[int, Frame] = {}
    for frame in capture.train:
        found.setdefault(frame.frame_index, frame)
    for time in times:
        if time not in found:
            known = sorted(found)
            raise TwofoldError(
                f"method.key_frames names frame {time}, which is not among the training frames of {capture.folder} "
                f"({known[0]} to {known[-1]}, {len(known)} of them); choose others, or leave the setting out."
            )
    return [found[time] for time in times]


def chosen_frames(frames: tuple[Frame, ...]) -> list[Frame]:
    """A frame from the front and one from the back whose body poses are most alike.

    Where no frame shows the front, or the back, those that come closest to it stand in.
    """
    angles = torch.tensor([facing_angle(frame) for frame in frames])
    front = (angles >= min(FRONT, float(angles.max()))).nonzero()[:, 0]
    back = (angles <= max(BACK, float(angles.min()))).nonzero()[:, 0]
    poses = torch.stack([frame.pose[1:].flatten() for frame in frames])
    distances = torch.cdist(poses[front], poses[back])
    best = int(distances.argmin())
    return [frames[int(front[best // len(back)])], frames[int(back[best % len(back)])]]


def facing_angle(frame: Frame) -> float:
    """Angle between the body's z-axis, which points forward, and the camera's, both without the camera's y; radians.

    It is pi for a body that faces the camera.
    """
    forward = axis_angle_to_matrix(frame.pose[0])[:, 2]
    x, _, z = (frame.camera.world_to_camera[:3, :3] @ forward).tolist()
    return math.acos(max(-1.0, min(1.0, z / max(math.hypot(x, z), 1e-9))))
