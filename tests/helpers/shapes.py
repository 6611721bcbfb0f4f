"""Meshes that tests know everything about."""

import math

import torch


def sphere(radius=1.0, rings=24, sectors=36, center=(0.0, 0.0, 0.0), dtype=torch.float32):
    """A closed sphere, counter-clockwise from outside, with a vertex at each pole."""
    theta = torch.arange(1, rings, dtype=torch.float64) / rings * math.pi
    phi = torch.arange(sectors, dtype=torch.float64) / sectors * 2 * math.pi
    body = torch.stack(
        [
            theta.sin()[:, None] * phi.sin(),
            theta.cos()[:, None].expand(-1, sectors),
            theta.sin()[:, None] * phi.cos(),
        ],
        -1,
    ).reshape(-1, 3)
    poles = torch.tensor([[0.0, 1, 0], [0, -1, 0]], dtype=torch.float64)
    vertices = radius * torch.cat([body, poles]) + torch.tensor(center, dtype=torch.float64)
    top, bottom = len(body), len(body) + 1
    faces = []
    for s in range(sectors):
        t = (s + 1) % sectors
        faces.append([top, s, t])
        for r in range(rings - 2):
            a, b = r * sectors + s, r * sectors + t
            faces += [[a, a + sectors, b], [b, a + sectors, b + sectors]]
        last = (rings - 2) * sectors
        faces.append([bottom, last + t, last + s])
    return vertices.to(dtype), torch.tensor(faces)


def soup(seed, count=12, dtype=torch.float32):
    """Random triangles about the origin."""
    g = torch.Generator().manual_seed(seed)
    vertices = torch.randn(3 * count, 3, generator=g, dtype=torch.float64).to(dtype)
    return vertices, torch.arange(3 * count).view(-1, 3)


def edge_uses(faces):
    """How often each directed edge occurs, as a dict."""
    uses = {}
    for a, b, c in faces.tolist():
        for edge in ((a, b), (b, c), (c, a)):
            uses[edge] = uses.get(edge, 0) + 1
    return uses


def is_closed(faces):
    """Whether every directed edge occurs once and its reverse once, too."""
    uses = edge_uses(faces)
    return all(n == 1 for n in uses.values()) and all((b, a) in uses for a, b in uses)


def volume(vertices, faces):
    """Signed volume inside a closed mesh."""
    a, b, c = vertices[faces].double().unbind(1)
    return float((torch.linalg.cross(a, b) * c).sum() / 6)
