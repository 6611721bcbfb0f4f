import torch

from twofold.field.encoding import fourier_encoding
from twofold.field.pixel_background import PixelBackground


def test_background_is_what_is_known_plus_the_network(generator):
    net = PixelBackground(generator).double()
    pixels = torch.rand(4, 2, generator=generator, dtype=torch.float64)
    known = torch.rand(4, 3, generator=generator, dtype=torch.float64)
    code = torch.randn(128, generator=generator, dtype=torch.float64)
    encoded = fourier_encoding(pixels, 5, include_pi=False)
    h = torch.cat([code.expand(4, -1), encoded, known], 1)
    for layer in net.network.layers[:2]:
        h = layer(h).relu()
    torch.testing.assert_close(net(pixels, known, code), known + net.network.layers[2](h))


def test_parameter_count_is_the_authors():
    assert sum(p.numel() for p in PixelBackground().parameters()) == 105_987
