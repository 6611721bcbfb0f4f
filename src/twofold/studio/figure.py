"""The outer surface of a made person: body, clothes, shoes and hair as one closed mesh in the canonical pose.

Every layer is a signed distance built from the body's own. Their union is meshed, so nothing lies hidden under cloth,
hems are closed rims, and the mesh is exactly the surface that a camera sees.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Int
from scipy import ndimage, sparse
from scipy.sparse import csgraph
from scipy.spatial import KDTree
from skimage.measure import marching_cubes

from twofold.body.skeleton import ShapedBody
from twofold.geometry.surfaces import split_edges, vertex_normals
from twofold.kernels.kdtree import search_tree
from twofold.studio.anatomy import Anatomy, survey
from twofold.studio.appearance import Look
from twofold.studio.clothing import HAIR, SHIRT, SKIN, TROUSERS, dress

COARSE = 0.018
FINE = COARSE / 3
_FAR = 0.018
"""Steps of the grids; cells of the coarse one farther than this from the surface are not looked at again (metres)."""

Evaluate = Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]]
"""From points of the canonical pose to the signed distances of all layers and the same points in the T-pose."""


@dataclass(frozen=True)
class Figure:
    """A person in the canonical pose, ready to be posed and painted.

    Attributes:
        vertices: the closed outer surface, metres.
        faces: triangles.
        normals: unit.
        rest: the vertices in the T-pose; patterns are laid out there.
        weights: skinning weights, at most four a vertex.
        layers: signed distance of every layer at every vertex; the smallest is the one to see.
        anatomy: landmarks.
    """

    vertices: Float[np.ndarray, "V 3"]
    faces: Int[np.ndarray, "F 3"]
    normals: Float[np.ndarray, "V 3"]
    rest: Float[np.ndarray, "V 3"]
    weights: sparse.csr_matrix
    layers: Float[np.ndarray, "V 6"]
    anatomy: Anatomy


def build_figure(shaped: ShapedBody, look: Look) -> Figure:
    """Dress a body.

    Args:
        shaped: one person's body in the T-pose.
        look: what to wear.
    """
    anatomy = survey(shaped)
    tree = search_tree(anatomy.points)
    low = anatomy.points.min(0) - 0.09
    shape = tuple(int(n) + 1 for n in np.ceil((np.ptp(anatomy.points, axis=0) + 0.18) / COARSE))
    nodes = np.stack(np.meshgrid(*(np.arange(n) for n in shape), indexing="ij"), -1).reshape(-1, 3)
    nodes = (low + nodes * COARSE).astype(np.float32)
    exact, shift = _rough_distance(low, shape, anatomy, tree)
    blurred = [ndimage.gaussian_filter(exact, sigma / COARSE, mode="nearest") for sigma in (0.008, 0.016, 0.024)]
    shifts = [ndimage.gaussian_filter(shift[..., axis], 0.02 / COARSE, mode="nearest") for axis in range(3)]
    coarse = dress(nodes + np.stack([s.ravel() for s in shifts], -1), [f.ravel() for f in blurred], anatomy, look)
    nearest = np.minimum(coarse.min(1), exact.ravel()).reshape(shape)
    splines = [np.asarray(ndimage.spline_filter(field, order=3), np.float32) for field in blurred]

    def evaluate(points: Float[np.ndarray, "n 3"]) -> tuple[Float[np.ndarray, "n 6"], Float[np.ndarray, "n 3"]]:
        """Layers and T-pose positions of points of the canonical pose."""
        at = ((points - low) / COARSE).T
        smooth = [ndimage.map_coordinates(s, at, order=3, prefilter=False, mode="nearest") for s in splines]
        moved = [ndimage.map_coordinates(s, at, order=1, prefilter=False, mode="nearest") for s in shifts]
        rest = points + np.stack(moved, -1)
        layers = dress(rest, smooth, anatomy, look)
        # The body itself is looked up exactly only where it may be seen.
        bare = np.nonzero(layers[:, SKIN] < np.minimum(layers[:, 1:].min(1), 0.012) + 0.012)[0]
        layers[bare, SKIN] = _skin_distance(points[bare], anatomy, tree)
        return layers, rest

    vertices, faces = _mesh_union(nearest, low, evaluate)
    vertices, faces = _refine_ends(vertices, faces, evaluate, anatomy)
    layers, rest = evaluate(vertices)
    normals = vertex_normals(torch.from_numpy(vertices), torch.from_numpy(faces)).numpy()
    weights = _skinning_weights(vertices, faces, layers, anatomy, tree)
    return Figure(vertices, faces, normals, rest, weights, layers, anatomy)


def _rough_distance(
    low: Float[np.ndarray, "3"], shape: tuple[int, ...], anatomy: Anatomy, tree: KDTree
) -> tuple[Float[np.ndarray, "x y z"], Float[np.ndarray, "x y z 3"]]:
    """On the coarse grid: signed distance to the body, cut off beyond a hand's breadth, and the way to the T-pose."""
    cells = np.rint((anatomy.points - low) / COARSE).astype(int)
    shell = np.zeros(shape, bool)
    shell[tuple(cells.T)] = True
    shell = ndimage.binary_closing(shell, iterations=2)
    inside = np.asarray(ndimage.binary_fill_holes(shell), bool)
    reach = 5
    near = np.asarray(ndimage.binary_dilation(shell, np.ones((3, 3, 3)), iterations=reach), bool)
    field = np.where(inside, -reach * COARSE, reach * COARSE).astype(np.float32)
    shift = np.zeros((*shape, 3), np.float32)
    points = (low + np.argwhere(near) * COARSE).astype(np.float32)
    distance, index = tree.query(points)
    plane = ((points - anatomy.points[index]) * anatomy.normals[index]).sum(1)
    field[near] = np.where(distance > 0.01, np.copysign(distance, plane), plane).clip(-reach * COARSE, reach * COARSE)
    shift[near] = _straight_down(points, anatomy.weights[index], anatomy) - points
    return field, shift


