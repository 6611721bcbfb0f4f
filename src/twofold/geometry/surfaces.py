"""Triangle meshes as surfaces: normals, nearest points, distances, samples, subdivision."""

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from twofold.kernels.kdtree import search_tree
from twofold.kernels.triangle_tree import nearest_triangles


def face_normals(vertices: Float[Tensor, "V 3"], faces: Int[Tensor, "F 3"]) -> Float[Tensor, "F 3"]:
    """Unit normals of the triangles, outward where they run counter-clockwise; zero for a degenerate one."""
    normals = _doubled_area_normals(vertices, faces)
    return normals / normals.norm(dim=-1, keepdim=True).clamp_min(1e-20)


def face_areas(vertices: Float[Tensor, "V 3"], faces: Int[Tensor, "F 3"]) -> Float[Tensor, "F"]:
    """Areas of the triangles, square metres."""
    return 0.5 * _doubled_area_normals(vertices, faces).norm(dim=-1)


def vertex_normals(vertices: Float[Tensor, "V 3"], faces: Int[Tensor, "F 3"]) -> Float[Tensor, "V 3"]:
    """Unit normals of the vertices: the mean over their triangles, each weighted by its area."""
    weighted = _doubled_area_normals(vertices, faces)
    summed = torch.zeros_like(vertices)
    for corner in range(3):
        summed.index_add_(0, faces[:, corner], weighted)
    return summed / summed.norm(dim=-1, keepdim=True).clamp_min(1e-20)


def _doubled_area_normals(vertices: Float[Tensor, "V 3"], faces: Int[Tensor, "F 3"]) -> Float[Tensor, "F 3"]:
    a, b, c = vertices[faces[:, 0]], vertices[faces[:, 1]], vertices[faces[:, 2]]
    return torch.linalg.cross(b - a, c - a)


def nearest_vertices(
    points: Float[Tensor, "n 3"], vertices: Float[Tensor, "V 3"], k: int = 1
) -> tuple[Float[Tensor, "n k"], Int[Tensor, "n k"]]:
    """Distances (metres) to the `k` nearest vertices and their indices, nearest first. Exact; not differentiable."""
    tree = search_tree(vertices.detach().cpu().numpy())
    distances, indices = tree.query(points.detach().cpu().numpy(), k=k)
    return (
        torch.as_tensor(distances, dtype=points.dtype, device=points.device).view(-1, k),
        torch.as_tensor(indices, dtype=torch.int64, device=points.device).view(-1, k),
    )


def closest_on_triangles(
    points: Float[Tensor, "*b 3"], a: Float[Tensor, "*b 3"], b: Float[Tensor, "*b 3"], c: Float[Tensor, "*b 3"]
) -> Float[Tensor, "*b 3"]:
    """The point of each triangle abc that is nearest to each point: its foot inside, or else on one of the edges."""
    ab, ac, ap = b - a, c - a, points - a
    aa, bb, mixed = (ab * ab).sum(-1), (ac * ac).sum(-1), (ab * ac).sum(-1)
    p, q = (ap * ab).sum(-1), (ap * ac).sum(-1)
    determinant = aa * bb - mixed * mixed
    safe = torch.where(determinant > 1e-20, determinant, torch.ones_like(determinant))
    v, w = (bb * p - mixed * q) / safe, (aa * q - mixed * p) / safe
    inside = (v >= 0) & (w >= 0) & (v + w <= 1) & (determinant > 1e-20)
    best = a + v[..., None] * ab + w[..., None] * ac
    best_distance = torch.where(inside, (points - best).norm(dim=-1), torch.full_like(p, torch.inf))
    for start, end in ((a, b), (b, c), (c, a)):
        edge = end - start
        along = ((points - start) * edge).sum(-1) / (edge * edge).sum(-1).clamp_min(1e-20)
        candidate = start + along.clamp(0, 1)[..., None] * edge
        distance = (points - candidate).norm(dim=-1)
        nearer = distance < best_distance
        best = torch.where(nearer[..., None], candidate, best)
        best_distance = torch.where(nearer, distance, best_distance)
    return best


def point_to_mesh(
    points: Float[Tensor, "n 3"], vertices: Float[Tensor, "V 3"], faces: Int[Tensor, "F 3"]
) -> tuple[Float[Tensor, "n"], Int[Tensor, "n"], Float[Tensor, "n 3"]]:
    """Distance from each point to the surface, the nearest triangle, and the nearest point on it. Exact.

    On a CPU by a tree of boxes. Elsewhere candidates come in order of their centres, and the search for a point ends
    when even a triangle of the largest radius, centred as far away as the last candidate, could not be nearer.
    """
    corners = vertices[faces]
    if points.device.type == "cpu" and len(faces):
        arrays = nearest_triangles(points.detach().numpy(), corners.detach().numpy())
        distance, triangle, foot = (torch.from_numpy(array) for array in arrays)
        return distance.to(points.dtype), triangle, foot.to(points.dtype)
    return _point_to_mesh_by_centers(points, corners)


