"""Bodies for tests: a sausage around every bone, bending smoothly at the joints; and a plain ball."""

import math

import numpy as np
import torch
from scipy.spatial import ConvexHull

from twofold.body.skeleton import PARENTS, Body, PosedBody, pose_body, shape_body
from twofold.geometry.rotations import axis_angle_to_matrix, matrix_to_axis_angle

# A T-pose off the origin, as SMPL's is: what turns about the wrong point shows.
JOINTS = [
    (0.03, -0.25, 0.02), (0.1, -0.34, 0), (-0.04, -0.34, 0), (0.03, -0.13, 0), (0.13, -0.72, 0), (-0.07, -0.72, 0),
    (0.03, 0, 0.03), (0.12, -1.12, -0.03), (-0.06, -1.12, -0.03), (0.03, 0.06, 0.03), (0.15, -1.18, 0.09),
    (-0.09, -1.18, 0.09), (0.03, 0.27, 0), (0.11, 0.17, 0), (-0.05, 0.17, 0), (0.03, 0.36, 0.04), (0.2, 0.2, 0),
    (-0.14, 0.2, 0), (0.46, 0.2, -0.01), (-0.4, 0.2, -0.01), (0.71, 0.2, 0), (-0.65, 0.2, 0), (0.79, 0.2, 0),
    (-0.73, 0.2, 0),
]  # fmt: skip


def little_body(spacing: float = 0.05, thickness: float = 0.06) -> Body:
    """Vertices about `spacing` metres apart."""
    joints = torch.tensor(JOINTS)
    vertices, weights, faces = [], [], []
    around = max(6, round(2 * math.pi * thickness / spacing))
    for child, parent in enumerate(PARENTS):
        if parent < 0:
            continue
        start, end = joints[parent], joints[child]
        along = torch.nn.functional.normalize(end - start, dim=0)
        across = torch.linalg.cross(along, torch.eye(3)[along.abs().argmin()])
        across = torch.nn.functional.normalize(across, dim=0)
        third = torch.linalg.cross(along, across)
        rings = 1 + max(1, round(float((end - start).norm()) / spacing))
        first = sum(map(len, vertices))
        parts = [(start - thickness * along)[None]]
        shares = [torch.zeros(1)]
        for t in torch.linspace(0, 1, rings):
            angle = torch.arange(around) * 2 * math.pi / around
            ring = angle.cos()[:, None] * across + angle.sin()[:, None] * third
            parts.append(start + t * (end - start) + thickness * ring)
            shares.append(t.expand(around))
        parts.append((end + thickness * along)[None])
        vertices.append(torch.cat(parts))
        share = torch.cat([*shares, torch.ones(1)])
        weight = torch.zeros(len(share), 24)
        weight[:, parent], weight[:, child] = 1 - 0.5 * share, 0.5 * share
        weights.append(weight)
        faces.append(first + _sausage(rings, around))
    template = torch.cat(vertices)
    return Body(
        name="sausages",
        template=template,
        faces=torch.cat(faces),
        weights=torch.cat(weights),
        joints=joints,
        shape_basis=0.1 * template[..., None],
        joint_basis=0.1 * joints[..., None],
        pose_basis=torch.zeros(len(template), 3, 0),
    )


def _sausage(rings: int, around: int) -> torch.Tensor:
    faces, last = [], 1 + rings * around
    for i in range(around):
        j = (i + 1) % around
        faces.append((0, 1 + j, 1 + i))
        faces.append((last, last - around + i, last - around + j))
        for ring in range(rings - 1):
            a, b = 1 + ring * around + i, 1 + ring * around + j
            faces += [(a, b, a + around), (b, b + around, a + around)]
    return torch.tensor(faces)


def posed_little_body(
    seed: int = 0, size: float = 0.3, dtype: torch.dtype = torch.float32, **options: float
) -> PosedBody:
    """That body in a random pose, at a random place."""
    generator = torch.Generator().manual_seed(seed)
    pose = size * torch.randn(24, 3, generator=generator)
    translation = torch.randn(3, generator=generator)
    shaped = shape_body(little_body(**options), torch.zeros(1))
    shaped = type(shaped)(**{k: t.to(dtype) if t.is_floating_point() else t for k, t in vars(shaped).items()})
    return pose_body(shaped, pose.to(dtype), translation.to(dtype))


def moved_pose(
    pose: torch.Tensor, translation: torch.Tensor, pelvis: torch.Tensor, turn: torch.Tensor, shift: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor]:
    """Pose and translation of the same body after the world was turned (axis-angle) and then shifted."""
    rotation = axis_angle_to_matrix(turn)
    pose = pose.clone()
    pose[0] = matrix_to_axis_angle(rotation @ axis_angle_to_matrix(pose[0]))
    return pose, rotation @ (pelvis + translation) + shift - pelvis


def ball(count: int = 150, radius: float = 0.3) -> tuple[np.ndarray, np.ndarray]:
    """Points spread evenly on a ball that is off the origin, and triangles with counter-clockwise corners outside."""
    height = 1 - 2 * (np.arange(count) + 0.5) / count
    turn = np.pi * (1 + 5**0.5) * np.arange(count)
    side = np.sqrt(1 - height**2)
    vertices = np.stack([side * np.cos(turn), side * np.sin(turn), height], 1)
    faces = ConvexHull(vertices).simplices.astype(np.int64)
    a, b, c = (vertices[faces[:, i]] for i in range(3))
    inward = (np.cross(b - a, c - a) * a).sum(1) < 0
    faces[inward] = faces[inward][:, ::-1]
    return (radius * vertices + [0.2, -0.1, 0.4]).astype(np.float32), faces
