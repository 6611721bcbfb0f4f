import itertools
import math

import pytest
import torch
from little_body import ball

from twofold.geometry.signed_distance import signed_distance


def tetrahedron():
    """A flat, sharp one: one triangle's plane tells the wrong side beyond its edges."""
    vertices = torch.tensor([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0.1, 0.1, 0.05]], dtype=torch.float64)
    faces = torch.tensor([[0, 2, 1], [0, 1, 3], [1, 2, 3], [2, 0, 3]])
    return vertices, faces


def winding_numbers(points, vertices, faces):
    """Solid angle of the mesh over 4 pi at each point: one inside, zero outside."""
    a, b, c = (vertices[faces[:, k]] - points[:, None] for k in range(3))
    la, lb, lc = a.norm(dim=-1), b.norm(dim=-1), c.norm(dim=-1)
    determinant = (a * torch.linalg.cross(b, c)).sum(-1)
    below = la * lb * lc + (a * b).sum(-1) * lc + (b * c).sum(-1) * la + (c * a).sum(-1) * lb
    return 2 * torch.atan2(determinant, below).sum(-1) / (4 * math.pi)


@pytest.mark.parametrize("shape", ["tetrahedron", "ball"])
def test_sign_is_that_of_the_winding_number(shape, generator):
    if shape == "ball":
        vertices, faces = (torch.from_numpy(a) for a in ball())
        vertices = vertices.double()
    else:
        vertices, faces = tetrahedron()
    low, high = vertices.amin(0) - 0.2, vertices.amax(0) + 0.2
    points = low + (high - low) * torch.rand(300, 3, generator=generator, dtype=torch.float64)
    points = torch.cat([points, vertices.mean(0)[None]])
    found = signed_distance(points, vertices, faces)
    inside = winding_numbers(points, vertices, faces) > 0.5
    assert torch.equal(found < 0, inside)
    assert 0 < inside.sum() < 301


def test_distance_to_a_ball_is_nearly_that_of_a_sphere(generator):
    vertices, faces = (torch.from_numpy(a) for a in ball(2000))
    points = torch.tensor([0.2, -0.1, 0.4]) + 0.4 * torch.randn(200, 3, generator=generator)
    expected = (points - torch.tensor([0.2, -0.1, 0.4])).norm(dim=1) - 0.3
    torch.testing.assert_close(signed_distance(points, vertices, faces), expected, atol=2e-3, rtol=0)


def test_points_beyond_edges_and_corners_are_outside():
    cube = torch.tensor(list(itertools.product((0.0, 1.0), repeat=3)))
    quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    faces = torch.tensor([t for a, b, c, d in quads for t in ((a, b, c), (a, c, d))])
    points = torch.tensor([[1.5, 1.5, 1.5], [1.5, 1.5, 0.5], [-0.5, 0.5, 0.5], [0.5, 0.5, 0.9]])
    expected = torch.tensor([math.sqrt(0.75), math.sqrt(0.5), 0.5, -0.1])
    torch.testing.assert_close(signed_distance(points, cube, faces), expected)
