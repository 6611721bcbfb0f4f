"""What is seen in a clip: where a person's landmarks are in each image, and which pixels the person covers."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Bool, Float, UInt8

LANDMARKS = (
    "nose", "left_eye_inner", "left_eye", "left_eye_outer", "right_eye_inner", "right_eye", "right_eye_outer",
    "left_ear", "right_ear", "mouth_left", "mouth_right", "left_shoulder", "right_shoulder", "left_elbow",
    "right_elbow", "left_wrist", "right_wrist", "left_pinky", "right_pinky", "left_index", "right_index",
    "left_thumb", "right_thumb", "left_hip", "right_hip", "left_knee", "right_knee", "left_ankle", "right_ankle",
    "left_heel", "right_heel", "left_foot_index", "right_foot_index",
)  # fmt: skip
"""The 33 points of BlazePose, in its order; left is the person's own left."""


def mirrored_landmarks() -> tuple[int, ...]:
    """For each landmark the one on the other side of the body; those in the middle are their own."""
    other = {"left": "right", "right": "left"}
    names = [" ".join(other.get(word, word) for word in name.split("_")) for name in LANDMARKS]
    return tuple(LANDMARKS.index(name.replace(" ", "_")) for name in names)


@dataclass(frozen=True)
class Observation:
    """One person in one image.

    Attributes:
        pixels: (column, row) of each landmark; NaN where it was not looked for or nobody was found.
        visibility: how sure it is that a landmark is seen, 0..1; 0 where there is none.
        world: landmarks about the middle of the hips in the camera's axes (x right, y down, z forward), metres; NaN
            where an estimator gives none.
        mask: 0 outside .. 255 on the person.
    """

    pixels: Float[np.ndarray, "33 2"]
    visibility: Float[np.ndarray, "33"]
    world: Float[np.ndarray, "33 3"]
    mask: UInt8[np.ndarray, "h w"]


@runtime_checkable
class Estimator(Protocol):
    """Finds one person in the images of a clip, which come in order.

    Attributes:
        offsets: how far it usually marks points off a body's joints and skin, in the axes of the T-pose (x to the
            person's left, y up, z ahead), metres; zeros where that is not known.
    """

    @property
    def offsets(self) -> Float[np.ndarray, "33 3"]:
        """See the class."""
        ...

    def __call__(self, image: UInt8[np.ndarray, "h w 3"], seconds: float) -> Observation:
        """The person in the image taken `seconds` after the clip's start (8-bit sRGB)."""
        ...

    def close(self) -> None:
        """Gives back what the estimator holds."""
        ...


@dataclass(frozen=True)
class Track:
    """The landmarks of one person through one camera's clip; see `Observation` for the fields."""

    pixels: Float[np.ndarray, "t 33 2"]
    visibility: Float[np.ndarray, "t 33"]
    world: Float[np.ndarray, "t 33 3"]

    @property
    def found(self) -> Bool[np.ndarray, "t"]:
        """Frames at which the person was found."""
        return np.any(self.visibility > 0, axis=1)

    def __len__(self) -> int:
        return len(self.pixels)


def track_of(observations: Sequence[Observation]) -> Track:
    """The landmarks of images in order, without the masks."""
    return Track(
        np.stack([o.pixels for o in observations]),
        np.stack([o.visibility for o in observations]),
        np.stack([o.world for o in observations]),
    )


def nobody(height: int, width: int) -> Observation:
    """What is seen where no person is."""
    return Observation(
        np.full((33, 2), np.nan, np.float32), np.zeros(33, np.float32), np.full((33, 3), np.nan, np.float32),
        np.zeros((height, width), np.uint8),
    )  # fmt: skip
