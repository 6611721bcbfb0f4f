"""The outer surface of a made person: body, clothes, shoes and hair as one closed mesh in the canonical pose.

Every layer is a signed distance (negative inside, metres) built from the body's own. Their union is meshed, so nothing
lies hidden under cloth, hems are closed lips, and the mesh is exactly the surface that a camera sees.
"""

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from scipy import ndimage, sparse
from scipy.interpolate import PchipInterpolator
from scipy.spatial import cKDTree
from skimage.measure import marching_cubes

from twofold.body.skeleton import ShapedBody, pose_body
from twofold.capture.studio_look import Look
from twofold.geometry.cameras import Camera
from twofold.geometry.raster import rasterize
from twofold.geometry.rotations import axis_angle_to_matrix, rigid_transform
from twofold.geometry.surfaces import face_normals, split_edges, vertex_normals

SKIN, SHIRT, TROUSERS, SHOES, SOLES, HAIR = range(6)
"""Layers, in the order of `Figure.layers`."""

COARSE = 0.018
FINE = COARSE / 3
_FAR = 0.018
"""Cells of the coarse grid farther than this from the surface are not looked at again."""


class Anatomy(NamedTuple):
    """Where things are on this body in the T-pose, metres; and dense samples of it in the canonical pose.

    `joints`, `eyes` (left, right), `spread` between the eyes, `neck` radius, `crotch` and `floor` heights are those of
    the T-pose; `points` and `normals` of the samples are canonical, `rest` are the same samples in the T-pose.
    """

    joints: Float[np.ndarray, "24 3"]
    eyes: Float[np.ndarray, "2 3"]
    spread: float
    neck: float
    crotch: float
    floor: float
    points: Float[np.ndarray, "n 3"]
    normals: Float[np.ndarray, "n 3"]
    rest: Float[np.ndarray, "n 3"]
    weights: Float[np.ndarray, "n 24"]


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


def survey(shaped: ShapedBody) -> Anatomy:
    """Find the landmarks of a body."""
    posed = pose_body(shaped, torch.zeros(24, 3), torch.zeros(3))
    faces, eyes = _outer_parts(shaped)
    canonical = posed.canonical_vertices
    faces = faces[_seen_from_outside(canonical, faces, float(shaped.joints[12, 1]))]
    normals = vertex_normals(canonical, faces)
    used = torch.unique(faces)
    rest_joints = shaped.joints.numpy()
    points = canonical.numpy()
    near_middle = (np.abs(points[:, 0]) < 0.012) & (points[:, 1] < rest_joints[0, 1])
    crotch = points[near_middle, 1].min() if near_middle.any() else rest_joints[1, 1] - 0.09
    low, high = rest_joints[12, 1], rest_joints[15, 1]
    neck = np.abs(points[:, 1] - 0.5 * (low + high)) < 0.2 * (high - low)
    return Anatomy(
        joints=rest_joints,
        eyes=eyes,
        spread=float(np.linalg.norm(eyes[0] - eyes[1])),
        neck=float(np.median(_around_neck(points[neck], rest_joints))),
        crotch=float(crotch),
        floor=float(shaped.vertices[:, 1].min()),
        points=torch.cat([canonical[used], canonical[faces].mean(1)]).numpy(),
        normals=torch.cat([normals[used], face_normals(canonical, faces)]).numpy(),
        rest=torch.cat([shaped.vertices[used], shaped.vertices[faces].mean(1)]).numpy(),
        weights=torch.cat([shaped.weights[used], shaped.weights[faces].mean(1)]).numpy(),
    )


def _outer_parts(shaped: ShapedBody) -> tuple[torch.Tensor, Float[np.ndarray, "2 3"]]:
    """Faces of the body and its eyeballs (no tongue, no teeth), and where the eyes are."""
    faces = shaped.faces.numpy()
    vertices = shaped.vertices.numpy()
    count = len(vertices)
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]]])
    graph = sparse.coo_matrix((np.ones(len(edges)), edges.T), shape=(count, count))
    part = sparse.csgraph.connected_components(graph, directed=False)[1]
    body = np.bincount(part[faces[:, 0]]).argmax()
    head, neck = shaped.joints[15].numpy(), shaped.joints[12].numpy()
    # A body without separate eyeballs: half a neck's length above the head joint, as far apart as people's are.
    eyes = [head + np.array([s * 0.031, 0.0, 0.085], np.float32) for s in (1, -1)]
    kept = part == body
    for label_ in np.unique(part):
        points = vertices[part == label_]
        middle, size = points.mean(0), np.ptp(points, axis=0)
        if label_ != body and size.max() < 0.045 and middle[1] > neck[1] and abs(middle[0]) > 0.015:
            kept |= part == label_
            eyes[0 if middle[0] > 0 else 1] = middle.astype(np.float32)
    return torch.from_numpy(faces[kept[faces[:, 0]]]), np.stack(eyes)


