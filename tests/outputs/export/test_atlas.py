"""Atlases and the textures painted into them."""

import numpy as np
import pytest
import torch
import trimesh

from twofold.outputs.export.atlas import dilated, paint_texture, tangents, unwrap
from twofold.outputs.export.lattice import build_lattice

SIZE = 256


@pytest.fixture(scope="module")
def ball() -> tuple[np.ndarray, np.ndarray]:
    mesh = trimesh.creation.icosphere(2, 0.3)
    return np.asarray(mesh.vertices, np.float32), np.asarray(mesh.faces, np.int64)


@pytest.fixture(scope="module")
def atlas(ball):
    return unwrap(*ball, SIZE)


def test_atlas_keeps_triangles_and_charts_do_not_overlap(ball, atlas) -> None:
    vertices, faces = ball
    assert np.array_equal(atlas.vertex[atlas.faces], faces)
    assert atlas.uv.min() >= 0
    assert atlas.uv.max() <= 1
    a, b, c = (atlas.uv[atlas.faces[:, i]].astype(float) * SIZE for i in range(3))
    areas = np.abs((b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0]) / 2
    lattice = build_lattice(len(vertices), faces, 1)
    _, known = paint_texture(atlas, lattice, vertices, SIZE)
    assert known.sum() == pytest.approx(areas.sum(), rel=0.05)


@pytest.mark.parametrize("segments", [1, 2, 5])
def test_texels_show_positions_on_their_own_triangle(ball, atlas, segments: int) -> None:
    vertices, faces = ball
    lattice = build_lattice(len(vertices), faces, segments)
    nodes = lattice.interpolate(torch.from_numpy(vertices)).numpy()
    image, known = paint_texture(atlas, lattice, nodes, SIZE)
    checked = 0
    for face in range(0, len(faces), 11):
        uv = atlas.uv[atlas.faces[face]].astype(float) * SIZE
        row, column = (np.floor(uv.mean(0)[::-1])).astype(int)
        barycentric = np.linalg.solve(np.vstack([uv.T, np.ones(3)]), [column + 0.5, row + 0.5, 1])
        if (barycentric > 0).all():
            assert np.abs(image[row, column] - barycentric @ vertices[faces[face]]).max() < 1e-4
            checked += 1
    assert checked > 10
    assert known.any()


def test_lattice_within_a_triangle_is_interpolated_piece_by_piece() -> None:
    vertices, faces = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]], np.float32), np.array([[0, 1, 2]])
    lattice = build_lattice(3, faces, 4)
    nodes = lattice.interpolate(torch.from_numpy(vertices)).numpy()
    bumps = np.sin(7 * nodes[:, :1]) + np.cos(5 * nodes[:, 1:2])
    from twofold.outputs.export.atlas import Atlas

    atlas = Atlas(np.arange(3), faces, vertices[:, :2] * 0.98 + 0.01)
    image, known = paint_texture(atlas, lattice, bumps.astype(np.float32), 200)
    rows, columns = np.nonzero(known)
    x, y = ((columns + 0.5) / 200 - 0.01) / 0.98, ((rows + 0.5) / 200 - 0.01) / 0.98
    from matplotlib.tri import LinearTriInterpolator, Triangulation

    small = [
        np.array(t)
        for i in range(4)
        for j in range(4 - i)
        for t in ([(i, j), (i + 1, j), (i, j + 1)], [(i + 1, j + 1), (i, j + 1), (i + 1, j)])
        if t[0][0] + t[0][1] <= 4
    ]
    index = {tuple(np.round(node[:2] * 4).astype(int)): n for n, node in enumerate(nodes)}
    triangles = np.array([[index[tuple(corner)] for corner in t] for t in small])
    expected = LinearTriInterpolator(Triangulation(nodes[:, 0], nodes[:, 1], triangles), bumps[:, 0])(x, y)
    inside = ~expected.mask
    assert inside.mean() > 0.95
    assert np.abs(image[rows, columns, 0] - expected.filled(0))[inside].max() < 1e-4


def test_dilation_fills_with_the_nearest_texel() -> None:
    image, known = np.zeros((4, 5, 1), np.float32), np.zeros((4, 5), bool)
    image[1, 1], image[2, 4] = 3, 7
    known[1, 1] = known[2, 4] = True
    filled = dilated(image, known)
    assert filled[0, 0, 0] == 3
    assert filled[3, 4, 0] == 7
    assert (filled > 0).all()


def test_tangents_run_along_the_texture(ball, atlas) -> None:
    vertices, _ = ball
    normals = vertices / np.linalg.norm(vertices, axis=1, keepdims=True)
    found = tangents(atlas, vertices, normals)
    assert np.abs((found[:, :3] * normals[atlas.vertex]).sum(1)).max() < 1e-5
    assert np.abs(np.linalg.norm(found[:, :3], axis=1) - 1).max() < 1e-5
    aligned = []
    for corners in atlas.faces:
        p, uv = vertices[atlas.vertex[corners]].astype(float), atlas.uv[corners].astype(float)
        du, dv = np.linalg.solve((uv[1:] - uv[0]), (p[1:] - p[0]))
        tangent, sign = found[corners[0], :3], found[corners[0], 3]
        up = sign * np.cross(normals[atlas.vertex[corners[0]]], tangent)
        aligned.append([du @ tangent / np.linalg.norm(du), -dv @ up / np.linalg.norm(dv)])
    assert np.min(aligned) > 0.7
