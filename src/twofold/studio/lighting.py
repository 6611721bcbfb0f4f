"""Light that stays where it is while the person turns: key light, sky, rim light, and their shadows."""

from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Int
from scipy import sparse

from twofold.kernels.kdtree import search_tree
from twofold.studio.texture import Paint


def _unit(*xyz: float) -> Float[np.ndarray, "3"]:
    return (np.array(xyz) / np.linalg.norm(xyz)).astype(np.float32)


KEY, RIM = _unit(-0.55, 0.75, 0.62), _unit(0.75, 0.35, -0.62)
KEY_COLOR = np.array([1.02, 0.96, 0.88], np.float32)
RIM_COLOR = np.array([0.30, 0.33, 0.40], np.float32)
SKY, GROUND = np.array([0.46, 0.49, 0.54], np.float32), np.array([0.27, 0.25, 0.23], np.float32)

_CELL = 0.016
_BIAS = 0.020
_GAP = 0.009
"""Cells of the grids seen from the lights, how far behind the front a point is lit, and distance of points; metres."""


class Beads(NamedTuple):
    """Vertices spread evenly over the surface, for which light is worked out, and the way back to all vertices."""

    chosen: Int[np.ndarray, "b"]
    spread: sparse.csr_matrix


def thread_beads(vertices: Float[np.ndarray, "V 3"], normals: Float[np.ndarray, "V 3"]) -> Beads:
    """Choose one vertex in every small cube, and mix the few nearest of them for every other vertex."""
    cubes = np.floor((vertices - vertices.min(0)) / _GAP).astype(np.int64)
    key = (cubes[:, 0] * 4096 + cubes[:, 1]) * 4096 + cubes[:, 2]
    index = np.unique(key, return_index=True)[1]
    distance, near = search_tree(vertices[index]).query(vertices, k=4)
    # Light on the other side of a thin part is none of a vertex's business.
    alike = (normals[index][near] * normals[:, None]).sum(-1).clip(0.02)
    weight = alike / (distance + 0.003)
    weight /= weight.sum(1, keepdims=True)
    rows = np.arange(0, 4 * len(vertices) + 1, 4)
    spread = sparse.csr_matrix((weight.astype(np.float32).ravel(), near.ravel(), rows), (len(vertices), len(index)))
    return Beads(index, spread)


def _directions() -> tuple[Float[np.ndarray, "k 3"], Float[np.ndarray, "s 3"]]:
    """A few directions over the face of the key light, and some evenly over the upper sky."""
    golden = np.pi * (3 - np.sqrt(5))
    side = np.cross(KEY, [0.0, 1.0, 0.0])
    side /= np.linalg.norm(side)
    up = np.cross(side, KEY)
    around = np.arange(7) * golden
    key = np.array(
        [KEY + 0.14 * np.sqrt((i + 0.5) / 7) * (np.cos(a) * side + np.sin(a) * up) for i, a in enumerate(around)]
    )
    height, turn = np.linspace(0.95, -0.25, 8), golden * np.arange(8)
    flat = np.sqrt(1 - height**2)
    sky = np.stack([np.cos(turn) * flat, height, np.sin(turn) * flat], -1)
    return (key / np.linalg.norm(key, axis=1, keepdims=True)).astype(np.float32), sky.astype(np.float32)


def cast_shade(
    vertices: Float[np.ndarray, "V 3"], normals: Float[np.ndarray, "V 3"], beads: Beads
) -> tuple[Float[np.ndarray, "V"], Float[np.ndarray, "V"]]:
    """How much of the key light and of the sky reaches each vertex of a posed surface, 0..1.

    The beads lie so densely that they alone, dropped into a grid of cells seen from the light, tell what is in front; a
    bead well behind the front of its cell lies in shade.
    """
    key_directions, sky_directions = _directions()
    v, n = torch.from_numpy(vertices[beads.chosen]), torch.from_numpy(normals[beads.chosen])
    key = torch.zeros(len(v))
    for direction in torch.from_numpy(key_directions):
        key += _lit(v, n @ direction, direction) / len(key_directions)
    weighted, total = torch.zeros(len(v)), torch.full((len(v),), 1e-3)
    for direction in torch.from_numpy(sky_directions):
        facing = (n @ direction).clamp_min(0) * (0.75 + 0.25 * direction[1])
        weighted += facing * _lit(v, n @ direction, direction)
        total += facing
    both = beads.spread @ torch.stack([key, weighted / total], -1).numpy()
    return both[:, 0], both[:, 1]


def _lit(
    vertices: Float[torch.Tensor, "b 3"], facing: Float[torch.Tensor, "b"], direction: Float[torch.Tensor, "3"]
) -> Float[torch.Tensor, "b"]:
    """Share of the light from one direction that arrives, softened over neighbouring cells.

    Args:
        vertices: world, metres.
        facing: cosine between their normals and the direction; seen at a slant, a surface spans more depth in a cell.
        direction: towards the light.
    """
    slack = _BIAS * (0.5 + 0.5 / facing.abs().clamp_min(0.15))
    helper = torch.tensor([0.0, 0.0, 1.0]) if abs(float(direction[1])) > 0.9 else torch.tensor([0.0, 1.0, 0.0])
    right = torch.linalg.cross(helper, direction)
    right = right / right.norm()
    up = torch.linalg.cross(direction, right)
    x, y, depth = vertices @ (right / _CELL), vertices @ (up / _CELL), -(vertices @ direction)
    x, y = x - (x.min() - 1.5), y - (y.min() - 1.5)
    stride = int(y.max()) + 3
    front = torch.full(((int(x.max()) + 3) * stride,), torch.inf)
    front.scatter_reduce_(0, x.round().long() * stride + y.round().long(), depth, "amin")
    left, below = x.floor(), y.floor()
    px, py = x - left, y - below
    corner = left.long() * stride + below.long()
    lit = torch.zeros(len(vertices))
    for i, wx in ((0, 1 - px), (1, px)):
        for j, wy in ((0, 1 - py), (1, py)):
            gap = depth - front[corner + (i * stride + j)]
            lit += wx * wy * (1 - (gap - slack) * 80).clamp(0, 1)
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
    light = 1.05 * from_key[:, None] * KEY_COLOR + from_rim[:, None] * RIM_COLOR + ambient
    half = to_camera + KEY
    half = half / np.linalg.norm(half, axis=1, keepdims=True).clip(1e-6)
    shine = np.clip((normals * half).sum(1), 0, None) ** 24 * key * paint.gloss
    return to_srgb(0.95 * paint.color * light + shine[:, None] * KEY_COLOR)


def to_srgb(light: Float[np.ndarray, "*b 3"]) -> Float[np.ndarray, "*b 3"]:
    """Linear light to sRGB; what is brighter than white approaches it softly."""
    bright = np.maximum(light - 0.75, 0)
    soft = np.where(light > 0.75, 0.75 + 0.25 * (1 - np.exp(-4 * bright)), np.maximum(light, 0))
    return np.where(soft <= 0.0031308, 12.92 * soft, 1.055 * np.maximum(soft, 1e-8) ** (1 / 2.4) - 0.055).astype(
        np.float32
    )
