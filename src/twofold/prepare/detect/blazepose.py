"""The usual estimator: landmarks and mask of one person by MediaPipe's BlazePose, whose models come with it."""

from types import ModuleType
from typing import Any, final

import numpy as np
from jaxtyping import UInt8

from twofold.prepare.detect.mediapipe_loader import load_mediapipe, silenced
from twofold.prepare.detections import Estimator, Observation, nobody


def mediapipe_estimator(masks: bool = True) -> Estimator:
    """BlazePose "full" (Bazarevsky et al. 2020), which follows the person from image to image.

    Times count: the landmarks are smoothed over a stretch of time, so that fewer images a second are smoothed less.
    World landmarks are its own guess, with a person of average size in mind.

    Args:
        masks: look for the person's pixels, too; without, masks are all 0 and it is quicker.

    Raises:
        TwofoldError: MediaPipe is not installed.
    """
    return _BlazePose(load_mediapipe(), masks)


@final
class _BlazePose:
    def __init__(self, mediapipe: ModuleType, masks: bool) -> None:
        self._mediapipe, self._masks = mediapipe, masks
        self._graph: Any = None
        self._heard_all = False
        self._microseconds = 0

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
            self._graph = self._mediapipe.solutions.pose.Pose(
                static_image_mode=False, model_complexity=1, smooth_landmarks=True, enable_segmentation=self._masks
            )
        # The package's own clock stands at 30 images a second and advances by that much in `process`.
        self._microseconds = max(self._microseconds + 1, 1_000_000 + round(1e6 * seconds))
        self._graph._simulated_timestamp = self._microseconds - 33_333
        return self._graph.process(np.ascontiguousarray(image))


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
