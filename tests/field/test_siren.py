import math

import pytest
import torch

from twofold.field.siren import SineLayer, modulated_sine, siren_linear


def test_layers_are_the_printed_sines(generator):
    layer = SineLayer(3, 4, 8.0, generator).double()
    x = torch.randn(5, 3, generator=generator, dtype=torch.float64)
    for n in range(5):
        for o in range(4):
            z = sum(layer.linear.weight[o, i] * x[n, i] for i in range(3)) + layer.linear.bias[o]
            torch.testing.assert_close(layer(x)[n, o], torch.sin(8 * z))
    f, p = torch.rand(5, generator=generator), torch.rand(5, generator=generator)
    expected = [math.sin((15 * b + 30) * 0.2 + c) for b, c in zip(f.tolist(), p.tolist(), strict=True)]
    assert modulated_sine(torch.full((5,), 0.2), f, p).tolist() == pytest.approx(expected, abs=1e-5)


def test_weights_start_within_the_bounds_of_siren(generator):
    first, other = siren_linear(3, 500, 8.0, generator, is_first=True), siren_linear(96, 500, 8.0, generator)
    assert 0.99 / 3 < first.weight.abs().max() <= 1 / 3
    assert 0.99 * math.sqrt(6 / 96) / 8 < other.weight.abs().max() <= math.sqrt(6 / 96) / 8


def test_activations_keep_their_spread_through_many_layers(generator):
    h = 2 * torch.rand(4000, 128, generator=generator) - 1
    for _ in range(4):
        h = SineLayer(128, 128, 8.0, generator)(h)
    assert 0.5 < h.std().item() < 0.9  # of an arcsine distribution: 0.71
