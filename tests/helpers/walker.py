"""A stick figure that walks and turns, seen by calibrated cameras, and the real clips where they are."""

import os
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from twofold.prepare.cameras.calibration import CalibratedCamera
from twofold.prepare.detections import LANDMARKS, Track

CLIPS = Path(os.environ.get("TWOFOLD_CLIPS", Path(__file__).parents[3] / "shared" / "data" / "video"))
CALIBRATION = CLIPS / "pose2sim" / "Calib.qca.txt"

needs_clips = pytest.mark.skipif(not CALIBRATION.exists(), reason=f"the real clips are not at {CLIPS}")

HEAD = {
    "nose": (0, 1.62, 0.12), "eye_inner": (0.02, 1.66, 0.1), "eye": (0.03, 1.66, 0.1), "eye_outer": (0.04, 1.66, 0.09),
    "ear": (0.08, 1.64, 0.0), "mouth": (0.02, 1.57, 0.1),
}  # fmt: skip


def walker(seconds, turn=0.0, heading=0.0):
    """33 landmarks (t, 33, 3) of somebody who walks on the spot: y up, metres; left is +x when they face +z.

    `turn` is in radians a second, `heading` where they face at the start.
    """
    seconds = np.asarray(seconds, dtype=float)
    points = np.zeros((len(seconds), 33, 3))
    for index, name in enumerate(LANDMARKS):
        side = 1 if "left" in name else -1
        swing = 0.5 * np.sin(2 * np.pi * seconds) * side
        part = name.replace("left_", "").replace("right_", "").replace("_left", "").replace("_right", "")
        if part in HEAD:
            x, y, z = HEAD[part]
            place = np.tile([side * x, y, z], (len(seconds), 1))
        else:
            place = limb(part, side, swing)
        points[:, index] = place
    yaw = Rotation.from_euler("y", (heading + turn * seconds)[:, None])
    return np.stack([r.apply(p) for r, p in zip(yaw, points, strict=True)])


def limb(part, side, swing):
    arm = part in {"shoulder", "elbow", "wrist", "pinky", "index", "thumb"}
    angle = -swing if arm else swing
    down = np.stack([np.zeros_like(angle), -np.cos(angle), np.sin(angle)], -1)
    start = np.array([side * (0.18 if arm else 0.1), 1.42 if arm else 0.92, 0.0])
    along = {"shoulder": 0, "elbow": 0.28, "wrist": 0.52, "pinky": 0.6, "index": 0.6, "thumb": 0.57, "hip": 0,
             "knee": 0.42, "ankle": 0.8, "heel": 0.84, "foot_index": 0.84}[part]  # fmt: skip
    aside = {"pinky": 0.03, "index": -0.03, "thumb": -0.05}.get(part, 0)
    ahead = {"heel": -0.05, "foot_index": 0.16}.get(part, 0)
    return start + along * down + np.array([side * aside, 0, ahead])


def camera(name="front", azimuth=0.0, height=1.5, distance=4.0, distortion=(0, 0, 0, 0, 0)):
    """Looks at the walker's middle; azimuth 0 sees a face that looks along +z."""
    center = np.array([distance * np.sin(azimuth), height, distance * np.cos(azimuth)])
    forward = np.array([0, 0.9, 0]) - center
    forward /= np.linalg.norm(forward)
    right = np.cross(forward, [0, 1, 0])
    right /= np.linalg.norm(right)
    rigid = np.eye(4)
    rigid[:3, :3] = np.stack([right, np.cross(forward, right), forward])
    rigid[:3, 3] = -rigid[:3, :3] @ center
    intrinsics = np.array([[1000.0, 0, 359.5], [0, 1000, 639.5], [0, 0, 1]])
    return CalibratedCamera(name, intrinsics, np.array(distortion, dtype=float), rigid, 1280, 720)


def ring(count, **options):
    """Cameras all around, no two of which look at each other."""
    return [camera(f"cam{i}", 0.3 + 2 * np.pi * i / (count + 0.7), **options) for i in range(count)]


def projected(view, points):
    """Pixels of points, lens aside."""
    in_camera = points @ view.world_to_camera[:3, :3].T + view.world_to_camera[:3, 3]
    return in_camera[..., :2] / in_camera[..., 2:] * np.diag(view.intrinsics)[:2] + view.intrinsics[:2, 2]


def seen(view, points, noise=0.0, rng=None):
    """What a perfect estimator finds, give or take `noise` pixels."""
    pixels = projected(view, points)
    if noise:
        pixels = pixels + noise * rng.standard_normal(pixels.shape)
    hips = (points[:, 23] + points[:, 24])[:, None] / 2
    return Track(pixels, np.ones(pixels.shape[:2]), (points - hips) @ view.world_to_camera[:3, :3].T)
