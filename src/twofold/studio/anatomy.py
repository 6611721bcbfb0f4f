"""Landmarks of a body, and coordinates along its limbs, for dressing and painting it."""

import math
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from scipy import sparse
from scipy.sparse import csgraph

from twofold.body.skeleton import ShapedBody, pose_body
from twofold.geometry.cameras import Camera
from twofold.geometry.raster import rasterize
from twofold.geometry.rotations import axis_angle_to_matrix, rigid_transform
from twofold.geometry.surfaces import face_normals, vertex_normals


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
        neck=float(np.median(around_neck(points[neck], rest_joints))),
        crotch=float(crotch),
        floor=float(shaped.vertices[:, 1].min()),
        points=torch.cat([canonical[used], canonical[faces].mean(1)]).numpy(),
        normals=torch.cat([normals[used], face_normals(canonical, faces)]).numpy(),
        rest=torch.cat([shaped.vertices[used], shaped.vertices[faces].mean(1)]).numpy(),
        weights=torch.cat([shaped.weights[used], shaped.weights[faces].mean(1)]).numpy(),
    )


def _outer_parts(shaped: ShapedBody) -> tuple[torch.Tensor, Float[np.ndarray, "2 3"]]:
    """Faces of the body and its eyeballs (no inside of the mouth), and where the eyes are."""
    faces = shaped.faces.numpy()
    vertices = shaped.vertices.numpy()
    count = len(vertices)
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]]])
    graph = sparse.coo_matrix((np.ones(len(edges)), edges.T), shape=(count, count))
    part = csgraph.connected_components(graph, directed=False)[1]
    body = np.bincount(part[faces[:, 0]]).argmax()
    head, neck = shaped.joints[15].numpy(), shaped.joints[12].numpy()
    # A body without separate eyeballs: half a neck's length above the head joint, as far apart as people's are.
    eyes = [head + np.array([s * 0.031, 0.0, 0.085], np.float32) for s in (1, -1)]
    kept = part == body
    for piece in np.unique(part):
        points = vertices[part == piece]
        middle, size = points.mean(0), np.ptp(points, axis=0)
        if piece != body and size.max() < 0.045 and middle[1] > neck[1] and abs(middle[0]) > 0.015:
            kept |= part == piece
            eyes[0 if middle[0] > 0 else 1] = middle.astype(np.float32)
    return torch.from_numpy(faces[kept[faces[:, 0]]]), np.stack(eyes)


def around_neck(points: Float[np.ndarray, "n 3"], joints: Float[np.ndarray, "24 3"]) -> Float[np.ndarray, "n"]:
    """Distance from the line through neck and head, which lies a little before the spine; metres."""
    base, along = joints[12], joints[15] - joints[12]
    along = along / np.linalg.norm(along)
    off = points - base - ((points - base) @ along)[:, None] * along
    return np.hypot(off[:, 0], 0.88 * (off[:, 2] - 0.004))


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


def smoothstep(low: float | np.floating, high: float | np.floating, x: np.ndarray) -> np.ndarray:
    """0 below `low`, 1 above `high`, smooth between."""
    t = np.clip((x - low) / (high - low), 0, 1)
    return t * t * (3 - 2 * t)


def bearing(sideways: Float[np.ndarray, "*n"], ahead: Float[np.ndarray, "*n"]) -> Float[np.ndarray, "*n"]:
    """Angle from straight ahead, radians: NumPy's arctan2, rounded alike at every call.

    NumPy keeps to a slower loop, which rounds otherwise, where inputs and result may share memory. It finds that of a
    column of a table as soon as the result happens to lie right behind the table; a copy of the column has no such end.
    """
    return np.arctan2(np.ascontiguousarray(sideways), np.ascontiguousarray(ahead))


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
