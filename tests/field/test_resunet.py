import math

import pytest
import torch
from torch.nn import functional as F

from twofold.field.resunet import ResUNet, ViewBlending, sample_maps


def count(module):
    return sum(p.numel() for p in module.parameters())


def test_parameter_counts_are_the_authors():
    assert count(ResUNet()) == 8_877_056
    assert count(ViewBlending()) == 1_369
    assert count(ViewBlending(with_unused_heads=True)) == 1_369 + 4_804


def convolve(x, weight, bias, stride):
    """A convolution as a sum over its taps, on an image padded by reflection."""
    k = weight.shape[-1]
    if k > 1:
        x = F.pad(x, (k // 2,) * 4, mode="reflect")
    rows, columns = ((n - k) // stride + 1 for n in x.shape[-2:])
    out = torch.zeros(len(x), len(weight), rows, columns, dtype=x.dtype)
    if bias is not None:
        out = out + bias[:, None, None]
    for i in range(k):
        for j in range(k):
            part = x[:, :, i : i + stride * (rows - 1) + 1 : stride, j : j + stride * (columns - 1) + 1 : stride]
            out = out + torch.einsum("oc,ncij->noij", weight[:, :, i, j], part)
    return out


def normed(x, norm):
    mean, variance = x.mean((2, 3), keepdim=True), x.var((2, 3), keepdim=True, correction=0)
    return (x - mean) / (variance + 1e-5).sqrt() * norm.weight[:, None, None] + norm.bias[:, None, None]


def layer(x, convolution, norm):
    return normed(convolve(x, convolution.weight, convolution.bias, convolution.stride[0]), norm)


def doubled(x):
    """Twice the size, linear between pixels, corners on corners."""
    for axis in (2, 3):
        n = x.shape[axis]
        place = torch.arange(2 * n, dtype=x.dtype) * (n - 1) / (2 * n - 1)
        low = place.floor().long().clamp_max(n - 2)
        f = (place - low).reshape([-1 if a == axis else 1 for a in range(4)])
        x = x.index_select(axis, low) * (1 - f) + x.index_select(axis, low + 1) * f
    return x


def elu(x):
    return torch.where(x > 0, x, torch.exp(x) - 1)


def literal_features(net, image):
    h = layer(image, *net.first[:2]).clamp_min(0)
    maps = []
    for stage in net.stages:
        for index, block in enumerate(stage):
            inner = layer(layer(h, *block.inner[:2]).clamp_min(0), *block.inner[3:5])
            h = (inner + (layer(h, *block.shortcut) if index == 0 else h)).clamp_min(0)
        maps.append(h)
    h = elu(layer(doubled(maps[2]), *net.up3[:2]))
    h = elu(layer(torch.cat([h, maps[1]], 1), *net.join3[:2]))
    h = elu(layer(doubled(h), *net.up2[:2]))
    h = elu(layer(torch.cat([h, maps[0]], 1), *net.join2[:2]))
    return convolve(h, net.last.weight, net.last.bias, 1)


def test_features_are_those_of_the_listed_layers(generator):
    net, image = ResUNet(generator).double(), torch.rand(1, 3, 64, 80, generator=generator, dtype=torch.float64)
    with torch.no_grad():
        found = net(image)
        assert found.shape == (1, 32, 16, 20)
        torch.testing.assert_close(found, literal_features(net, image))


def test_images_of_any_size_are_taken_down_to_64_pixels(generator):
    net = ResUNet(generator)
    with torch.no_grad():
        assert net(torch.rand(2, 3, 65, 91)).shape == (2, 32, 17, 23)
    with pytest.raises(ValueError, match="at least 64 x 64 pixels"):
        net(torch.rand(1, 3, 63, 80))


def test_blending_is_the_printed_softmax(generator):
    net = ViewBlending(generator=generator).double()
    features = torch.randn(5, 2, 35, generator=generator, dtype=torch.float64)
    first, second = net.weight[0], net.weight[2]
    for n in range(5):
        scores = []
        for v in range(2):
            h = (first.weight @ torch.cat([features[n, v], torch.zeros(1).double()]) + first.bias).relu()
            scores.append((second.weight @ h + second.bias).relu().item())
        total = sum(math.exp(s) for s in scores)
        expected = sum(math.exp(s) / total * features[n, v] for v, s in enumerate(scores))
        torch.testing.assert_close(net(features)[n], expected)


def test_unused_heads_take_no_gradients():
    assert not any(p.requires_grad for p in ViewBlending(with_unused_heads=True).unused.parameters())


def test_maps_are_sampled_between_pixels_with_corners_aligned(generator):
    maps = torch.randn(2, 3, 5, 6, generator=generator, dtype=torch.float64)
    size = (17, 21)
    pixels = torch.rand(2, 10, 2, generator=generator, dtype=torch.float64) * torch.tensor([20, 16])
    found = sample_maps(maps, pixels, size)
    for v in range(2):
        for n in range(10):
            x, y = pixels[v, n, 0].item() * 5 / 20, pixels[v, n, 1].item() * 4 / 16
            i, j = min(int(y), 3), min(int(x), 4)
            p, q = y - i, x - j
            m = maps[v]
            expected = (1 - p) * ((1 - q) * m[:, i, j] + q * m[:, i, j + 1])
            expected = expected + p * ((1 - q) * m[:, i + 1, j] + q * m[:, i + 1, j + 1])
            torch.testing.assert_close(found[n, v], expected)
    outside = torch.tensor([[[-10.0, 5.0]], [[5.0, 40.0]]], dtype=torch.float64)
    assert not sample_maps(maps, outside, size).any()
