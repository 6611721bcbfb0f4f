"""Points spread over every triangle of a mesh, shared along edges: where a field is queried for what a texture shows.

A texture has millions of texels, a field of a person changes over millimetres. So it is queried at the nodes of a
lattice in each triangle and interpolated between; nodes on an edge belong to both of its triangles, so nothing changes
across edges, nor across the seams of an atlas.
"""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor


@dataclass(frozen=True)
class TriangleLattice:
    """Each edge of a mesh in `segments` equal parts.

    Attributes:
        segments: parts of an edge.
        corners: the three vertices that each node lies between; the mesh's own vertices are the first nodes.
        barycentric: barycentric weights of these.
        table: of each triangle the nodes, by rows: node (i, j), `i + j <= segments`, has the barycentric weights
            i / segments and j / segments of the second and third corner.
    """

    segments: int
    corners: Int[Tensor, "N 3"]
    barycentric: Float[Tensor, "N 3"]
    table: Int[np.ndarray, "F L"]

    def __len__(self) -> int:
        return len(self.corners)

    def interpolate(self, values: Float[Tensor, "V *c"]) -> Float[Tensor, "N *c"]:
        """Values at the nodes, from those at the vertices."""
        barycentric = self.barycentric.reshape(*self.barycentric.shape, *[1] * (values.dim() - 1))
        parts = (barycentric[:, corner] * values[self.corners[:, corner]] for corner in range(3))
        return torch.stack(list(parts)).sum(0)


def build_lattice(vertices: int, faces: Int[np.ndarray, "F 3"], segments: int) -> TriangleLattice:
    """The lattice of a mesh with `vertices` vertices.

    >>> lattice = build_lattice(4, np.array([[0, 1, 2], [2, 1, 3]]), 2)
    >>> len(lattice), lattice.table.shape
    (9, (2, 6))
    """
    edges, edge_of_side = _edges(faces, vertices)
    inner = segments - 1
    inside = [(i, j) for i in range(1, segments) for j in range(1, segments - i)]
    first_inside = vertices + len(edges) * inner
    local = [(i, j) for i in range(segments + 1) for j in range(segments + 1 - i)]
    table = np.empty((len(faces), len(local)), dtype=np.int32)
    for place, (i, j) in enumerate(local):
        k = segments - i - j
        weights = (k, i, j)
        if segments in weights:
            table[:, place] = faces[:, weights.index(segments)]
        elif 0 in weights:
            side = (weights.index(0) + 1) % 3  # the side opposite to corner c runs from c + 1 to c + 2
            start, end = faces[:, side], faces[:, (side + 1) % 3]
            along = weights[(side + 1) % 3]  # parts away from the side's start
            steps = np.where(start < end, along, segments - along)
            table[:, place] = vertices + edge_of_side[:, side] * inner + steps - 1
        else:
            table[:, place] = first_inside + np.arange(len(faces)) * len(inside) + inside.index((i, j))
    count = first_inside + len(faces) * len(inside)
    corners, barycentric = np.zeros((count, 3), dtype=np.int64), np.zeros((count, 3), dtype=np.float32)
    for place, (i, j) in enumerate(local):
        corners[table[:, place]] = faces
        barycentric[table[:, place]] = np.array([segments - i - j, i, j], dtype=np.float32) / segments
    unused = barycentric.sum(1) == 0
    barycentric[unused, 0] = 1
    corners[unused] = np.arange(count)[unused, None].clip(max=vertices - 1)
    return TriangleLattice(segments, torch.from_numpy(corners), torch.from_numpy(barycentric), table)


def segments_for(vertices: int, faces: int, budget: int, most: int = 6) -> int:
    """How many parts an edge may have, at most, for the lattice to have no more than `budget` nodes; at least one.

    >>> segments_for(20_000, 40_000, 200_000)
    3
    """
    # A closed mesh has half as many vertices as triangles and half as many edges again.
    return max((n for n in range(1, most + 1) if vertices + faces * (n * n - 1) / 2 <= budget), default=1)


def _edges(faces: np.ndarray, vertices: int) -> tuple[np.ndarray, np.ndarray]:
    """Undirected edges, and for each side of each triangle (from corner s to s + 1) which one it is."""
    start, end = faces, np.roll(faces, -1, axis=1)
    keys = np.minimum(start, end).astype(np.int64) * vertices + np.maximum(start, end)
    unique, inverse = np.unique(keys.ravel(), return_inverse=True)
    return unique, inverse.reshape(faces.shape)
