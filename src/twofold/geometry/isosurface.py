"""The zero level of a signed distance as a triangle mesh: marching cubes where the surface may be."""

import itertools
import math
from collections.abc import Callable

import numpy as np
import torch
from jaxtyping import Float, Int
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from skimage.measure import marching_cubes
from torch import Tensor

from twofold.errors import NoSurfaceError, TwofoldError
from twofold.geometry.surfaces import face_areas
from twofold.kernels.kdtree import search_tree

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

    It is queried on a grid of double width, where that is near the body, and on the fine grid only in those cells
    that may hold surface: a tenth of the points that the box around a person would have.

    Args:
        level: a signed distance in metres, zero on the surface, negative inside, of canonical points. Its slope may be
            up to one and a half; where it is steeper, things thinner than two voxels can be missed.
        near: canonical vertices of the body.
        voxel: edge of a grid cell, metres.
        radius: how far from these vertices the surface is looked for, metres, give or take a voxel.
        chunk: points asked for at once.

    Raises:
        TwofoldError: there is no surface near the body, or the field gives numbers that are not finite.
    """
    half_diagonal = math.sqrt(3) * voxel
    low = near.amin(0) - radius - 2 * voxel
    blocks = [int(n) for n in ((near.amax(0) + radius + 2 * voxel - low) / (2 * voxel)).ceil() + 1]
    volume = torch.full([2 * n - 1 for n in blocks], torch.nan)

    def ask(index: Int[Tensor, "n 3"]) -> None:
        parts = [level(low + voxel * part.to(near.device)) for part in index.split(chunk)]
        values = torch.cat(parts).float().cpu()
        if not values.isfinite().all():
            raise TwofoldError("The avatar's field gives numbers that are not finite: its training diverged.")
        volume[tuple(index.T)] = values

    ask(2 * _points_near(near, low, blocks, 2 * voxel, radius + half_diagonal).nonzero())
    corners = torch.stack([_shifted(volume[::2, ::2, ::2], corner) for corner in CORNERS])
    # The nearest corner of a cell is at most half its diagonal away from a surface that passes through it; corners that
    # were not asked are NaN, and comparing with them gives false.
    active = (corners.abs().amin(0) < 1.5 * half_diagonal) | (corners.amin(0) * corners.amax(0) <= 0)
    fine = active.repeat_interleave(2, 0).repeat_interleave(2, 1).repeat_interleave(2, 2)
    wanted = torch.zeros(volume.shape, dtype=torch.bool)
    for corner in CORNERS:
        wanted[tuple(slice(c, n + c) for c, n in zip(corner, fine.shape, strict=True))] |= fine
    ask((wanted & volume.isnan()).nonzero())
    if not (volume[wanted] < 0).any() or not (volume[wanted] > 0).any():
        raise NoSurfaceError(
            f"The avatar has no surface within {100 * radius:g} cm of its body; train it longer, or check its losses."
        )
    vertices, faces = _marching_cubes(volume.numpy(), fine.numpy(), voxel)
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


def _points_near(near: Tensor, low: Tensor, shape: list[int], spacing: float, radius: float) -> Tensor:
    """Which points of a grid are within `radius` of a vertex."""
    index = torch.stack(torch.meshgrid(*[torch.arange(n) for n in shape], indexing="ij"), -1)
    points = (low.cpu() + spacing * index).reshape(-1, 3)
    distances, _ = search_tree(near.detach().cpu().numpy()).query(points.numpy(), distance_upper_bound=radius)
    return torch.from_numpy(np.isfinite(distances)).reshape(shape)


def _shifted(values: Tensor, corner: tuple[int, ...]) -> Tensor:
    """At each cell of a grid the value at one of its corners."""
    return values[tuple(slice(c, n - 1 + c) for c, n in zip(corner, values.shape, strict=True))]


def _marching_cubes(volume: np.ndarray, cells: np.ndarray, voxel: float) -> tuple[np.ndarray, np.ndarray]:
    """Vertices relative to the grid's origin, and triangles, of the zero level in the chosen cells."""
    # scikit-image takes a cell where its mask holds at the cell's last corner.
    mask = np.pad(cells, ((1, 0), (1, 0), (1, 0)))
    try:
        vertices, faces, _, _ = marching_cubes(
            volume, 0.0, spacing=(voxel,) * 3, gradient_direction="descent", allow_degenerate=False, mask=mask
        )
    except RuntimeError as error:
        raise TwofoldError("The avatar has no surface near its body; train it longer, or check its losses.") from error
    return vertices.copy(), faces.astype(np.int64)
