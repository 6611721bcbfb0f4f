"""The usual estimator: landmarks and mask of one person by MediaPipe's BlazePose, whose models come with it."""

import tempfile
from pathlib import Path
from types import ModuleType
from typing import Any, final

import numpy as np
from jaxtyping import Float, UInt8

from twofold.prepare.detect.landmark_model import in_place_of_full
from twofold.prepare.detect.mediapipe_loader import load_mediapipe, silenced
from twofold.prepare.detections import LANDMARKS, Estimator, Observation, nobody

OFFSETS: dict[str, tuple[int, int, int]] = {
    "nose": (0, 13, -16), "eye_inner": (3, 0, -15), "eye": (-5, -2, -17), "eye_outer": (-3, 4, -19),
    "ear": (-32, 7, 45), "mouth": (1, 7, -17), "shoulder": (-22, 20, 12), "elbow": (-13, 8, 22), "wrist": (4, 0, 0),
    "pinky": (-13, -9, 29), "index": (-16, -12, -7), "thumb": (0, -14, -26), "hip": (-13, -9, 15),
    "knee": (-7, -9, 0), "ankle": (0, 17, 6), "heel": (-9, -8, 12), "foot_index": (20, 2, -25),
}  # fmt: skip
"""How far BlazePose marks points off the joints and the skin below, millimetres in the T-pose on the left side (x to
the left, y up, z ahead): hips lower and closer together, ears far behind, toes short of the tip. Measured on images of
synthetic subjects with known poses (`python -m benchmarks.landmark_offsets`), both sides together."""


def blazepose_offsets() -> Float[np.ndarray, "33 3"]:
    """`OFFSETS` of every landmark, metres; the right side is the mirror image of the left."""
    rows = [OFFSETS["_".join(w for w in name.split("_") if w not in ("left", "right"))] for name in LANDMARKS]
    mirrored = [[-1 if "right" in name else 1, 1, 1] for name in LANDMARKS]
    return np.array(rows, np.float32) * np.array(mirrored, np.float32) / 1000


def mediapipe_estimator(masks: bool = True, model: bytes | None = None) -> Estimator:
    """BlazePose (Bazarevsky et al. 2020), which follows the person from image to image.

    Times count: the landmarks are smoothed over a stretch of time, so that fewer images a second are smoothed less.
    World landmarks are its own guess, with a person of average size in mind.

    Args:
        masks: look for the person's pixels, too; without, masks are all 0 and it is quicker.
        model: another landmark model (`read_landmark_model`); by default "full", which comes with MediaPipe.

    Raises:
        TwofoldError: MediaPipe is not installed.
    """
    return _BlazePose(load_mediapipe(), masks, model)


@final
class _BlazePose:
    def __init__(self, mediapipe: ModuleType, masks: bool, model: bytes | None) -> None:
        self._mediapipe, self._masks, self._model = mediapipe, masks, model
        self._graph: Any = None
        self._heard_all = False
        self._microseconds = 0

    @property
    def offsets(self) -> Float[np.ndarray, "33 3"]:
        return blazepose_offsets()

    def __call__(self, image: UInt8[np.ndarray, "h w 3"], seconds: float) -> Observation:
        # Each model speaks when it is first used: at the start, and when the first person was found.
        found: Any = None
        if self._heard_all:
            found = self._process(image, seconds)
        else:
            with silenced():
                found = self._process(image, seconds)
        if found.pose_landmarks is None:
            return nobody(*image.shape[:2])
        self._heard_all = True
        return _observation(found, *image.shape[:2])

    def close(self) -> None:
        if self._graph is not None:
            self._graph.close()
            self._graph = None

    def _process(self, image: np.ndarray, seconds: float) -> Any:
        if self._graph is None:
            self._graph = self._made()
        # The package's own clock stands at 30 images a second and advances by that much in `process`.
        self._microseconds = max(self._microseconds + 1, 1_000_000 + round(1e6 * seconds))
        self._graph._simulated_timestamp = self._microseconds - 33_333
        return self._graph.process(np.ascontiguousarray(image))

    def _made(self) -> Any:
        """A graph; its models are read when the first image has passed through it."""
        options: dict[str, Any] = {"static_image_mode": False, "model_complexity": 1, "smooth_landmarks": True}
        options["enable_segmentation"] = self._masks
        if self._model is None:
            return self._mediapipe.solutions.pose.Pose(**options)
        with (
            tempfile.TemporaryDirectory(prefix="twofold-model-") as scratch,
            in_place_of_full(self._mediapipe, self._model, Path(scratch)),
        ):
            graph = self._mediapipe.solutions.pose.Pose(**options)
            graph._graph.wait_until_idle()
        return graph


def _observation(found: Any, height: int, width: int) -> Observation:
    """What MediaPipe found; its images reach from 0 to 1, from edge to edge and not from middle to middle."""
    points, world = found.pose_landmarks.landmark, found.pose_world_landmarks.landmark
    mask = np.zeros((height, width), np.float32) if found.segmentation_mask is None else found.segmentation_mask
    return Observation(
        np.array([(p.x * width - 0.5, p.y * height - 0.5) for p in points], np.float32),
        np.clip([p.visibility for p in points], 1e-6, 1).astype(np.float32),
        np.array([(p.x, p.y, p.z) for p in world], np.float32),
        np.round(255 * np.clip(mask, 0, 1)).astype(np.uint8),
    )
