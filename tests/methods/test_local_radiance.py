"""DANBO's field against a point-by-point loop over joints."""

import math

import pytest
import torch

from twofold.field.bone_boxes import RIGID_PARTS
from twofold.methods.local_radiance import LocalRadiance, inside_rigid


def looked_up(table, coordinates):
    """Features [5] of one axis after the other, between 16 bins at -1 to 1, times the window."""
    window = math.exp(-2 * sum(float(c) ** 6 for c in coordinates))
    columns = []
    for axis in range(3):
        place = (min(max(float(coordinates[axis]), -1), 1) + 1) / 2 * 15
        low = min(int(place), 14)
        columns.append(table[:, low, axis] * (1 - place + low) + table[:, low + 1, axis] * (place - low))
    return torch.cat(columns) * window


@torch.no_grad()
def test_density_colour_and_assignment_are_those_of_a_loop():
    generator = torch.Generator().manual_seed(0)
    local = LocalRadiance(generator)
    local.radiance.density.layers[-1].bias += 1
    tables = local.volumes.tables(torch.randn(24, 66, generator=generator))
    coordinates = 3 * torch.rand(6, 24, 3, generator=generator) - 1.5
    coordinates[:, 4] *= 0.3
    views = torch.nn.functional.normalize(torch.randn(6, 3, generator=generator), dim=-1)
    code = torch.randn(128, generator=generator)
    found = local(tables, coordinates, views, code)
    for point in range(6):
        h = torch.stack([looked_up(tables[joint], coordinates[point, joint]) for joint in range(24)])
        logits = h
        for number, layer in enumerate(local.volumes.blending):
            logits = layer(logits.relu() if number else logits)
        blended, assigned = torch.zeros(15), 0.0
        for joint in RIGID_PARTS:
            if all(abs(float(c)) <= 1 for c in coordinates[point, joint]):
                p = 1.002 / (1 + math.exp(-float(logits[joint, 0]))) - 0.001
                blended, assigned = blended + p * h[joint], assigned + p
        encoded = torch.cat([blended, *[f(2**k * blended) for k in range(6) for f in (torch.sin, torch.cos)]])[None]
        view = torch.cat([views[point], *[f(2**k * views[point]) for k in range(4) for f in (torch.sin, torch.cos)]])
        expected = local.radiance(encoded, view[None], code)
        torch.testing.assert_close(found.density[point], expected.density[0], rtol=1e-4, atol=1e-5)
        torch.testing.assert_close(found.color[point], expected.color[0], rtol=1e-4, atol=1e-5)
        assert float(found.extra[point]) == pytest.approx(assigned, abs=1e-5)
    torch.testing.assert_close(local.density(tables, coordinates), found.density)


def test_toes_neck_and_hands_hold_nothing():
    coordinates = torch.full((24, 24, 3), 2.0)
    coordinates[torch.arange(24), torch.arange(24)] = 0
    assert inside_rigid(coordinates).nonzero()[:, 0].tolist() == list(RIGID_PARTS)
