import math

import pytest
import torch
from torch.nn import functional as F

from twofold.field.encoding import fourier_encoding
from twofold.field.implicit_geometry import ImplicitFieldConfig

SMALL = ImplicitFieldConfig(octaves=2, width=24, sdf_depth=4, color_depth=2, skip_layer=2, pose_code=3)


def moved(field, generator):
    field = field.double()
    with torch.no_grad():
        for parameter in field.parameters():
            parameter.add_(0.05 * torch.randn(parameter.shape, generator=generator, dtype=torch.float64))
    return field


def normed(layer):
    return layer.gain * layer.direction / layer.direction.norm(dim=1, keepdim=True)


def literal_sdf(field, x, pose):
    """Distance and feature, layer by layer as listed, the pose beside the encoded point."""
    network, config = field.networks.sdf, field.config
    encoded = fourier_encoding(x, config.octaves, include_pi=False)
    h = torch.cat([encoded, pose.expand(len(x), -1)], 1)
    for i, layer in enumerate(network.layers):
        if i == config.skip_layer:
            h = torch.cat([h, encoded], 1) / math.sqrt(2)
        h = h @ normed(layer).T + layer.bias
        if i < config.sdf_depth:
            h = torch.log1p(torch.exp(100 * h.clamp_max(5))) / 100 + (h - h.clamp_max(5))
    return h


@pytest.fixture(params=["analytic", "autograd"])
def field(request, generator):
    config = ImplicitFieldConfig(**{**vars(SMALL), "gradients": request.param})
    return moved(config.build(5, generator), generator)


def random(generator, *shape):
    return 0.5 * torch.randn(*shape, generator=generator, dtype=torch.float64)


def test_field_is_the_printed_chain(field, generator):
    x, pose, m = random(generator, 6, 3), random(generator, 5), random(generator, 6, 3, 3)
    x = x.requires_grad_()
    answer = literal_sdf(field, x, pose)
    (gradient,) = torch.autograd.grad(answer[:, 0].sum(), x, create_graph=True)
    normal = F.normalize((m @ gradient[..., None])[..., 0], dim=1)
    code = field.networks.pose_code(pose).expand(6, -1)
    h = torch.cat([x, normal, answer[:, 1:], code], 1)
    for i, layer in enumerate(field.networks.color.layers):
        h = h @ normed(layer).T + layer.bias
        h = h.clamp_min(0) if i < 2 else 1 / (1 + torch.exp(-h))
    output = field(x, pose, m)
    torch.testing.assert_close(output.sdf, answer[:, 0])
    torch.testing.assert_close(output.gradient, gradient)
    torch.testing.assert_close(output.color, h)
    torch.testing.assert_close(field.sdf(x, pose), output.sdf)
    distance, slope = field.distance_and_gradient(x, pose)
    torch.testing.assert_close(distance, output.sdf)
    torch.testing.assert_close(slope, output.gradient)


def test_eikonal_term_trains_alike_by_hand_and_by_double_differentiation(generator):
    by_hand = moved(SMALL.build(5, torch.Generator().manual_seed(4)), torch.Generator().manual_seed(5))
    config = ImplicitFieldConfig(**{**vars(SMALL), "gradients": "autograd"})
    twice = moved(config.build(5, torch.Generator().manual_seed(4)), torch.Generator().manual_seed(5))
    x, pose = random(generator, 6, 3), random(generator, 5)
    for field in (by_hand, twice):
        _, gradient = field.distance_and_gradient(x, pose)
        (gradient.norm(dim=1) - 1).square().sum().backward()
    for a, b in zip(by_hand.networks.sdf.parameters(), twice.networks.sdf.parameters(), strict=True):
        if b.grad is not None:
            torch.testing.assert_close(a.grad, b.grad)


def test_nothing_is_kept_for_gradients_when_none_are_wanted(field, generator):
    with torch.no_grad():
        output = field.eval()(random(generator, 4, 3), random(generator, 5))
    assert not output.color.requires_grad
    assert not output.gradient.requires_grad


def test_parameter_counts_are_the_authors():
    networks = ImplicitFieldConfig().build().networks
    assert sum(p.numel() for p in networks.sdf.parameters()) == 546_740
    others = [*networks.color.parameters(), *networks.pose_code.parameters()]
    assert sum(p.numel() for p in others) == 269_110


def test_distance_starts_near_that_of_a_sphere(generator):
    field = ImplicitFieldConfig().build(69, generator)
    x = torch.randn(500, 3, generator=generator)
    x = x / x.norm(dim=1, keepdim=True) * torch.linspace(0.1, 1.5, 500)[:, None]
    sdf = field.sdf(x, torch.randn(69, generator=generator))
    assert (sdf - (x.norm(dim=1) - 0.6)).abs().mean() < 0.1


@pytest.mark.parametrize("setting", [{"skip_layer": 8}, {"octaves": 10, "width": 32}, {"radius": 0.0}])
def test_impossible_sizes_are_refused(setting):
    with pytest.raises(ValueError, match=next(iter(setting))):
        ImplicitFieldConfig(**setting)
