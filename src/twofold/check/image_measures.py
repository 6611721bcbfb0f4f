"""What pictures show beside the mask: a background that moves or changes its brightness, faces where none should be."""

import functools
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float
from PIL import Image
from scipy import ndimage
from skimage import data
from skimage.feature import Cascade
from skimage.registration import phase_cross_correlation

from twofold.body.skeleton import JOINT_NAMES, ShapedBody, joint_transforms
from twofold.capture.types import Frame
from twofold.geometry.cameras import project
from twofold.images import load_image

SIZE = 320
"""Longest side at which backgrounds are compared, pixels."""
PLAIN = 0.03
"""A background whose brightness deviates by less (0..1) has nothing in it that could be seen to move."""
FACING_AWAY = -0.5
"""Below this cosine between face and camera no face is to be seen; a profile has 0."""
HEAD, FACE = 0.44, (0.1, 0.3)
"""The square around the head in which a face is looked for and the sizes it may have, metres."""


@dataclass(frozen=True)
class Background:
    """How the surroundings change in the pictures of one camera.

    Attributes:
        times: moments that were compared with the first.
        shift: the largest movement, as a share of the picture's longer side; None where nothing could be compared.
        brightness: at each of these moments relative to the first; empty where nothing could be compared.
    """

    times: tuple[int, ...]
    shift: float | None
    brightness: tuple[float, ...]


def background_of(frames: Sequence[Frame]) -> Background:
    """Compares the surroundings in pictures of one camera with those in the first of them."""
    pictures = [_surroundings(frame) for frame in frames]
    times = tuple(frame.time for frame in frames[1:])
    if len(pictures) < 2:
        return Background((), None, ())
    first, beside = pictures[0]
    if np.count_nonzero(beside) < 0.1 * beside.size or first[beside].std() < PLAIN:
        return Background(times, None, ())
    shifts: list[float] = []
    brightness: list[float] = []
    for other, other_beside in pictures[1:]:
        both = beside & other_beside
        if np.count_nonzero(both) < 0.1 * both.size:
            continue
        shifts.append(_shift(first, beside, other, other_beside))
        usual = float(np.median(first[both]))
        if usual > PLAIN:
            brightness.append(max(float(np.median(other[both])), 1e-3) / usual)
    return Background(times, max(shifts, default=None), tuple(brightness))


def shows_its_back(frame: Frame, shaped: ShapedBody) -> bool:
    """Whether the posed body turns its face away from the camera."""
    transforms = joint_transforms(shaped.joints, frame.pose, frame.translation)
    head = JOINT_NAMES.index("head")
    gaze = frame.camera.world_to_camera[:3, :3] @ transforms[head, :3, 2]
    return float(-gaze[2]) < FACING_AWAY


def sees_a_face(frame: Frame, shaped: ShapedBody) -> bool:
    """Whether a face looks out of the picture where the posed body has its head."""
    transforms = joint_transforms(shaped.joints, frame.pose, frame.translation)
    placed = (transforms[:, :3, :3] @ shaped.joints[:, :, None])[..., 0] + transforms[:, :3, 3]
    neck, head = placed[JOINT_NAMES.index("neck")], placed[JOINT_NAMES.index("head")]
    pixels, depth = project(frame.camera, torch.stack([neck, head]))
    if float(depth.min()) <= 0:
        return False
    (x, y), up = pixels[1].tolist(), (pixels[1] - pixels[0]).tolist()
    scale = float(frame.camera.intrinsics[0, 0]) / float(depth[1])
    half = 0.5 * HEAD * scale
    # The head's surroundings first: turning a whole picture takes ten times as long.
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


def _surroundings(frame: Frame) -> tuple[Float[np.ndarray, "a b"], Bool[np.ndarray, "a b"]]:
    """A small grey picture, and which of its pixels are well away from the person."""
    camera = frame.camera
    scale = min(1.0, SIZE / max(camera.height, camera.width))
    size = (max(round(scale * camera.width), 1), max(round(scale * camera.height), 1))
    picture, mask = (load_image(file).convert("L") for file in (frame.image_file, frame.mask_file))
    grey = np.asarray(picture.resize(size, Image.Resampling.BOX), np.float32) / 255
    person = np.asarray(mask.resize(size, Image.Resampling.BOX)) > 0
    return grey, ~np.asarray(ndimage.binary_dilation(person, iterations=max(round(0.02 * max(size)), 1)), dtype=bool)


def _shift(first: np.ndarray, beside: np.ndarray, other: np.ndarray, other_beside: np.ndarray) -> float:
    """How far the second background lies from the first, as a share of the longer side."""
    found = phase_cross_correlation(first, other, reference_mask=beside, moving_mask=other_beside, overlap_ratio=0.5)
    down, right = (round(float(s)) for s in found[0])
    if (down, right) == (0, 0):
        return 0.0
    moved, moved_beside = (np.roll(a, (down, right), (0, 1)) for a in (other, other_beside))
    before = np.abs(first - other)[beside & other_beside].mean()
    after = np.abs(first - moved)[beside & moved_beside].mean()
    # Repeating patterns fit many shifts; one that explains little is none.
    return math.hypot(down, right) / max(first.shape) if after < 0.7 * before else 0.0
