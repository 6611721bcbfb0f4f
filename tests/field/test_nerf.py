import math

import torch
from little_body import JOINTS

from twofold.body.skeleton import PARENTS
from twofold.field.encoding import fourier_encoding
from twofold.field.nerf import CanonicalNerf, ImageConditionedNerf, NonRigidMotion, offset_to_nearest_bone


def count(module):
    return sum(p.numel() for p in module.parameters())


def moved(module, generator):
    """The module in double precision with random biases too, so that no part is zero."""
    module = module.double()
    with torch.no_grad():
        for parameter in module.parameters():
            parameter.add_(0.05 * torch.randn(parameter.shape, generator=generator, dtype=torch.float64))
    return module


def dense(h, layers):
    """Layers with ReLU after each of them."""
    for layer in layers:
        h = (h @ layer.weight.T + layer.bias).clamp_min(0)
    return h


def last(h, layer):
    return h @ layer.weight.T + layer.bias


def random(generator, *shape):
    return torch.randn(*shape, generator=generator, dtype=torch.float64)


def test_parameter_counts_are_the_authors():
    assert count(NonRigidMotion()) == 101_123
    assert count(CanonicalNerf()) == 494_084
    field = ImageConditionedNerf()
    assert (count(field.geometry), count(field.color)) == (534_564, 234_243)


def test_canonical_network_is_the_printed_chain(generator):
    field, x = moved(CanonicalNerf(generator), generator), random(generator, 4, 3)
    layers, encoded = field.network.layers, fourier_encoding(x, 10, include_pi=False)
    h = dense(encoded, layers[:5])
    h = dense(torch.cat([encoded, h], 1), layers[5:8])
    out = last(h, layers[8])
    result = field(x)
    torch.testing.assert_close(result.color, 1 / (1 + torch.exp(-out[:, :3])))
    torch.testing.assert_close(result.density, out[:, 3].clamp_min(0))


def windowed(x, open_bands):
    columns = []
    for k in range(6):
        part = min(max(open_bands - k, 0), 1)
        window = (1 - math.cos(math.pi * part)) / 2
        columns += [window * torch.sin(2**k * x), window * torch.cos(2**k * x)]
    return torch.cat(columns, 1)


def test_non_rigid_motion_is_the_printed_chain(generator):
    net = moved(NonRigidMotion(generator=generator), generator)
    x, pose = random(generator, 4, 3), random(generator, 69)
    layers, encoded = net.network.layers, windowed(x, 3.4)
    h = dense(torch.cat([pose.expand(4, -1), encoded], 1), layers[:4])
    h = dense(torch.cat([h, encoded], 1), layers[4:6])
    torch.testing.assert_close(net(x, pose, 3.4), x + last(h, layers[6]))


def test_non_rigid_motion_starts_near_zero_and_is_constant_with_closed_bands(generator):
    net, x = NonRigidMotion(generator=generator), torch.randn(5, 3, generator=generator)
    assert (net(x, torch.randn(69, generator=generator), 6.0) - x).abs().max() < 1e-3
    net.network.layers[-1].bias.data.copy_(torch.tensor([0.1, 0.2, 0.3]))
    offset = net(x, torch.zeros(69), 0.0) - x
    torch.testing.assert_close(offset, offset[:1].expand(5, -1))


def test_image_conditioned_network_is_the_printed_chain(generator):
    field = moved(ImageConditionedNerf(generator), generator)
    x, offset, features = random(generator, 4, 3), random(generator, 4, 3), random(generator, 4, 35)
    encoded = torch.cat([fourier_encoding(p, 10, include_pi=False) for p in (x, offset)], 1)
    layers = field.geometry.layers
    h = dense(encoded, layers[:5])
    z = last(dense(torch.cat([encoded, h], 1), layers[5:8]), layers[8])
    layers, inputs = field.color.layers, torch.cat([z[:, :35], features], 1)
    h = dense(inputs, layers[:3])
    color = last(dense(torch.cat([inputs, h], 1), layers[3:4]), layers[4])
    result = field(x, offset, features)
    torch.testing.assert_close(result.density, z[:, 35].clamp_min(0))
    torch.testing.assert_close(result.color, 1 / (1 + torch.exp(-color)))


def test_nearest_bone_is_the_nearest_of_all_segments(generator):
    joints = torch.tensor(JOINTS)
    for x in torch.randn(20, 3, generator=generator) * 0.5:
        best = (math.inf, 0)
        for child in range(1, 24):
            a, b = joints[PARENTS[child]], joints[child]
            t = min(max(float((x - a) @ (b - a) / ((b - a) @ (b - a))), 0), 1)
            best = min(best, (float((x - a - t * (b - a)).norm()), PARENTS[child]))
        x = x.requires_grad_()
        offset = offset_to_nearest_bone(x[None], joints)
        torch.testing.assert_close(offset[0], (x - joints[best[1]]).detach())
        assert not offset.requires_grad
