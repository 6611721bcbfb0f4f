"""How much of a character's surface the training cameras saw."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float, Int

from twofold.geometry.cameras import Camera
from twofold.kernels.parallel import in_parts
from twofold.outputs.raster_kernels import nearest_faces, project

_BEHIND = 0.01
"""A vertex this far behind the nearest surface, metres, is hidden."""


def observed_share(
    faces: Int[np.ndarray, "F 3"], views: Sequence[tuple[Camera, Float[np.ndarray, "V 3"]]]
) -> Float[np.ndarray, "V"]:
    """Share of the views that see each vertex: inside the image, turned to the camera, nothing in front of it.

    Args:
        faces: triangles, counter-clockwise from outside.
        views: cameras, each with the posed vertices.
    """
    seen = np.zeros(len(views[0][1]) if views else 0, dtype=np.float32)
    triangles = faces.astype(np.int32)
    for camera, vertices in views:
        seen += _seen(camera, np.ascontiguousarray(vertices, dtype=np.float32), triangles)
    return seen / max(len(views), 1)


def _seen(camera: Camera, vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    transform, points = camera.world_to_camera.double().numpy(), np.zeros((len(vertices), 3), dtype=np.float32)
    project(vertices, transform[:3, :3], transform[:3, 3], camera.intrinsics.double().numpy(), points)
    inverse = np.zeros((camera.height, camera.width), dtype=np.float32)
    face = np.full(inverse.shape, -1, dtype=np.int32)
    in_parts(camera.height, lambda first, end: nearest_faces(points, faces, inverse, face, first, end), least=32)
    a, b, c = (points[faces[:, corner], :2] for corner in range(3))
    towards = np.zeros(len(vertices), dtype=bool)
    facing = (b[:, 0] - a[:, 0]) * (c[:, 1] - a[:, 1]) - (b[:, 1] - a[:, 1]) * (c[:, 0] - a[:, 0]) < 0
    towards[faces[facing].ravel()] = True
    column, row = np.round(points[:, 0]).astype(int), np.round(points[:, 1]).astype(int)
    inside = (points[:, 2] > 0) & (column >= 0) & (row >= 0) & (column < camera.width) & (row < camera.height)
    front = inverse[row.clip(0, camera.height - 1), column.clip(0, camera.width - 1)]
    return inside & towards & (points[:, 2] <= 1 / np.maximum(front, 1e-6) + _BEHIND)
