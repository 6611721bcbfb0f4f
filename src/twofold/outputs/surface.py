"""The avatar as a triangle mesh: marching cubes in canonical space, then forward skinning into a pose."""

import itertools
from collections.abc import Callable

import numpy as np
import torch
from jaxtyping import Float, Int
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import KDTree
from skimage.measure import marching_cubes
from torch import Tensor

from twofold.body.skeleton import PosedBody
from twofold.deform.skinning import neighbour_weights, to_posed, vertex_transforms
from twofold.errors import TwofoldError
from twofold.geometry.surfaces import face_areas, nearest_vertices

CORNERS = tuple(itertools.product((0, 1), repeat=3))
"""Of a grid cell."""


@torch.no_grad()
def extract_surface(
    level: Callable[[Float[Tensor, "n 3"]], Float[Tensor, "n"]],
    near: Float[Tensor, "V 3"],
    voxel: float = 0.008,
    radius: float = 0.1,
    chunk: int = 65_536,
) -> tuple[Float[Tensor, "W 3"], Int[Tensor, "F 3"]]:
    """The surface where `level` is zero: the connected piece of largest area, triangles counter-clockwise from outside.

    Only grid points near the body are asked for, an eighth of the box around a person.

    Args:
        level: zero on the surface, negative inside; canonical points in metres.
        near: canonical vertices of the body.
        voxel: edge of a grid cell, metres.
        radius: how far from these vertices the surface is looked for, metres, give or take a cell.
        chunk: points asked for at once.

    Raises:
        TwofoldError: there is no surface near the body, or the field gives numbers that are not finite.
    """
    low = near.amin(0) - radius - 2 * voxel
    size = ((near.amax(0) + radius - low) / (2 * voxel)).ceil().long() + 1
    wanted = _cells_near(near, low, size, voxel, radius)
    index = wanted.nonzero()
    values = torch.cat([level(low + voxel * part.to(near.device)) for part in index.split(chunk)])
    if not values.isfinite().all():
        raise TwofoldError(
            "The avatar's field gives numbers that are not finite; its training diverged, train it again."
        )
    volume = torch.full(wanted.shape, radius)
    volume[wanted] = values.float().cpu()
    if not (values < 0).any() or not (values > 0).any():
        raise TwofoldError(
            f"The avatar has no surface within {100 * radius:g} cm of its body; train it longer, or check its losses."
        )
    vertices, faces = _marching_cubes(volume.numpy(), wanted.numpy(), voxel)
    return keep_largest(low + torch.from_numpy(vertices).to(near), torch.from_numpy(faces).to(near.device))


def keep_largest(
    vertices: Float[Tensor, "V 3"], faces: Int[Tensor, "F 3"]
) -> tuple[Float[Tensor, "W 3"], Int[Tensor, "G 3"]]:
    """The connected piece of a mesh that has the largest area, without the vertices of the others."""
    triangles = faces.cpu().numpy()
    ends = np.concatenate([triangles[:, [0, 1]], triangles[:, [1, 2]]]).T
    graph = coo_matrix((np.ones(ends.shape[1], dtype=np.int8), (ends[0], ends[1])), shape=(len(vertices),) * 2)
    count, piece = connected_components(graph, directed=False)
    piece_of_face = torch.from_numpy(piece.astype(np.int64)).to(faces.device)[faces[:, 0]]
    areas = torch.zeros(count, device=faces.device).index_add(0, piece_of_face, face_areas(vertices, faces).float())
    kept = faces[piece_of_face == areas.argmax()]
    used, renumbered = kept.unique(return_inverse=True)
    return vertices[used], renumbered


def pose_surface(vertices: Float[Tensor, "n 3"], body: PosedBody, neighbours: int = 7) -> Float[Tensor, "n 3"]:
    """Canonical vertices carried into the body's pose, each with the skinning of its nearest canonical body vertices.

    Several neighbours make the weights smoother than the body's own tessellation, which would show as creases.
    """
    distances, nearest = nearest_vertices(vertices, body.canonical_vertices, neighbours)
    return to_posed(vertices, nearest, neighbour_weights(distances.square()), vertex_transforms(body))


def _cells_near(near: Tensor, low: Tensor, size: Tensor, voxel: float, radius: float) -> Tensor:
    """Which points of a grid are within `radius` of a vertex, decided for blocks of 2x2x2 points at their centre."""
    blocks = torch.stack(torch.meshgrid(*[torch.arange(int(n)) for n in size], indexing="ij"), -1)
    centers = low.cpu() + voxel * (2 * blocks + 0.5)
    tree = KDTree(near.detach().cpu().numpy())
    distances, _ = tree.query(centers.reshape(-1, 3).numpy(), distance_upper_bound=radius + voxel)
    close = torch.from_numpy(np.isfinite(distances)).reshape(blocks.shape[:3])
    return close.repeat_interleave(2, 0).repeat_interleave(2, 1).repeat_interleave(2, 2)


def _marching_cubes(volume: np.ndarray, known: np.ndarray, voxel: float) -> tuple[np.ndarray, np.ndarray]:
    """Vertices relative to the grid's origin, and triangles, of the zero level where all corners of a cell are known."""
    # scikit-image takes a cell where its mask holds at the cell's last corner.
    cells = np.zeros_like(known)
    corners = [
        known[tuple(slice(c, n - 1 + c) for c, n in zip(corner, known.shape, strict=True))] for corner in CORNERS
    ]
    cells[1:, 1:, 1:] = np.logical_and.reduce(corners)
    try:
        vertices, faces, _, _ = marching_cubes(
            volume, 0.0, spacing=(voxel,) * 3, gradient_direction="descent", allow_degenerate=False, mask=cells
        )
    except RuntimeError as error:
        raise TwofoldError("The avatar has no surface near its body; train it longer, or check its losses.") from error
    return vertices.copy(), faces.astype(np.int64)
