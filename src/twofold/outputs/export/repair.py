"""Triangle meshes for other programs: equal positions merged, closed, with as few faces as asked for."""

import importlib
from collections.abc import Callable

import numpy as np
import torch
from jaxtyping import Float, Int
from scipy import ndimage, sparse
from torch import Tensor

from twofold.errors import TwofoldError, install_command
from twofold.geometry.surfaces import nearest_vertices, sample_surface

SAME = 2e-6
"""Positions closer than this, metres, are one vertex."""
DEEP = 0.05
"""Points further inside the body than this, metres, belong to the person whatever the field says: no ray gets there, so
nothing is learned there."""
_CELL, _SAMPLES = 0.02, 300_000
"""Cells in which depth below the body's surface is counted, metres; and points on that surface that fill
each of its cells."""
_ROUNDS = 8


def weld(
    vertices: Float[np.ndarray, "V 3"], faces: Int[np.ndarray, "F 3"], same: float = SAME
) -> tuple[Float[np.ndarray, "W 3"], Int[np.ndarray, "G 3"]]:
    """Merge equal positions, drop triangles that have become lines, and those that stand twice.

    Two triangles of the same three vertices that face each other enclose nothing, so both go.

    >>> corners = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 0], [0, 0, 1]], dtype=np.float32)
    >>> merged, triangles = weld(corners, np.array([[0, 1, 2], [3, 1, 4], [0, 3, 1]]))
    >>> len(merged), len(triangles)
    (4, 2)
    """
    low = vertices.min(0, initial=np.inf)
    same = max(same, float(np.max(vertices - low, initial=0)) / (1 << 20))
    _, first, inverse = np.unique(_packed(np.round((vertices - low) / same)), return_index=True, return_inverse=True)
    triangles = inverse[faces]
    a, b, c = triangles.T
    triangles = triangles[(a != b) & (b != c) & (c != a)]
    _, one, kind, count = np.unique(
        _packed(np.sort(triangles, axis=1)), return_index=True, return_inverse=True, return_counts=True
    )
    chosen = np.zeros(len(triangles), dtype=bool)
    chosen[one] = True
    triangles = triangles[chosen & (count[kind] % 2 == 1)]
    return _without_unused(vertices[first], triangles)


def open_edges(faces: Int[np.ndarray, "F 3"]) -> tuple[Int[np.ndarray, "n 2"], Int[np.ndarray, "m 2"]]:
    """Edges that keep a mesh from being closed.

    Returns:
        directed edges whose opposite is in no triangle, and undirected edges that more than two triangles share.

    >>> tetrahedron = np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3], [0, 3, 2]])
    >>> [len(edges) for edges in open_edges(tetrahedron)], [len(edges) for edges in open_edges(tetrahedron[:3])]
    ([0, 0], [3, 0])
    """
    directed = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    size = int(faces.max(initial=0)) + 1
    forward, backward = directed[:, 0] * size + directed[:, 1], directed[:, 1] * size + directed[:, 0]
    lonely = directed[~np.isin(forward, backward)]
    undirected, count = np.unique(np.minimum(forward, backward), return_counts=True)
    return lonely, np.stack(np.divmod(undirected[count > 2], size), -1)


def is_watertight(vertices: Float[np.ndarray, "V 3"], faces: Int[np.ndarray, "F 3"]) -> bool:
    """Whether each edge belongs to two triangles of opposite direction, after merging equal positions."""
    if len(faces) == 0:
        return False
    _, triangles = weld(vertices, faces)
    lonely, crowded = open_edges(triangles)
    return len(lonely) == 0 and len(crowded) == 0


def repair(
    vertices: Float[np.ndarray, "V 3"], faces: Int[np.ndarray, "F 3"]
) -> tuple[Float[np.ndarray, "W 3"], Int[np.ndarray, "G 3"]]:
    """Close a mesh: triangles at edges that more than two share are removed, then every hole is filled.

    A hole of more than three edges gets a vertex at the mean of its rim. What cannot be closed in some rounds stays
    open; `is_watertight` tells.
    """
    vertices, faces = weld(vertices, faces)
    for _ in range(_ROUNDS):
        lonely, crowded = open_edges(faces)
        if len(lonely) == 0 and len(crowded) == 0:
            break
        if len(crowded):
            faces = _without_edges(faces, crowded)
            lonely, _ = open_edges(faces)
        vertices, faces = _filled(vertices, faces, lonely)
        vertices, faces = weld(vertices, faces)
    return vertices, faces


def decimate(
    vertices: Float[np.ndarray, "V 3"], faces: Int[np.ndarray, "F 3"], target: int
) -> tuple[Float[np.ndarray, "W 3"], Int[np.ndarray, "G 3"]]:
    """The mesh with about `target` triangles (quadric error metric), repaired; as it is where it has no more.

    Raises:
        TwofoldError: the package fast-simplification is not installed.
    """
    vertices, faces = repair(vertices, faces)
    if len(faces) <= target:
        return vertices, faces
    try:
        simplify = importlib.import_module("fast_simplification").simplify
    except ImportError as error:
        raise TwofoldError(
            "Reducing a mesh needs the package fast-simplification, which is not installed; "
            f"run {install_command('export')}."
        ) from error
    points, triangles = simplify(vertices.astype(np.float32), faces.astype(np.int32), target_count=target)
    return repair(points.astype(np.float32), triangles.astype(np.int64))