def _point_to_mesh_by_centers(points: Tensor, corners: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    centers = corners.mean(1)
    reach = float((corners - centers[:, None]).norm(dim=-1).max())
    tree, faces = search_tree(centers.detach().cpu().numpy()), len(corners)
    distances = torch.full_like(points[:, 0], torch.inf)
    triangles = torch.zeros(len(points), dtype=torch.int64, device=points.device)
    nearest = torch.zeros_like(points)
    open_points = torch.arange(len(points), device=points.device)
    k = min(8, faces)
    while len(open_points):
        here = points[open_points]
        away, index = tree.query(here.detach().cpu().numpy(), k=k)
        index = torch.as_tensor(index, dtype=torch.int64, device=points.device).view(-1, k)
        a, b, c = corners[index].unbind(-2)
        feet = closest_on_triangles(here[:, None].expand_as(a), a, b, c)
        best, which = (feet - here[:, None]).norm(dim=-1).min(-1)
        distances[open_points] = best
        triangles[open_points] = index.gather(1, which[:, None])[:, 0]
        nearest[open_points] = feet[torch.arange(len(here), device=points.device), which]
        last = torch.as_tensor(away.reshape(-1, k)[:, -1], dtype=points.dtype, device=points.device)
        open_points = open_points[(last - reach < best) & (k < faces)]
        k = min(4 * k, faces)
    return distances, triangles, nearest


def sample_surface(
    vertices: Float[Tensor, "V 3"], faces: Int[Tensor, "F 3"], count: int, generator: torch.Generator | None = None
) -> tuple[Float[Tensor, "n 3"], Float[Tensor, "n 3"]]:
    """Points spread evenly over the area at random, and the unit normals of their triangles."""
    areas = face_areas(vertices, faces).double()
    ends = areas.cumsum(0)
    random = torch.rand(count, 3, generator=generator, dtype=torch.float64, device="cpu").to(vertices.device)
    face = torch.searchsorted(ends, random[:, 0] * ends[-1]).clamp_max(len(faces) - 1)
    root = random[:, 1].sqrt()
    weights = torch.stack([1 - root, root * (1 - random[:, 2]), root * random[:, 2]], -1).to(vertices.dtype)
    return (weights[..., None] * vertices[faces[face]]).sum(1), face_normals(vertices, faces[face])


def split_edges(
    vertices: Float[Tensor, "V 3"], faces: Int[Tensor, "F 3"], refine: Bool[Tensor, "V"]
) -> tuple[Float[Tensor, "W 3"], Int[Tensor, "G 3"], Int[Tensor, "W 2"]]:
    """Halve every edge whose two ends are marked; a closed mesh stays closed.

    Returns:
        Vertices, triangles, and for each vertex the two old ones it is the mean of (itself twice for an old one).
    """
    f = faces.cpu().numpy()
    edges = np.stack([f, np.roll(f, -1, axis=1)], -1).reshape(-1, 2)
    edges.sort(axis=1)
    marked = refine.cpu().numpy()
    split = marked[edges].all(axis=1)
    unique, inverse = np.unique(edges[split, 0] * len(vertices) + edges[split, 1], return_inverse=True)
    middle = np.full(len(edges), -1)
    middle[split] = len(vertices) + inverse
    middle = middle.reshape(-1, 3)
    old = np.arange(len(vertices))
    halved = np.stack(np.divmod(unique, len(vertices)), -1)
    parents = torch.as_tensor(np.concatenate([np.stack([old, old], -1), halved]))
    new_faces = torch.as_tensor(_split_triangles(f, middle))
    return vertices[parents.to(vertices.device)].mean(1), new_faces.to(faces.device), parents.to(faces.device)


def _split_triangles(faces: Int[np.ndarray, "F 3"], middle: Int[np.ndarray, "F 3"]) -> Int[np.ndarray, "G 3"]:
    """Triangles after their edges got middle vertices (-1: none); edge i runs from corner i to corner i + 1.

    Edges are halved between marked corners, so of a triangle's three none, one or all are; never two.
    """
    count = (middle >= 0).sum(1)
    pieces = [faces[count == 0]]
    for edge in range(3):
        one = (count == 1) & (middle[:, edge] >= 0)
        a, b, c = (faces[one, (edge + i) % 3] for i in range(3))
        m = middle[one, edge]
        pieces += [np.stack([a, m, c], -1), np.stack([m, b, c], -1)]
    (a, b, c), (m, n, o) = faces[count == 3].T, middle[count == 3].T
    pieces += [np.stack(t, -1) for t in ((a, m, o), (m, b, n), (o, n, c), (m, n, o))]
    return np.concatenate(pieces)