def _around_neck(points: Float[np.ndarray, "n 3"], joints: Float[np.ndarray, "24 3"]) -> Float[np.ndarray, "n"]:
    """Distance from the line through neck and head, which lies a little before the spine; metres."""
    base, along = joints[12], joints[15] - joints[12]
    along = along / np.linalg.norm(along)
    off = points - base - ((points - base) @ along)[:, None] * along
    return np.hypot(off[:, 0], 0.88 * (off[:, 2] - 0.004))


def collar(points: Float[np.ndarray, "n 3"], anatomy: Anatomy) -> Float[np.ndarray, "n"]:
    """How far points of a shirt lie outside the opening for the neck, metres."""
    opening = _around_neck(points, anatomy.joints) - anatomy.neck - 0.014
    # Behind, the edge runs at the root of the neck; ahead it comes down to the collar bones.
    off = points - anatomy.joints[12]
    edge = -0.82 * (off[:, 1] + 0.030) - 0.57 * off[:, 2]
    return np.maximum(opening, edge).astype(np.float32)


def _seen_from_outside(
    vertices: Float[torch.Tensor, "V 3"], faces: Int[torch.Tensor, "F 3"], above: float
) -> Bool[torch.Tensor, "F"]:
    """All faces of the body, but of the head only those in view: no eye sockets, no mouth, no nostrils.

    Args:
        vertices: canonical.
        faces: of the body and its eyeballs.
        above: height of the neck, where the head begins.
    """
    seen = vertices[faces[:, 0], 1] < above
    head = vertices[vertices[:, 1] > above]
    center, size, distance = 0.5 * (head.amin(0) + head.amax(0)), 256, 2.0
    focal = 0.5 * size * distance / 0.17
    intrinsics = torch.tensor([[focal, 0.0, size / 2], [0.0, focal, size / 2], [0.0, 0.0, 1.0]])
    for turn, tilt in [(t * math.pi / 4, 0.0) for t in range(8)] + [(0.0, 0.6), (0.0, -0.7), (2.0, 1.2), (-2.0, 1.2)]:
        rotation = axis_angle_to_matrix(torch.tensor([math.pi + tilt, 0.0, 0.0])) @ axis_angle_to_matrix(
            torch.tensor([0.0, turn, 0.0])
        )
        view = rigid_transform(rotation, torch.tensor([0.0, 0.0, distance]) - rotation @ center)
        seen[rasterize(Camera(view, intrinsics, size, size), vertices, faces, cull=True).face] = True
    return seen