def solid(
    level: Callable[[Float[Tensor, "n 3"]], Float[Tensor, "n"]],
    body: Float[Tensor, "V 3"],
    faces: Int[Tensor, "F 3"],
    reach: float,
    deep: float = DEEP,
) -> Callable[[Float[Tensor, "n 3"]], Float[Tensor, "n"]]:
    """The same level, negative deep inside the body and positive out of reach, where nothing is ever rendered.

    Args:
        level: signed distance of canonical points, metres.
        body: canonical vertices of the body.
        faces: its triangles.
        reach: distance from the body's vertices beyond which points are empty, metres.
        deep: depth below the body's surface from which on nobody asks the field, metres.
    """
    spread, _ = sample_surface(body.detach().cpu(), faces.cpu(), _SAMPLES, torch.Generator().manual_seed(0))
    points = torch.cat([body.detach().cpu(), spread]).numpy()
    low = points.min(0) - 2 * _CELL
    cells = ((points - low) / _CELL).astype(np.int64)
    surface = np.zeros(cells.max(0) + 3, dtype=bool)
    surface[tuple(cells.T)] = True
    # The surface's own cells count as inside, so depths are counted from one cell further out.
    inside = np.asarray(ndimage.binary_fill_holes(surface))
    depth = torch.from_numpy(_CELL * (np.asarray(ndimage.distance_transform_edt(inside)) - 2)).to(body)
    corner, shape = torch.from_numpy(low).to(body), torch.tensor(depth.shape, device=body.device)

    def filled(x: Float[Tensor, "n 3"]) -> Float[Tensor, "n"]:
        cell = ((x - corner) / _CELL).long().clamp_min(0).minimum(shape - 1)
        here = depth[tuple(cell.unbind(-1))]
        values = torch.where(here > deep, -here, level(x))
        near = ((values < reach) & (here <= 0)).nonzero()[:, 0]
        away, _ = nearest_vertices(x[near], body)
        return values.index_put((near,), torch.maximum(values[near], away[:, 0] - reach))

    return filled


def neighbour_means(count: int, faces: Int[np.ndarray, "F 3"]) -> sparse.csr_matrix:
    """Matrix that takes a value at each vertex to the mean of the values at the vertices that share an edge with it."""
    ends = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    lower, upper = ends.min(1), ends.max(1)
    ends = np.stack(np.divmod(np.unique(lower * count + upper), count), -1)
    rows, columns = np.concatenate([ends, ends[:, ::-1]]).T
    adjacency = sparse.csr_matrix((np.ones(len(rows), dtype=np.float32), (rows, columns)), (count, count))
    degree = np.asarray(adjacency.sum(1)).ravel()
    return sparse.csr_matrix(sparse.diags((1 / np.maximum(degree, 1)).astype(np.float32)) @ adjacency)


def as_tensors(
    vertices: Float[np.ndarray, "V 3"], faces: Int[np.ndarray, "F 3"]
) -> tuple[Float[Tensor, "V 3"], Int[Tensor, "F 3"]]:
    """A mesh of NumPy arrays as one of tensors."""
    return torch.from_numpy(np.ascontiguousarray(vertices, dtype=np.float32)), torch.from_numpy(faces.astype(np.int64))


def _packed(rows: np.ndarray) -> np.ndarray:
    """Three numbers of 0..2^21 in one."""
    x, y, z = rows.astype(np.int64).T
    return (x << 42) | (y << 21) | z


def _without_unused(vertices: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    used, renumbered = np.unique(faces, return_inverse=True)
    return vertices[used], renumbered.reshape(-1, 3)


def _without_edges(faces: np.ndarray, edges: np.ndarray) -> np.ndarray:
    """The triangles that have none of these undirected edges."""
    size = int(faces.max()) + 1
    unwanted = edges[:, 0] * size + edges[:, 1]
    own = np.sort(np.stack([faces, np.roll(faces, -1, axis=1)], -1), axis=-1)
    return faces[~np.isin(own[..., 0] * size + own[..., 1], unwanted).any(axis=1)]


def _filled(vertices: np.ndarray, faces: np.ndarray, lonely: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The mesh with a fan over each hole; `lonely` are its open edges as `open_edges` gives them."""
    added, centers = [faces], [vertices]
    count = len(vertices)
    for rim in _loops(lonely):
        following = np.roll(rim, -1)
        if len(rim) == 3:
            added.append(rim[::-1][None])
            continue
        centers.append(vertices[rim].mean(0, keepdims=True))
        added.append(np.stack([following, rim, np.full(len(rim), count)], -1))
        count += 1
    return np.concatenate(centers).astype(vertices.dtype), np.concatenate(added)


def _loops(directed: np.ndarray) -> list[np.ndarray]:
    """Simple closed walks along directed edges; edges that lead nowhere are left out."""
    following: dict[int, list[int]] = {}
    for start, end in directed.tolist():
        following.setdefault(start, []).append(end)
    loops: list[np.ndarray] = []
    for first in list(following):
        while following.get(first):
            walk, place = [first], {first: 0}
            while following.get(walk[-1]):
                end = following[walk[-1]].pop()
                if end in place:
                    loop = walk[place[end] :]
                    loops += [np.array(loop)] if len(loop) > 2 else []
                    for vertex in walk[place[end] + 1 :]:
                        del place[vertex]
                    del walk[place[end] + 1 :]
                    if end == first:
                        break
                else:
                    place[end] = len(walk)
                    walk.append(end)
            else:
                break
    return loops
