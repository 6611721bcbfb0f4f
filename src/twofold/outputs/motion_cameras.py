"""Cameras that keep a moving person in view: one that stands still, or one that goes along smoothly."""

import math

import numpy as np
import torch
from jaxtyping import Float
from scipy.ndimage import gaussian_filter1d
from torch import Tensor

from twofold.body.motion import Motion, joint_frames
from twofold.body.skeleton import PARENTS, ShapedBody
from twofold.geometry.cameras import Camera
from twofold.outputs.views import look_at

_CLOTHES = 0.07
"""Room around the bare body, metres."""

_THICK = 0.18
"""How far a body reaches around an inner joint at most, metres."""

_FOCAL = 1.9
"""Focal length in image heights: a field of view of 29 degrees, as a portrait has."""

_FILLED = 0.92
"""Share of the image that the person may take up."""

_FOLLOWED_WITHIN = 0.5
"""Seconds within which a camera that goes along evens out the person's path (standard deviation)."""


def motion_cameras(
    body: ShapedBody,
    motion: Motion,
    size: int,
    follow: bool = False,
    side: float = 0.44,
    above: float = 0.12,
) -> list[Camera]:
    """A camera for every frame, in front of where the person faces at first, the whole person in view in every frame.

    Args:
        body: who moves, in the T-pose.
        motion: what it does, y up.
        size: edge of the square images, pixels.
        follow: go along with the person; else one camera stands where it sees the whole motion.
        side: angle of the camera from the person's front to its left, radians.
        above: angle from which it looks down, radians.
    """
    rotations, positions = joint_frames(body.joints, motion)
    ahead = rotations[: max(1, round(0.5 * motion.fps)), 0, :, 2].mean(0)
    yaw = math.atan2(float(ahead[0]), float(ahead[2])) + side
    toward = torch.tensor(
        [math.sin(yaw) * math.cos(above), math.sin(above), math.cos(yaw) * math.cos(above)], dtype=torch.float64
    )
    view = look_at(toward, torch.zeros_like(toward), torch.tensor([0.0, 1.0, 0.0], dtype=torch.float64))[
        :3, :3
    ].double()
    around = _joint_reaches(body).double()
    low, high = (positions - around[:, None]).amin(1), (positions + around[:, None]).amax(1)
    if follow:
        middle = (low + high) / 2
        middle[:, 1] = middle[:, 1].median()
        centers = _smoothed(middle, _FOLLOWED_WITHIN * motion.fps)
    else:
        centers = ((low.amin(0) + high.amax(0)) / 2).expand(len(motion), 3)
    points = (positions - centers[:, None]) @ view.T
    slope, wide = _FILLED * 0.5 / _FOCAL, around[:, None]
    away = _distance(points, wide, slope)
    if not follow:
        # To the middle of what is seen; what is nearer is seen larger, so the distance counts.
        for _ in range(8):
            depth = points[..., 2:] + away
            ends = torch.stack([((points[..., :2] + sign * wide) / depth) for sign in (-1, 1)]).flatten(0, 2)
            shift = torch.cat([(ends.amax(0) + ends.amin(0)) / 2 * away, torch.zeros(1, dtype=torch.float64)])
            centers, points = centers + shift @ view, points - shift
            away = _distance(points, wide, slope)
    focal = _FOCAL * size
    intrinsics = torch.tensor([[focal, 0.0, (size - 1) / 2], [0.0, focal, (size - 1) / 2], [0.0, 0.0, 1.0]])
    cameras: list[Camera] = []
    for center in centers:
        transform = torch.eye(4, dtype=torch.float64)
        transform[:3, :3], transform[:3, 3] = view, -view @ (center + away * toward)
        cameras.append(Camera(transform.float(), intrinsics, size, size))
    return cameras


def _distance(points: Float[Tensor, "T 24 3"], around: Float[Tensor, "24 1"], slope: float) -> float:
    """From where balls around points (relative to the middle, in the camera's axes) fit into its field of view."""
    return float(((points[..., :2].abs() + around) / slope - points[..., 2:]).max())


def _smoothed(path: Float[Tensor, "T 3"], deviation: float) -> Float[Tensor, "T 3"]:
    """A path evened out; its ends go on as they came, so that a walker does not leave the middle there."""
    width = min(len(path) - 1, math.ceil(4 * deviation))
    padded = np.pad(path.numpy(), ((width, width), (0, 0)), mode="reflect", reflect_type="odd")
    filtered = gaussian_filter1d(padded, deviation, axis=0, mode="nearest")
    return torch.from_numpy(filtered[width : width + len(path)].copy())


def _joint_reaches(body: ShapedBody) -> Float[Tensor, "24"]:
    """How far the body reaches around each joint, metres: balls around the joints hold it in every pose."""
    owner = body.weights.argmax(1)
    far = (body.vertices - body.joints[owner]).norm(dim=-1)
    reaches = torch.zeros(24).scatter_reduce(0, owner, far, "amax")
    # A bone's far end has a ball of its own, but for the head, the hands and the toes.
    inner = torch.tensor([joint in PARENTS for joint in range(24)])
    return torch.where(inner, reaches.clamp_max(_THICK), reaches) + _CLOTHES