def build_figure(shaped: ShapedBody, look: Look) -> Figure:
    """Dress a body.

    Args:
        shaped: one person's body in the T-pose.
        look: what to wear.
    """
    anatomy = survey(shaped)
    tree = cKDTree(anatomy.points)
    low = anatomy.points.min(0) - 0.09
    shape = tuple(np.ceil((np.ptp(anatomy.points, axis=0) + 0.18) / COARSE).astype(int) + 1)
    nodes = np.stack(np.meshgrid(*(np.arange(n) for n in shape), indexing="ij"), -1).reshape(-1, 3)
    nodes = (low + nodes * COARSE).astype(np.float32)
    exact, shift = _rough_distance(low, shape, anatomy, tree)
    blurred = [ndimage.gaussian_filter(exact, sigma / COARSE, mode="nearest") for sigma in (0.008, 0.016, 0.024)]
    blurred += [ndimage.gaussian_filter(shift[..., axis], 0.02 / COARSE, mode="nearest") for axis in range(3)]
    coarse = dress(
        nodes + np.stack([s.ravel() for s in blurred[3:]], -1), [f.ravel() for f in blurred[:3]], anatomy, look
    )
    nearest = np.minimum(coarse.min(1), exact.ravel()).reshape(shape)
    splines = [ndimage.spline_filter(field, order=3, output=np.float32) for field in blurred]

    def evaluate(points: Float[np.ndarray, "n 3"]) -> tuple[Float[np.ndarray, "n 6"], Float[np.ndarray, "n 3"]]:
        """Layers and T-pose positions of points of the canonical pose."""
        at = ((points - low) / COARSE).T
        smooth = [ndimage.map_coordinates(s, at, order=3, prefilter=False, mode="nearest") for s in splines[:3]]
        moved = [ndimage.map_coordinates(s, at, order=1, prefilter=False, mode="nearest") for s in blurred[3:]]
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
    low: Float[np.ndarray, "3"], shape: tuple[int, ...], anatomy: Anatomy, tree: cKDTree
) -> tuple[Float[np.ndarray, "x y z"], Float[np.ndarray, "x y z 3"]]:
    """On the coarse grid: signed distance to the body, cut off beyond a hand's breadth, and the way to the T-pose."""
    cells = np.rint((anatomy.points - low) / COARSE).astype(int)
    shell = np.zeros(shape, bool)
    shell[tuple(cells.T)] = True
    shell = ndimage.binary_closing(shell, iterations=2)
    inside = ndimage.binary_fill_holes(shell)
    reach = 5
    near = ndimage.binary_dilation(shell, np.ones((3, 3, 3)), iterations=reach)
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


def _skin_distance(points: Float[np.ndarray, "n 3"], anatomy: Anatomy, tree: cKDTree) -> Float[np.ndarray, "n"]:
    """Signed distance to the body as the weighted mean of the planes of the nearest samples."""
    distance, index = tree.query(points, k=8)
    width = 0.5 * distance[:, -1:] ** 2 + 1e-8
    weight = np.exp(-(distance**2 - distance[:, :1] ** 2) / width)
    planes = ((points[:, None] - anatomy.points[index]) * anatomy.normals[index]).sum(-1)
    return ((weight * planes).sum(1) / weight.sum(1)).astype(np.float32)


def smoothstep(low: float, high: float, x: np.ndarray) -> np.ndarray:
    """0 below `low`, 1 above `high`, smooth between."""
    t = np.clip((x - low) / (high - low), 0, 1)
    return t * t * (3 - 2 * t)


def arm_reach(points: Float[np.ndarray, "n 3"], anatomy: Anatomy) -> Float[np.ndarray, "n"]:
    """How far along an arm: 0 shoulder, 1 elbow, 2 wrist."""
    j = anatomy.joints
    stations = [0.0, abs(j[16, 0]), abs(j[18, 0]), abs(j[20, 0]), abs(j[22, 0])]
    return np.interp(np.abs(points[:, 0]), stations, [-0.5, 0, 1, 2, 2.5]).astype(np.float32)


def leg_reach(points: Float[np.ndarray, "n 3"], anatomy: Anatomy) -> Float[np.ndarray, "n"]:
    """How far along a leg: 0 hip, 1 knee, 2 ankle."""
    j = anatomy.joints
    stations = [-j[1, 1], -j[4, 1], -j[7, 1], -anatomy.floor]
    return np.interp(-points[:, 1], stations, [0, 1, 2, 2.5]).astype(np.float32)


def dress(
    points: Float[np.ndarray, "n 3"], smooth: list[Float[np.ndarray, "n"]], anatomy: Anatomy, look: Look
) -> Float[np.ndarray, "n 6"]:
    """Signed distance of every layer.

    Args:
        points: where, in the T-pose.
        smooth: the body's signed distance there, blurred a little, more, and most.
        anatomy: landmarks.
        look: what to wear.
    """
    tight, loose, round_ = smooth
    layers = [
        tight,
        _shirt(points, tight, loose, anatomy, look),
        _trousers(points, tight, loose, anatomy, look),
        *_shoes(points, tight, round_, anatomy),
        _hair(points, round_, anatomy, look),
    ]
    return np.stack(layers, -1).astype(np.float32)


def _cut(layer: Float[np.ndarray, "n"], end: Float[np.ndarray, "n"]) -> Float[np.ndarray, "n"]:
    """A layer cut off where `end` is positive, its rim rounded as cloth is."""
    return 0.5 * (layer + end + np.sqrt((layer - end) ** 2 + 0.006**2))


