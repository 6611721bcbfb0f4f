import math

import pytest
import torch

from twofold.kernels.mlp import MLP, dense_layer, xavier_bound


def literal_mlp(network, x, constant=None):
    """Every sample for itself, with the constants beside it and lists joined as written."""
    rows = []
    for sample in x:
        h = sample if constant is None else torch.cat([constant, sample])
        for index, layer in enumerate(network.layers):
            if index == network.skip_layer:
                h = torch.cat([sample, h] if network.skip_first else [h, sample])
            h = layer.weight @ h + layer.bias
            if index < len(network.layers) - 1:
                h = torch.where(h > 0, h, 0.0)
        rows.append(h)
    return torch.stack(rows)


@pytest.mark.parametrize("start", ["xavier", "torch"])
@pytest.mark.parametrize("skip_first", [True, False])
@pytest.mark.parametrize("constants", [0, 4])
@pytest.mark.parametrize("skip_layer", [None, 2])
def test_values_are_those_of_the_layers_one_by_one(skip_layer, constants, skip_first, start, generator):
    network = MLP(5, [7, 6, 8], 3, constants, skip_layer, skip_first, start, generator=generator).double()
    for layer in network.layers:
        layer.bias.data.normal_(generator=generator)
    x = torch.randn(4, 5, generator=generator, dtype=torch.float64)
    constant = torch.randn(constants, generator=generator, dtype=torch.float64) if constants else None
    torch.testing.assert_close(network(x, constant), literal_mlp(network, x, constant))


def test_gradients_reach_inputs_constants_and_weights(generator):
    network = MLP(3, [5, 4], 2, constants=2, skip_layer=1, generator=generator).double()
    x = torch.randn(2, 3, generator=generator, dtype=torch.float64, requires_grad=True)
    constant = torch.randn(2, generator=generator, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(lambda x, c, *_: network(x, c), (x, constant, *network.parameters()))


def test_xavier_weights_fill_their_bound_and_biases_are_zero(generator):
    network = MLP(30, [40], 50, generator=generator)
    for layer, gain in zip(network.layers, [math.sqrt(2), 1.0], strict=True):
        bound = xavier_bound(layer.in_features, layer.out_features, gain)
        std = gain * math.sqrt(2 / (layer.in_features + layer.out_features))
        assert 0.97 * bound < layer.weight.abs().max() <= bound
        assert layer.weight.std().item() == pytest.approx(std, rel=0.05)
        assert not layer.bias.any()


def test_small_last_layer_starts_near_zero(generator):
    network = MLP(3, [8], 2, last_bound=1e-5, generator=generator)
    assert 0 < network.layers[-1].weight.abs().max() <= 1e-5
    assert not network.layers[-1].bias.any()


def test_same_generator_gives_the_same_network():
    first, second = (dense_layer(3, 4, 1.0, torch.Generator().manual_seed(5), 0.5) for _ in range(2))
    assert torch.equal(first.weight, second.weight)
    assert torch.equal(first.bias, second.bias)


@pytest.mark.parametrize("skip_layer", [0, 2])
def test_skip_into_no_hidden_layer_is_refused(skip_layer):
    with pytest.raises(ValueError, match="skip_layer"):
        MLP(3, [4, 4], 1, skip_layer=skip_layer)


def test_missing_constants_are_refused():
    with pytest.raises(ValueError, match="takes 2 constant inputs, 0 were given"):
        MLP(3, [4], 1, constants=2)(torch.zeros(1, 3))
