"""Light that stays where it is while the person turns: a key light, a sky, a rim light, and what they throw in shade."""

from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float

from twofold.capture.studio_paint import Paint


def _unit(*xyz: float) -> Float[np.ndarray, "3"]:
    return (np.array(xyz) / np.linalg.norm(xyz)).astype(np.float32)


KEY, RIM = _unit(-0.55, 0.75, 0.62), _unit(0.75, 0.35, -0.62)
KEY_COLOR = np.float32([1.02, 0.96, 0.88])
RIM_COLOR = np.float32([0.30, 0.33, 0.40])
SKY, GROUND = np.float32([0.46, 0.49, 0.54]), np.float32([0.27, 0.25, 0.23])

_CELL = 0.012
_BIAS = 0.016


class Shade(NamedTuple):
    """How much of the key light and of the sky reaches each vertex, 0..1."""

    key: Float[np.ndarray, "V"]
    sky: Float[np.ndarray, "V"]


def _directions() -> tuple[Float[np.ndarray, "k 3"], Float[np.ndarray, "s 3"]]:
    """A few directions over the face of the key light, and some evenly over the upper sky."""
    side = np.cross(KEY, [0.0, 1.0, 0.0])
    side /= np.linalg.norm(side)
    up = np.cross(side, KEY)
    key = [KEY + 0.10 * (a * side + b * up) for a, b in ((1, 0.3), (-0.3, 1), (-1, -0.3), (0.3, -1))]
    golden = np.pi * (3 - np.sqrt(5))
    height = np.linspace(0.95, -0.35, 10)
    sky = [[np.cos(i * golden) * np.sqrt(1 - h * h), h, np.sin(i * golden) * np.sqrt(1 - h * h)] for i, h in enumerate(height)]
    return np.float32(key) / np.linalg.norm(key, axis=1, keepdims=True).astype(np.float32), np.float32(sky)


def cast_shade(vertices: Float[np.ndarray, "V 3"], normals: Float[np.ndarray, "V 3"]) -> Shade:
    """Which light reaches which vertex of a posed, densely sampled surface.

    The surface is dense enough that its vertices alone, dropped into a grid of cells seen from the light, tell what is
    in front; a vertex a little behind the front of its cell lies in shade.
    """
    key_directions, sky_directions = _directions()
    v = torch.from_numpy(vertices)
    key = sum(_lit(v, d) for d in torch.from_numpy(key_directions)) / len(key_directions)
    weighted, total = torch.zeros(len(v)), torch.full((len(v),), 1e-3)
    for direction in torch.from_numpy(sky_directions):
        facing = (torch.from_numpy(normals) @ direction).clamp_min(0) * (0.75 + 0.25 * direction[1])
        weighted += facing * _lit(v, direction)
        total += facing
    return Shade(key.numpy(), (weighted / total).numpy())


def _lit(vertices: torch.Tensor, direction: torch.Tensor) -> torch.Tensor:
    """Share of light from one direction that arrives, softened over neighbouring cells."""
    helper = torch.tensor([0.0, 0.0, 1.0]) if abs(float(direction[1])) > 0.9 else torch.tensor([0.0, 1.0, 0.0])
    right = torch.linalg.cross(helper, direction)
    right = right / right.norm()
    up = torch.linalg.cross(direction, right)
    plane = torch.stack([vertices @ right, vertices @ up], -1) / _CELL
    depth = -(vertices @ direction)
    low = plane.amin(0) - 1.5
    at = plane - low
    size = at.amax(0).ceil().long() + 2
    cell = at.round().long()
    front = torch.full((int(size[0] * size[1]),), torch.inf)
    front.scatter_reduce_(0, cell[:, 0] * size[1] + cell[:, 1], depth, "amin")
    base = at.floor().long()
    part = at - base
    lit = torch.zeros(len(vertices))
    for i in (0, 1):
        for j in (0, 1):
            weight = (part[:, 0] if i else 1 - part[:, 0]) * (part[:, 1] if j else 1 - part[:, 1])
            gap = depth - front[(base[:, 0] + i) * size[1] + base[:, 1] + j]
            lit += weight * (1 - ((gap - _BIAS) / 0.01).clamp(0, 1))
    return lit


def illuminate(
    paint: Paint,
    normals: Float[np.ndarray, "n 3"],
    to_camera: Float[np.ndarray, "n 3"],
    key: Float[np.ndarray, "n"],
    sky: Float[np.ndarray, "n"],
) -> Float[np.ndarray, "n 3"]:
    """sRGB colours, 0..1, of lit surface samples.

    Args:
        paint: material.
        normals: unit, world.
        to_camera: unit, world.
        key: share of the key light that arrives.
        sky: share of the sky that is open.
    """
    from_key = np.clip((normals @ KEY + 0.12) / 1.12, 0, None) * key
    from_rim = np.clip(normals @ RIM, 0, None) * (0.3 + 0.7 * sky)
    up = (0.5 + 0.5 * normals[:, 1])[:, None]
    ambient = (GROUND + up * (SKY - GROUND)) * (0.25 + 0.75 * sky)[:, None]
    light = 0.95 * from_key[:, None] * KEY_COLOR + from_rim[:, None] * RIM_COLOR + ambient
    half = to_camera + KEY
    half = half / np.linalg.norm(half, axis=1, keepdims=True)
    shine = np.clip((normals * half).sum(1), 0, None) ** 24 * key * paint.gloss
    return to_srgb(0.86 * paint.color * light + shine[:, None] * KEY_COLOR)


def to_srgb(light: Float[np.ndarray, "*b 3"]) -> Float[np.ndarray, "*b 3"]:
    """Linear light to sRGB; what is brighter than white approaches it softly."""
    bright = np.maximum(light - 0.75, 0)
    soft = np.where(light > 0.75, 0.75 + 0.25 * (1 - np.exp(-4 * bright)), np.maximum(light, 0))
    return np.where(soft <= 0.0031308, 12.92 * soft, 1.055 * np.maximum(soft, 1e-8) ** (1 / 2.4) - 0.055).astype(np.float32)
