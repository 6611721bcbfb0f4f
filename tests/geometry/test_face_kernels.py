"""The compiled rasterizer sees what the reference sees."""

import numpy as np
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from shapes import soup

from twofold.geometry.cameras import Camera, project
from twofold.geometry.face_kernels import nearest_faces
from twofold.geometry.raster import rasterize


def front_camera(size):
    """Stands on +z, looks back; its image's middle is the origin."""
    world_to_camera = torch.diag(torch.tensor([1.0, -1.0, -1.0, 1.0]))
    world_to_camera[2, 3] = 6.0
    middle = (size - 1) / 2
    intrinsics = torch.tensor([[1.2 * size, 0, middle], [0, 1.2 * size, middle], [0, 0, 1]])
    return Camera(world_to_camera, intrinsics, size, size)


@settings(max_examples=25, deadline=None)
@given(seed=st.integers(0, 10_000), cut=st.integers(0, 40))
def test_every_pixel_sees_the_triangle_of_the_reference(seed, cut):
    """Painted in two pieces of rows, as threads do; where two are equally near either may win."""
    camera = front_camera(40)
    vertices, faces = soup(seed, 6)
    hits = rasterize(camera, vertices, faces, cull=True)
    expected = np.full(40 * 40, -1)
    expected[hits.pixel] = hits.face
    pixels, depth = project(camera, vertices)
    points = torch.cat([pixels, depth[:, None]], 1).float().numpy()
    inverse, face = np.zeros((40, 40), np.float32), np.full((40, 40), -1, np.int32)
    for first, end in ((0, cut), (cut, 40)):
        nearest_faces(points, faces.numpy().astype(np.int32), inverse, face, first, end)
    assert (face.ravel() != expected).mean() <= 0.005
    assert ((face.ravel() >= 0) != (expected >= 0)).mean() <= 0.003
