import torch

from twofold.field.conditioned_radiance import ColorHead, ConditionedRadiance


def count(module):
    return sum(p.numel() for p in module.parameters())


def dense(h, layers):
    for layer in layers:
        h = (h @ layer.weight.T + layer.bias).clamp_min(0)
    return h


def test_networks_are_the_printed_chain(generator):
    field = ConditionedRadiance(10, 5, generator).double()
    x = torch.randn(4, 10, generator=generator, dtype=torch.float64)
    view = torch.randn(4, 5, generator=generator, dtype=torch.float64)
    code = torch.randn(128, generator=generator, dtype=torch.float64)
    layers = field.density.layers
    h = dense(torch.cat([x, dense(x, layers[:5])], 1), layers[5:8])
    density = h @ layers[8].weight.T + layers[8].bias
    feature = h @ field.color.feature.weight.T + field.color.feature.bias
    first, second = field.color.network.layers
    color = dense(torch.cat([code.expand(4, -1), feature, view], 1), [first]) @ second.weight.T + second.bias
    output = field(x, view, code)
    torch.testing.assert_close(output.density, density[:, 0].clamp_min(0))
    torch.testing.assert_close(output.color, 1.002 / (1 + torch.exp(-color)) - 0.001)


def test_noise_is_added_before_the_relu_in_training_only(generator):
    field = ConditionedRadiance(3, 2, generator)
    with torch.no_grad():
        field.density.layers[-1].weight.zero_()
        field.density.layers[-1].bias.fill_(-0.5)
        arguments = (torch.zeros(2000, 3), torch.zeros(2000, 2), torch.zeros(128))
        quiet, noisy = field(*arguments).density, field(*arguments, generator).density
    assert (quiet == 0).all()
    assert 0.25 < (noisy > 0).float().mean() < 0.37  # P(N(-0.5, 1) > 0) = 0.309


def test_parameter_counts_are_the_authors():
    danbo, pm = ConditionedRadiance(195, 27), ConditionedRadiance(768, 16)
    assert count(danbo) == 560_897 + 118_915
    assert (count(pm.density), count(pm.color)) == (854_273, 117_507)
    assert count(ColorHead(5)) == 116_099  # NPC
