"""The studio itself: a ring of cameras, the room behind, masks that a program might have made."""

import math

import numpy as np
import torch
from jaxtyping import Float
from scipy import ndimage

from twofold.geometry.cameras import Camera, pixel_grid, pixel_rays
from twofold.geometry.raster import supersampled
from twofold.geometry.rotations import rigid_transform
from twofold.studio.anatomy import bearing

DISTANCE, HEIGHT = 3.0, 1.2
"""Of the cameras from the middle of the studio and above its floor, metres."""


def ring(count: int, size: int, body: Float[np.ndarray, "n 3"]) -> dict[str, Camera]:
    """Cameras evenly around the middle, all looking at it; the first one stands ahead (+z).

    Args:
        count: how many.
        size: rows and columns of their images.
        body: points that must be seen, world, metres.
    """
    middle = 0.5 * float(body[:, 1].min() + body[:, 1].max())
    views = [_toward(2 * math.pi * i / count, middle) for i in range(count)]
    rays = [body @ view[:3, :3].T.numpy() + view[:3, 3].numpy() for view in views]
    widest = max(float(np.abs(ray[:, :2] / ray[:, 2:]).max()) for ray in rays)
    focal, center = 0.5 * 0.98 * size / widest, 0.5 * (size - 1)
    intrinsics = torch.tensor([[focal, 0.0, center], [0.0, focal, center], [0.0, 0.0, 1.0]])
    return {f"camera{i:02d}": Camera(view, intrinsics, size, size) for i, view in enumerate(views)}


def _toward(angle: float, middle: float) -> Float[torch.Tensor, "4 4"]:
    """World to camera for a place on the ring, looking at the axis of the studio at some height."""
    eye = torch.tensor([DISTANCE * math.sin(angle), HEIGHT, DISTANCE * math.cos(angle)])
    forward = torch.tensor([0.0, middle, 0.0]) - eye
    forward = forward / forward.norm()
    right = torch.linalg.cross(forward, torch.tensor([0.0, 1.0, 0.0]))
    right = right / right.norm()
    rotation = torch.stack([right, torch.linalg.cross(forward, right), forward])
    return rigid_transform(rotation, -rotation @ eye)


def room(camera: Camera, seed: int) -> Float[np.ndarray, "h w 3"]:
    """What a camera sees of the empty studio: a board floor and a round wall with paper and posters; sRGB, 0..1."""
    random = np.random.default_rng([seed, 4])
    fine = supersampled(camera, 2)
    rays = pixel_rays(fine, pixel_grid(fine))
    o, d = rays.origins.numpy(), rays.directions.numpy()
    radius, o2 = 4.2, o[..., [0, 2]]
    d2 = d[..., [0, 2]]
    a, b, c = (d2 * d2).sum(-1), (o2 * d2).sum(-1), (o2 * o2).sum(-1) - radius**2
    wall = (-b + np.sqrt(np.maximum(b * b - a * c, 0))) / a
    floor = np.where(d[..., 1] < -1e-4, -o[..., 1] / np.minimum(d[..., 1], -1e-4), np.inf)
    on_floor = floor < wall
    p = o + np.where(on_floor, floor, wall)[..., None] * d
    boards = np.floor(p[..., 0] / 0.16)
    tone = 0.75 + 0.18 * np.sin(boards * 12.9898) + 0.05 * np.sin(p[..., 2] * 35 + 4 * np.sin(boards * 3.1))
    tone = tone * np.where(np.abs(p[..., 0] / 0.16 - boards - 0.5) > 0.47, 0.6, 1)
    wood = tone[..., None] * np.array([0.56, 0.42, 0.30])
    angle, y = bearing(p[..., 0], p[..., 2]), p[..., 1]
    base = np.array([[0.55, 0.60, 0.58], [0.62, 0.56, 0.50], [0.50, 0.54, 0.64]])[random.integers(3)]
    paper = 0.92 + 0.08 * np.sign(np.sin(angle * 60)) * np.ones_like(y) - 0.08 * np.clip(y - 1.5, -1, 1)
    paint = paper[..., None] * base
    for _ in range(9):
        center, height = random.uniform(-np.pi, np.pi), random.uniform(1.0, 2.2)
        u = (np.angle(np.exp(1j * (angle - center)))) * radius / random.uniform(0.22, 0.45)
        v = (y - height) / random.uniform(0.22, 0.45)
        color, other = random.uniform(0.15, 0.9, (2, 3))
        inside = np.maximum(np.abs(u), np.abs(v))
        art = np.where((np.sin(u * random.uniform(2, 9) + v * random.uniform(2, 9)) > 0)[..., None], color, other)
        paint = np.where((inside < 1)[..., None], np.where((inside > 0.88)[..., None], 0.15, art), paint)
    skirting = np.where((y < 0.12)[..., None], np.array([0.85, 0.84, 0.80]), paint)
    image = np.where(on_floor[..., None], wood, skirting).clip(0, 1)
    return image.reshape(camera.height, 2, camera.width, 2, 3).mean((1, 3)).astype(np.float32)


def degrade_mask(
    mask: Float[np.ndarray, "h w"], hands: Float[np.ndarray, "k 2"], strength: float, random: np.random.Generator
) -> Float[np.ndarray, "h w"]:
    """A mask as an estimator makes it: ragged, hard edges, at times without a hand or with a piece of the room.

    Args:
        mask: the true one.
        hands: pixels (column, row) of the hands.
        strength: 0 leaves it alone, 1 is about the worst that is still useful.
        random: where the faults come from.
    """
    if strength <= 0:
        return mask
    size = mask.shape[0]
    within, without = (np.asarray(ndimage.distance_transform_edt(m)) for m in (mask >= 0.5, mask < 0.5))
    # The edge runs between two pixels' centres, half a pixel from each.
    inside = np.where(mask >= 0.5, within - 0.5, 0.5 - without)
    waves = ndimage.gaussian_filter(random.normal(size=mask.shape), max(size * 0.012, 0.8))
    inside = inside + 0.006 * size * strength * waves / max(waves.std(), 1e-6)
    rows, columns = np.mgrid[: mask.shape[0], : mask.shape[1]]
    for column, row in hands:
        if random.random() < 0.25 * strength:
            inside[np.hypot(columns - column, rows - row) < size * random.uniform(0.02, 0.045)] = -1
    if random.random() < 0.5 * strength and (inside > 0).any():
        edge = np.argwhere(np.abs(inside) < 1.5)
        row, column = edge[random.integers(len(edge))]
        inside[np.hypot(columns - column, (rows - row) * 0.7) < size * random.uniform(0.015, 0.04)] = 1
    return (inside > 0).astype(np.float32)
