"""What images show beside the mask: a background that moves or changes its brightness, faces where none should be."""

import functools
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from PIL import Image
from skimage import data
from skimage.feature import Cascade

from twofold.body.skeleton import JOINT_NAMES, ShapedBody, joint_transforms
from twofold.capture.types import Frame
from twofold.geometry.cameras import project
from twofold.images import load_image
from twofold.prepare.detect.background import Surroundings, background_motion, surroundings

DARK = 0.03
"""Backgrounds that are darker on average (0..1) have no brightness to compare."""
FACING_AWAY = -0.5
"""Below this cosine between face and camera no face is to be seen; a profile has 0."""
HEAD, FACE = 0.44, (0.1, 0.3)
"""The square around the head in which a face is looked for and the sizes it may have, metres."""


@dataclass(frozen=True)
class Background:
    """How the surroundings change in the images of one camera.

    Attributes:
        times: frames that were compared with the first.
        shift: the largest movement, as a share of the image's longer side; None where it is unknown.
        brightness: at each of these frames relative to the first; empty where nothing could be compared.
        lost: there is a background with details, but it cannot be followed from image to image.
    """

    times: tuple[int, ...]
    shift: float | None
    brightness: tuple[float, ...]
    lost: bool = False


def background_of(frames: Sequence[Frame]) -> Background:
    """Compares the surroundings in images of one camera with those in the first of them."""
    times = tuple(frame.frame_index for frame in frames[1:])
    views = [_surroundings(frame) for frame in frames]
    if len(views) < 2 or views[0].plain:
        return Background(times, None, ())
    brightness: list[float] = []
    for view in views[1:]:
        both = views[0].beside & view.beside
        usual = float(np.median(views[0].grey[both])) if np.count_nonzero(both) > 0.1 * both.size else 0.0
        if usual > DARK:
            brightness.append(max(float(np.median(view.grey[both])), 1e-3) / usual)
    moved = background_motion(views).moved
    longer = max(frames[0].camera.height, frames[0].camera.width)
    lost = moved is None and sum(view.plain for view in views) < 0.5 * len(views)
    return Background(times, None if moved is None else moved / longer, tuple(brightness), lost)


def shows_its_back(frame: Frame, shaped: ShapedBody) -> bool:
    """Whether the posed body turns its face away from the camera."""
    transforms = joint_transforms(shaped.joints, frame.pose, frame.translation)
    head = JOINT_NAMES.index("head")
    gaze = frame.camera.world_to_camera[:3, :3] @ transforms[head, :3, 2]
    return float(-gaze[2]) < FACING_AWAY


def sees_a_face(frame: Frame, shaped: ShapedBody) -> bool:
    """Whether a face looks out of the image where the posed body has its head."""
    transforms = joint_transforms(shaped.joints, frame.pose, frame.translation)
    placed = (transforms[:, :3, :3] @ shaped.joints[:, :, None])[..., 0] + transforms[:, :3, 3]
    neck, head = placed[JOINT_NAMES.index("neck")], placed[JOINT_NAMES.index("head")]
    pixels, depth = project(frame.camera, torch.stack([neck, head]))
    if float(depth.min()) <= 0:
        return False
    (x, y), up = pixels[1].tolist(), (pixels[1] - pixels[0]).tolist()
    scale = float(frame.camera.intrinsics[0, 0]) / float(depth[1])
    half = 0.5 * HEAD * scale
    # The head's surroundings first: turning a whole image takes ten times as long.
    wide = load_image(frame.image_file).convert("RGB").crop(_box(x, y, 1.5 * half))
    upright = wide.rotate(math.degrees(math.atan2(up[0], -up[1])), Image.Resampling.BILINEAR)
    middle = upright.width / 2
    head_alone = upright.crop(_box(middle, middle, half)).resize((96, 96), Image.Resampling.BICUBIC)
    found = _face_detector().detect_multi_scale(
        np.asarray(head_alone), 1.15, 1, tuple(round(96 * s / HEAD) for s in (FACE[0],) * 2),
        tuple(round(96 * s / HEAD) for s in (FACE[1],) * 2),
    )  # fmt: skip
    return len(found) > 0


@functools.cache
def _face_detector() -> Cascade:
    """Frontal faces; its description comes with scikit-image."""
    return Cascade(data.lbp_frontal_face_cascade_filename())


def _box(x: float, y: float, half: float) -> tuple[int, int, int, int]:
    size = max(round(2 * half), 2)
    left, top = round(x - half), round(y - half)
    return left, top, left + size, top + size


def _surroundings(frame: Frame) -> Surroundings:
    return surroundings(load_image(frame.image_file), load_image(frame.mask_file))
