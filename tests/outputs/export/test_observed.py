"""What the training cameras saw of a surface."""

import numpy as np
import torch
import trimesh

from twofold.geometry.cameras import Camera
from twofold.outputs.export.observed import observed_share
from twofold.outputs.views import look_at


def camera(eye: list[float], size: int = 200) -> Camera:
    intrinsics = torch.tensor([[1.5 * size, 0, size / 2], [0, 1.5 * size, size / 2], [0, 0, 1.0]])
    pose = look_at(torch.tensor(eye), torch.zeros(3), torch.tensor([0.0, 1.0, 0.0]))
    return Camera(pose, intrinsics, size, size)


def test_cameras_see_the_side_that_faces_them() -> None:
    mesh = trimesh.creation.icosphere(3, 0.3)
    vertices, faces = np.asarray(mesh.vertices, np.float32), np.asarray(mesh.faces, np.int64)
    one = observed_share(faces, [(camera([0.0, 0.0, 2.0]), vertices)])
    assert (one[vertices[:, 2] > 0.1] == 1).all()
    assert (one[vertices[:, 2] < 0] == 0).all()
    two = observed_share(faces, [(camera([0.0, 0.0, z]), vertices) for z in (2.0, -2.0)])
    assert (two[np.abs(vertices[:, 2]) > 0.1] == 0.5).all()


def test_back_of_a_thin_sheet_is_not_seen() -> None:
    sheet = trimesh.creation.box([0.4, 0.4, 0.004]).subdivide().subdivide()
    vertices, faces = np.asarray(sheet.vertices, np.float32), np.asarray(sheet.faces, np.int64)
    seen = observed_share(faces, [(camera([0.0, 0.0, 2.0]), vertices)])
    within = np.abs(vertices[:, :2]).max(1) < 0.19
    assert (seen[within & (vertices[:, 2] > 0)] == 1).all()
    assert (seen[within & (vertices[:, 2] < 0)] == 0).all()


def test_what_stands_behind_something_is_not_seen() -> None:
    front, back = trimesh.creation.icosphere(2, 0.3), trimesh.creation.icosphere(2, 0.1)
    back.apply_translation([0, 0, -0.6])
    both = trimesh.util.concatenate([front, back])
    seen = observed_share(
        np.asarray(both.faces, np.int64), [(camera([0.0, 0.0, 2.0]), np.asarray(both.vertices, np.float32))]
    )
    assert seen[: len(front.vertices)].max() == 1
    assert seen[len(front.vertices) :].max() == 0


def test_no_view_sees_nothing() -> None:
    assert observed_share(np.array([[0, 1, 2]]), []).shape == (0,)
