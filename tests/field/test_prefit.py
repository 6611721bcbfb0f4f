import pytest
import torch
from little_body import ball

from twofold.field.implicit_geometry import ImplicitFieldConfig
from twofold.field.prefit import PrefitConfig, distance_pool, fit_distance

SMALL = ImplicitFieldConfig(octaves=2, width=32, sdf_depth=3, color_depth=1, skip_layer=2, pose_code=2)


def mesh():
    vertices, faces = ball(150)
    return torch.from_numpy(vertices), torch.from_numpy(faces)


def test_distance_becomes_that_of_the_mesh(generator):
    vertices, faces = mesh()
    field, pose = SMALL.build(4, generator), torch.zeros(4)
    config = PrefitConfig(steps=80, points=128, pool=1000, learning_rate=5e-3)
    before = [p.clone() for p in field.networks.color.parameters()]
    points, distances = distance_pool(vertices, faces, config, generator)
    first = (field.sdf(points, pose) - distances).abs().mean().item()
    error = fit_distance(field, list(field.networks.sdf.parameters()), pose, vertices, faces, config, generator)
    assert error < 0.02 < 0.1 < first
    fresh, exact = distance_pool(vertices, faces, config, torch.Generator().manual_seed(9))
    assert (field.sdf(fresh, pose) - exact).abs().mean() < 0.03
    assert all(torch.equal(a, b) for a, b in zip(before, field.networks.color.parameters(), strict=True))


def test_half_of_the_points_lie_near_the_surface(generator):
    config = PrefitConfig(pool=4000, near=(0.001, 0.002))
    points, distances = distance_pool(*mesh(), config, generator)
    assert points.shape == (4000, 3)
    assert distances[:2000].abs().max() < 0.01
    assert distances[2000:].abs().mean() > 0.05
    assert (distances[2000:] < 0).any()


def test_impossible_settings_are_refused():
    with pytest.raises(ValueError, match="steps"):
        PrefitConfig(steps=0)