def _straight_down(
    points: Float[np.ndarray, "n 3"], weights: Float[np.ndarray, "n 24"], anatomy: Anatomy
) -> Float[np.ndarray, "n 3"]:
    """Points of the canonical pose brought to the T-pose: whatever is the legs' turns back about the hips."""
    moved = points.copy()
    for hip, angle, chain in ((1, -np.pi / 6, [1, 4, 7, 10]), (2, np.pi / 6, [2, 5, 8, 11])):
        share = weights[:, chain].sum(1)
        x, y = (points - anatomy.joints[hip])[:, :2].T
        moved[:, 0] += share * (np.cos(angle) * x - np.sin(angle) * y - x)
        moved[:, 1] += share * (np.sin(angle) * x + np.cos(angle) * y - y)
    return moved


def _skin_distance(points: Float[np.ndarray, "n 3"], anatomy: Anatomy, tree: KDTree) -> Float[np.ndarray, "n"]:
    """Signed distance to the body as the weighted mean of the planes of the nearest samples."""
    distance, index = tree.query(points, k=8)
    width = 0.5 * distance[:, -1:] ** 2 + 1e-8
    weight = np.exp(-(distance**2 - distance[:, :1] ** 2) / width)
    planes = ((points[:, None] - anatomy.points[index]) * anatomy.normals[index]).sum(-1)
    return ((weight * planes).sum(1) / weight.sum(1)).astype(np.float32)


def _mesh_union(
    nearest: Float[np.ndarray, "x y z"], low: Float[np.ndarray, "3"], evaluate: Evaluate
) -> tuple[Float[np.ndarray, "V 3"], Int[np.ndarray, "F 3"]]:
    """Marching cubes of the union on a fine grid, evaluated only near the surface; the outermost piece of it."""
    volume = nearest.repeat(3, 0).repeat(3, 1).repeat(3, 2)[1:-1, 1:-1, 1:-1].copy()
    active = (np.abs(nearest) < _FAR).repeat(3, 0).repeat(3, 1).repeat(3, 2)[1:-1, 1:-1, 1:-1]
    index = np.argwhere(active)
    volume[active] = evaluate((low + index * FINE).astype(np.float32))[0].min(1)
    vertices, faces, _, _ = marching_cubes(volume, 0.0, spacing=(FINE,) * 3, gradient_direction="descent")
    vertices, faces = (vertices + low).astype(np.float32), faces.astype(np.int64)
    count = len(vertices)
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]]])
    graph = sparse.coo_matrix((np.ones(len(edges)), edges.T), shape=(count, count))
    part = csgraph.connected_components(graph, directed=False)[1]
    kept = part == np.bincount(part).argmax()
    return vertices[kept], (np.cumsum(kept) - 1)[faces[kept[faces[:, 0]]]]


def _refine_ends(
    vertices: Float[np.ndarray, "V 3"], faces: Int[np.ndarray, "F 3"], evaluate: Evaluate, anatomy: Anatomy
) -> tuple[Float[np.ndarray, "W 3"], Int[np.ndarray, "G 3"]]:
    """Halve the triangles of head and hands and draw them onto the layers, which have finer features than the grid."""
    fine = (vertices[:, 1] > anatomy.joints[12, 1]) | (np.abs(vertices[:, 0]) > abs(anatomy.joints[20, 0]) - 0.01)
    moved, finer, parents = split_edges(*(torch.from_numpy(a) for a in (vertices, faces, fine)))
    vertices, faces = moved.numpy(), finer.numpy()
    fine = fine[parents.numpy()].all(1)
    for _ in range(2):
        normals = vertex_normals(torch.from_numpy(vertices), torch.from_numpy(faces)).numpy()
        step = np.clip(evaluate(vertices[fine])[0].min(1), -0.003, 0.003)
        vertices[fine] -= 0.8 * step[:, None] * normals[fine]
    return vertices, faces


def _skinning_weights(
    vertices: Float[np.ndarray, "V 3"],
    faces: Int[np.ndarray, "F 3"],
    layers: Float[np.ndarray, "V 6"],
    anatomy: Anatomy,
    tree: KDTree,
) -> sparse.csr_matrix:
    """Weights of the nearest body samples; cloth shares them with its neighbourhood, hair follows the head alone."""
    distance, index = tree.query(vertices, k=6)
    near = (1 / (distance + 0.004)).astype(np.float32)
    near /= near.sum(1, keepdims=True)
    weights = np.einsum("vk,vkj->vj", near, anatomy.weights[index])
    layer = layers.argmin(1)
    cloth = np.nonzero(np.isin(layer, (SHIRT, TROUSERS)))[0]
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    graph = sparse.coo_matrix((np.ones(len(edges), np.float32), edges.T), shape=(len(vertices),) * 2).tocsr()
    neighbours = np.asarray(graph.sum(1))[cloth]
    around = graph[cloth]
    for _ in range(10):
        weights[cloth] = (around @ weights) / neighbours
    hair = layer == HAIR
    weights[hair] = 0
    weights[hair, 15] = 1
    np.put_along_axis(weights, np.argpartition(weights, -4, axis=1)[:, :-4], 0, axis=1)
    weights[weights < 1e-4] = 0
    return sparse.csr_matrix((weights / weights.sum(1, keepdims=True)).astype(np.float32))
