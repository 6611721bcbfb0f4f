"""Signed distance to a closed triangle mesh."""

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn import functional as F

from twofold.geometry.surfaces import face_normals, point_to_mesh

ON_EDGE = 1e-4
"""Barycentric coordinates below this count as zero: the nearest point lies on an edge or a corner."""


def signed_distance(
    points: Float[Tensor, "n 3"], vertices: Float[Tensor, "V 3"], faces: Int[Tensor, "F 3"]
) -> Float[Tensor, "n"]:
    """Distance of each point to a closed surface, negative inside; metres. Exact; not differentiable.

    The sign is that of (point - nearest point) times a pseudonormal: the triangle's normal, the sum of both triangles'
    normals on an edge, the sum of all, weighted by their angles, on a corner (Baerentzen and Aanaes 2005). The plain
    normal of one triangle is wrong beyond sharp edges.

    Args:
        points: metres.
        vertices: of the mesh, metres.
        faces: counter-clockwise from outside.
    """
    with torch.no_grad():
        distance, triangle, nearest = point_to_mesh(points, vertices, faces)
        normal = _pseudonormals(nearest, triangle, vertices, faces)
        inside = ((points - nearest) * normal).sum(-1) < 0
        return torch.where(inside, -distance, distance)


def _pseudonormals(nearest: Tensor, triangle: Tensor, vertices: Tensor, faces: Tensor) -> Tensor:
    corners = vertices[faces]
    of_faces = face_normals(vertices, faces)
    # An edge stands in both of its triangles, with its ends the other way round.
    ends = torch.stack([faces[:, [1, 2]], faces[:, [2, 0]], faces[:, [0, 1]]], 1).sort(-1).values
    _, edge = ends.flatten(0, 1).unique(dim=0, return_inverse=True)
    of_edges = torch.zeros(int(edge.max()) + 1, 3, dtype=vertices.dtype, device=vertices.device)
    of_edges.index_add_(0, edge, of_faces.repeat_interleave(3, 0))
    to_next = F.normalize(corners.roll(-1, 1) - corners, dim=-1)
    angles = torch.arccos((-to_next * to_next.roll(1, 1)).sum(-1).clamp(-1, 1))
    of_corners = torch.zeros_like(vertices)
    of_corners.index_add_(0, faces.flatten(), (angles[..., None] * of_faces[:, None]).flatten(0, 1))
    on_edge = _barycentric(nearest, corners[triangle]) < ON_EDGE
    normal = of_faces[triangle]
    rows = torch.arange(len(triangle), device=triangle.device)
    # The edge opposite to the corner without weight, or the corner that has all of it.
    opposite, corner = on_edge.int().argmax(1), (~on_edge).int().argmax(1)
    count = on_edge.sum(1)
    normal = torch.where(count[:, None] == 1, of_edges[edge.view(-1, 3)[triangle, opposite]], normal)
    return torch.where(count[:, None] == 2, of_corners[faces[triangle[rows], corner]], normal)


def _barycentric(points: Tensor, corners: Tensor) -> Tensor:
    """Weights of the three corners for points in the planes of triangles [n 3 3]."""
    a, b, c = corners.unbind(1)
    normal = torch.linalg.cross(b - a, c - a)
    squared = normal.square().sum(-1).clamp_min(1e-30)
    first = (torch.linalg.cross(c - b, points - b) * normal).sum(-1) / squared
    second = (torch.linalg.cross(a - c, points - c) * normal).sum(-1) / squared
    return torch.stack([first, second, 1 - first - second], 1)