def _shirt(points: np.ndarray, tight: np.ndarray, loose: np.ndarray, anatomy: Anatomy, look: Look) -> np.ndarray:
    j, reach = anatomy.joints, arm_reach(points, anatomy)
    y = points[:, 1]
    hem = anatomy.crotch + 0.035
    on_sleeve = smoothstep(0.0, 0.3, reach)
    toward_hem = 1 - smoothstep(hem, j[9, 1], y)
    cuff = smoothstep(0.5 * look.sleeve, look.sleeve, reach) if look.sleeve < 1 else -0.3 * smoothstep(1.2, 1.8, reach)
    offset = 0.011 + on_sleeve * (0.003 + 0.007 * cuff) + (1 - on_sleeve) * 0.011 * toward_hem
    base = np.minimum(loose - offset, tight - 0.006)
    shoulder, elbow, wrist = abs(j[16, 0]), abs(j[18, 0]), abs(j[20, 0])
    end = np.interp(look.sleeve, [0, 1, 2], [shoulder, elbow, wrist])
    above = np.maximum(-collar(points, anatomy), y - j[12, 1] - 0.045)
    return _cut(base, np.maximum.reduce([np.abs(points[:, 0]) - end, hem - y, above]))


def _trousers(points: np.ndarray, tight: np.ndarray, loose: np.ndarray, anatomy: Anatomy, look: Look) -> np.ndarray:
    reach = leg_reach(points, anatomy)
    flare = smoothstep(0.3, 1.9, reach) if look.trouser > 1 else smoothstep(0.2, 0.9, reach)
    base = np.minimum(loose - 0.009 - 0.016 * flare, tight - 0.005)
    j = anatomy.joints
    end = np.interp(look.trouser, [0, 1, 2], [j[1, 1], j[4, 1], j[7, 1]])
    waist = points[:, 1] - (anatomy.joints[0, 1] + 0.06)
    return _cut(base, np.maximum(end - points[:, 1], waist))


def _shoes(
    points: np.ndarray, tight: np.ndarray, round_: np.ndarray, anatomy: Anatomy
) -> tuple[np.ndarray, np.ndarray]:
    """The upper, rounded over the toes, and the sole under its outline."""
    ankle, floor = anatomy.joints[7], anatomy.floor
    height = points[:, 1] - floor
    opening = height - 0.085 - 0.25 * (ankle[2] - points[:, 2]).clip(-0.06, 0.05)
    upper = _cut(np.minimum(round_ - 0.013, tight - 0.006), opening)
    # The samples below the ankle fill the footprint, so their distance in the plane is its outline.
    print_ = anatomy.rest[anatomy.rest[:, 1] < floor + 0.05]
    low = points[:, 1] < floor + 0.08
    outline = np.full(len(points), 1.0, np.float32)
    outline[low] = cKDTree(print_[:, [0, 2]]).query(points[low][:, [0, 2]], distance_upper_bound=0.2)[0].clip(max=1)
    thickness = 0.016 + 0.008 * smoothstep(0.0, -0.08, points[:, 2] - ankle[2])
    slab = np.abs(height - 0.5 * (0.014 - thickness)) - 0.5 * (0.014 + thickness)
    sole = np.maximum(outline - 0.012, slab)
    return np.maximum(upper, -height), sole


_HAIRLINES = {
    "short": ((0.0, 0.5, 0.85, 1.1, 1.3, 1.5, 1.75, 2.1, 3.2), (1.05, 0.95, 0.62, 0.0, 0.05, 0.45, 0.35, -0.5, -1.2)),
    "back": ((0.0, 0.5, 0.9, 1.25, 1.6, 2.1, 3.2), (1.08, 1.0, 0.78, 0.40, 0.40, -0.45, -1.15)),
    "curtain": ((0.0, 0.45, 0.75, 0.95, 1.5, 3.2), (1.05, 0.85, 0.2, -1.1, -1.6, -1.75)),
    "beanie": ((0.0, 0.9, 1.6, 3.2), (0.72, 0.55, 0.35, 0.0)),
}
"""Height of the hairline above the eyes, in eye distances, over the angle from the front."""


