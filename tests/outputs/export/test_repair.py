"""Meshes closed and reduced."""

import numpy as np
import pytest
import torch
import trimesh
from hypothesis import given
from hypothesis import strategies as st

from twofold.outputs.export.repair import decimate, is_watertight, open_edges, repair, solid, weld


def ball(subdivisions: int = 3) -> tuple[np.ndarray, np.ndarray]:
    mesh = trimesh.creation.icosphere(subdivisions, 0.3)
    return np.asarray(mesh.vertices, np.float32), np.asarray(mesh.faces, np.int64)


def test_ball_is_watertight_and_a_ball_without_a_triangle_is_not() -> None:
    vertices, faces = ball()
    assert is_watertight(vertices, faces)
    assert not is_watertight(vertices, faces[1:])
    assert not is_watertight(vertices, np.concatenate([faces, faces[:1, ::-1]]))
    assert not is_watertight(vertices, faces[:0])


def test_corners_that_lie_together_count_as_one() -> None:
    vertices, faces = ball(1)
    soup, corners = vertices[faces].reshape(-1, 3), np.arange(3 * len(faces)).reshape(-1, 3)
    assert is_watertight(soup, corners)
    merged, triangles = weld(soup, corners)
    assert (len(merged), len(triangles)) == (len(vertices), len(faces))


@given(st.sets(st.integers(0, 319), max_size=60))
def test_any_holes_are_closed(removed: set[int]) -> None:
    vertices, faces = ball(2)
    kept = np.delete(faces, sorted(removed), axis=0)
    closed, triangles = repair(vertices, kept)
    assert is_watertight(closed, triangles)
    mesh = trimesh.Trimesh(closed, triangles)
    assert mesh.is_watertight
    assert mesh.volume > 0


def test_edges_of_three_triangles_are_taken_apart() -> None:
    vertices, faces = ball(1)
    a, b = faces[0, :2]
    fin = np.concatenate([vertices, [[0.5, 0.5, 0.5]]]).astype(np.float32)
    crowded = np.concatenate([faces, [[a, b, len(vertices)]]])
    assert len(open_edges(crowded)[1]) == 1
    assert is_watertight(*repair(fin, crowded))


def test_decimated_ball_is_closed_and_round() -> None:
    vertices, faces = ball(5)
    fewer, triangles = decimate(vertices, faces, 2000)
    assert 1900 <= len(triangles) <= 2001
    assert is_watertight(fewer, triangles)
    assert np.abs(np.linalg.norm(fewer, axis=1) - 0.3).max() < 0.003


def test_mesh_with_few_triangles_stays_as_it_is() -> None:
    vertices, faces = ball(1)
    same, triangles = decimate(vertices, faces, 1000)
    assert (len(same), len(triangles)) == (len(vertices), len(faces))


def test_cavities_are_filled_and_distant_pieces_removed() -> None:
    body, faces = (torch.from_numpy(a) for a in ball(3))

    def level(x: torch.Tensor) -> torch.Tensor:
        away = x.norm(dim=-1)
        return torch.maximum(away - 0.3, 0.1 - away)  # hollow

    x = torch.tensor([[0.0, 0.0, 0.0], [0.05, 0, 0], [0.28, 0, 0], [0.35, 0, 0]])
    filled = solid(level, body, faces, 0.06)(x)
    assert (level(x) > 0).tolist() == [True, True, False, True]
    assert (filled > 0).tolist() == [False, False, False, True]
    far = torch.tensor([[0.45, 0.0, 0.0]])
    assert solid(lambda p: -torch.ones(len(p)), body, faces, 0.06)(far) > 0


@pytest.mark.parametrize("count", [2, 5])
def test_loops_of_holes_that_share_a_vertex_are_closed(count: int) -> None:
    vertices, faces = ball(2)
    around = np.flatnonzero((faces == 5).any(1))[:count:2]
    assert is_watertight(*repair(vertices, np.delete(faces, around, axis=0)))
