"""Lattices on triangles."""

import numpy as np
import pytest
import torch
import trimesh

from twofold.outputs.export.lattice import build_lattice, segments_for


def ball() -> tuple[np.ndarray, np.ndarray]:
    mesh = trimesh.creation.icosphere(1, 0.3)
    return np.asarray(mesh.vertices, np.float32), np.asarray(mesh.faces, np.int64)


@pytest.mark.parametrize("segments", [1, 2, 3, 5])
def test_nodes_of_a_triangle_lie_where_their_row_says(segments: int) -> None:
    vertices, faces = ball()
    lattice = build_lattice(len(vertices), faces, segments)
    nodes = lattice.interpolate(torch.from_numpy(vertices)).numpy()
    places = [(i, j) for i in range(segments + 1) for j in range(segments + 1 - i)]
    for face in range(0, len(faces), 7):
        a, b, c = vertices[faces[face]]
        for node, (i, j) in zip(lattice.table[face], places, strict=True):
            expected = a + (b - a) * i / segments + (c - a) * j / segments
            assert np.abs(nodes[node] - expected).max() < 1e-6


@pytest.mark.parametrize("segments", [1, 2, 4])
def test_nodes_on_edges_are_shared(segments: int) -> None:
    vertices, faces = ball()
    lattice = build_lattice(len(vertices), faces, segments)
    # Euler: a closed mesh of F triangles has 3F/2 edges.
    edges, inner = 3 * len(faces) // 2, (segments - 1) * (segments - 2) // 2
    assert len(lattice) == len(vertices) + edges * (segments - 1) + len(faces) * inner
    nodes = lattice.interpolate(torch.from_numpy(vertices)).numpy()
    assert len(np.unique(np.round(nodes, 6), axis=0)) == len(lattice)
    assert np.array_equal(nodes[: len(vertices)], vertices)


def test_more_room_makes_a_finer_lattice() -> None:
    found = [segments_for(20_000, 40_000, budget) for budget in (0, 80_000, 180_000, 10**9)]
    assert found == [1, 2, 3, 6]
    assert len(build_lattice(42, ball()[1], 3)) <= 42 + 80 * 8 / 2