def _hair(points: np.ndarray, round_: np.ndarray, anatomy: Anatomy, look: Look) -> np.ndarray:
    unit = anatomy.spread
    eyes, head = anatomy.eyes.mean(0), anatomy.joints[15]
    near = points[:, 1] > eyes[1] - 4 * unit
    away = np.full(len(points), 1.0, np.float32)
    p = points[near] - np.array([0, eyes[1], 0.5 * (eyes[2] + head[2]) - 0.4 * unit], np.float32)
    angle = np.arctan2(np.abs(p[:, 0]), p[:, 2])
    style = {"beanie": "beanie", "bob": "curtain", "bun": "back", "ponytail": "back"}.get(look.hair, "short")
    line = (PchipInterpolator(*_HAIRLINES[style])(angle) * unit).astype(np.float32)
    above = p[:, 1] - line
    top = smoothstep(0.5 * unit, 2.0 * unit, p[:, 1])
    depth = {
        "crop": 0.010,
        "quiff": 0.012,
        "bob": 0.022,
        "bun": 0.010,
        "ponytail": 0.010,
        "curls": 0.026,
        "beanie": 0.014,
    }
    thickness = np.full(len(p), depth[look.hair])
    if look.hair == "quiff":
        thickness += 0.028 * top * smoothstep(-0.6 * unit, 1.0 * unit, p[:, 2])
    if look.hair == "curls":
        q = p * 170 + 1.5 * np.sin(p[:, [1, 2, 0]] * 75)
        thickness += 0.0045 * np.sin(q).sum(1) + 0.008 * top
    taper = 0.35 + 0.65 * smoothstep(0.0, 0.022, above) if style != "beanie" else np.ones(len(p))
    shell = np.maximum(round_[near] - 0.004 - thickness * taper, -0.8 * above)
    if look.hair == "bun":
        shell = np.minimum(shell, np.linalg.norm(p - np.array([0, 1.75, -1.35]) * unit, axis=1) - 0.66 * unit)
    if look.hair == "ponytail":
        shell = np.minimum(shell, _tail(p / unit) * unit)
    away[near] = shell
    return away


def _tail(p: np.ndarray) -> np.ndarray:
    """A ponytail from the back of the head, in eye distances."""
    bends = np.array([[0, 0.9, -1.55], [0, 0.7, -2.25], [0, -0.6, -2.55], [0, -1.9, -2.3]])
    radii = (0.3, 0.5, 0.45, 0.12)
    best = np.full(len(p), 9.0)
    for (a, b), (ra, rb) in zip(
        zip(bends[:-1], bends[1:], strict=True), zip(radii[:-1], radii[1:], strict=True), strict=True
    ):
        along = np.clip((p - a) @ (b - a) / ((b - a) @ (b - a)), 0, 1)
        best = np.minimum(best, np.linalg.norm(p - a - along[:, None] * (b - a), axis=1) - ra - along * (rb - ra))
    return best


def _mesh_union(nearest, low, evaluate):  # noqa
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
    part = sparse.csgraph.connected_components(graph, directed=False)[1]
    kept = part == np.bincount(part).argmax()
    return vertices[kept], (np.cumsum(kept) - 1)[faces[kept[faces[:, 0]]]]


def _refine_ends(vertices, faces, evaluate, anatomy):  # noqa
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


def _skinning_weights(vertices, faces, layers, anatomy, tree):  # noqa
    """Weights of the nearest body samples; cloth shares them with its neighbourhood, hair follows the head alone."""
    distance, index = tree.query(vertices, k=6)
    near = (1 / (distance + 0.004)).astype(np.float32)
    near /= near.sum(1, keepdims=True)
    weights = np.einsum("vk,vkj->vj", near, anatomy.weights[index])
    label_ = layers.argmin(1)
    cloth = np.nonzero(np.isin(label_, (SHIRT, TROUSERS)))[0]
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    graph = sparse.coo_matrix((np.ones(len(edges), np.float32), edges.T), shape=(len(vertices),) * 2).tocsr()
    average = (sparse.diags((1 / np.asarray(graph.sum(1)).ravel()).astype(np.float32)) @ graph).tocsr()[cloth]
    for _ in range(10):
        weights[cloth] = average @ weights
    hair = label_ == HAIR
    weights[hair] = 0
    weights[hair, 15] = 1
    fourth = np.partition(weights, -4, axis=1)[:, -4][:, None]
    weights = np.where((weights >= fourth) & (weights > 1e-4), weights, 0)
    return sparse.csr_matrix((weights / weights.sum(1, keepdims=True)).astype(np.float32))
