import math
from dataclasses import replace

import pytest
import torch
from torch.nn import functional as F

from twofold.field import networks
from twofold.field.networks import (
    Network,
    NetworkConfig,
    _processor_flags,
    bf16_is_fast,
)

SMALL = NetworkConfig(
    inputs=12, constants=4, outputs=5, depth=5, width=16, skip_layer=3, skip_columns=9, head="tanh", start="sphere"
)


def moved(network: Network, seed: int = 0) -> Network:
    """The network in double precision, off its start, so that no weight is zero."""
    generator = torch.Generator().manual_seed(seed)
    network = network.double()
    with torch.no_grad():
        for parameter in network.parameters():
            noise = torch.randn(parameter.shape, generator=generator, dtype=torch.float64)
            parameter.add_(0.2 * noise * parameter.abs().mean().clamp_min(0.1))
    return network


def literal_network(network: Network, x, constant):
    """The concatenated form, layer by layer with torch's own operations, and no reverse pass of ours."""
    config = network.config
    inputs = x if constant is None else torch.cat([x, constant.expand(len(x), -1)], -1)
    h = inputs
    for i, layer in enumerate(network.layers):
        if i == config.skip_layer:
            h = torch.cat([h, x[:, : config.skip_columns]], -1) / math.sqrt(2)
        matrix = layer.direction
        if config.weight_norm:
            matrix = layer.gain * matrix / matrix.norm(dim=1, keepdim=True)
        h = h @ matrix.T + layer.bias
        if i < config.depth:
            h = F.softplus(h, beta=100) if config.activation == "softplus" else F.relu(h)
    return h.tanh() if config.head == "tanh" else h


VARIANTS = {
    "sdf network with skip and pose": SMALL,
    "no constants": replace(SMALL, constants=0),
    "no skip": replace(SMALL, skip_layer=None, skip_columns=0),
    "no weight norm, linear head": replace(SMALL, weight_norm=False, head="linear"),
    "relu": replace(SMALL, activation="relu", start="kaiming"),
    "native softplus": replace(SMALL, native_softplus=True),
    "one hidden layer": replace(SMALL, depth=1, skip_layer=None, skip_columns=0),
}


@pytest.fixture(params=VARIANTS.values(), ids=VARIANTS.keys())
def case(request):
    config = request.param
    network = moved(config.build(torch.Generator().manual_seed(1)))
    x = torch.randn(6, config.inputs, dtype=torch.float64, generator=torch.Generator().manual_seed(2))
    constant = torch.linspace(-1, 1, config.constants, dtype=torch.float64) if config.constants else None
    return network, x, constant


def test_values_are_those_of_the_concatenated_form(case):
    network, x, constant = case
    expected = literal_network(network, x, constant)
    torch.testing.assert_close(network(x, constant), expected)
    torch.testing.assert_close(network.at(constant).forward_with_tape(x)[0], expected)
    torch.testing.assert_close(network.at(constant)(x, 2), expected[:, :2])


@pytest.mark.parametrize(("first", "count"), [(0, 1), (0, 5), (1, 4)])
def test_pullback_is_the_transposed_jacobian(case, first, count):
    network, x, constant = case
    x = x.requires_grad_()
    rows = slice(first, first + count)
    cotangent = torch.randn(6, count, dtype=torch.float64)
    (automatic,) = torch.autograd.grad(literal_network(network, x, constant)[:, rows], x, cotangent)
    ready = network.at(constant)
    _, tape = ready.forward_with_tape(x)
    torch.testing.assert_close(ready.pullback(tape, cotangent, first), automatic)


def test_first_order_training_of_a_gradient_equals_double_differentiation(case):
    network, x, constant = case
    x = x.requires_grad_()
    parameters = list(network.parameters())
    (gradient,) = torch.autograd.grad(literal_network(network, x, constant)[:, 0].sum(), x, create_graph=True)
    loss = ((gradient.norm(dim=1) - 1) ** 2).sum()
    twice = torch.autograd.grad(loss, [*parameters, x], allow_unused=True)
    ready = network.at(constant)
    value, tape = ready.forward_with_tape(x)
    by_hand = ready.pullback(tape, torch.ones_like(value[:, :1]))
    loss = ((by_hand.norm(dim=1) - 1) ** 2).sum()
    once = torch.autograd.grad(loss, [*parameters, x], allow_unused=True)
    for parameter, a, b in zip([*parameters, x], once, twice, strict=True):
        # None is how a linear head's bias says that it moves no gradient.
        zero = torch.zeros_like(parameter)
        torch.testing.assert_close(zero if a is None else a, zero if b is None else b)


def test_gradcheck_through_the_pullback():
    network = moved(replace(SMALL, inputs=5, constants=2, width=7, depth=3, skip_layer=2, skip_columns=4).build())
    x = 0.1 * torch.randn(3, 5, dtype=torch.float64)
    constant = torch.tensor([0.3, -0.2], dtype=torch.float64)

    def answer(x, constant, *parameters):
        ready = network.at(constant)
        value, tape = ready.forward_with_tape(x)
        return value, ready.pullback(tape, torch.ones_like(value))

    parameters = list(network.parameters())
    assert torch.autograd.gradcheck(answer, (x.requires_grad_(), constant.requires_grad_(), *parameters))


def test_sphere_start_is_near_the_distance_to_a_sphere():
    config = NetworkConfig(inputs=33, outputs=257, depth=4, head="linear", start="sphere", constants=10)
    generator = torch.Generator().manual_seed(0)
    direction = F.normalize(torch.randn(200, 3, generator=generator), dim=1)
    network = config.build(generator)
    means = []
    for radius in (0.3, 0.6, 1.2):
        x = torch.cat([radius * direction, torch.randn(200, 30, generator=generator)], -1)
        sdf = network(x, torch.randn(10, generator=generator))[:, 0]
        means.append(sdf.mean().item())
        bare = network(torch.cat([x[:, :3], torch.zeros(200, 30)], -1), torch.zeros(10))[:, 0]
        assert torch.equal(sdf, bare), "only the coordinates count at first"
    assert means == pytest.approx([-0.3, 0.0, 0.6], abs=0.15)


def test_sphere_start_hides_the_encoded_part_of_the_skip():
    network = SMALL.build()
    skip = network.layers[3].direction
    assert skip[:, -6:].abs().max() == 0
    assert skip[:, :-6].abs().min(dim=1).values.max() > 0


def test_kaiming_start_has_the_spread_of_fan_out():
    network = NetworkConfig(inputs=302, outputs=3, depth=4, activation="relu").build(torch.Generator().manual_seed(0))
    for layer, rows in zip(network.layers, (256, 256, 256, 256, 3), strict=True):
        assert layer.direction.std().item() == pytest.approx(math.sqrt(2 / rows), rel=0.1)
        torch.testing.assert_close(layer.gain[:, 0], layer.direction.norm(dim=1))


def test_start_is_the_generators():
    first, second, third = (SMALL.build(torch.Generator().manual_seed(seed)) for seed in (3, 3, 4))
    pairs = [zip(first.parameters(), other.parameters(), strict=True) for other in (second, third)]
    assert all(torch.equal(a, b) for a, b in pairs[0])
    assert not all(torch.equal(a, b) for a, b in pairs[1])


def fitted(config: NetworkConfig) -> Network:
    """A network that has learned the distance to a bumpy sphere, so that its precision is tested on a real shape."""
    torch.manual_seed(0)
    network = config.build(torch.Generator().manual_seed(0))
    optimizer = torch.optim.Adam(network.parameters(), 1e-3)
    generator = torch.Generator().manual_seed(1)
    for _ in range(40):
        x = torch.randn(256, 3, generator=generator) * 0.5
        target = x.norm(dim=1) - 0.6 + 0.03 * (8 * x).sin().sum(1)
        loss = (network(x)[:, 0] - target).abs().mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    return network


def test_bf16_hidden_layers_are_off_by_a_millimetre_and_a_degree_and_a_half():
    config = NetworkConfig(inputs=3, outputs=33, depth=8, width=128, skip_layer=3, skip_columns=3, start="sphere")
    network = fitted(config)
    coarse = Network(replace(config, hidden_dtype="bfloat16"))
    coarse.load_state_dict(network.state_dict())
    x = torch.nn.functional.normalize(torch.randn(2000, 3), dim=1) * (0.55 + 0.1 * torch.rand(2000, 1))
    answers = []
    for ready in (network.at(), coarse.at()):
        value, tape = ready.forward_with_tape(x)
        answers.append((value[:, 0], F.normalize(ready.pullback(tape, torch.ones_like(value[:, :1])), dim=1)))
    (sdf, normal), (coarse_sdf, coarse_normal) = answers
    assert coarse_sdf.dtype == torch.float32
    assert (sdf - coarse_sdf).abs().mean() < 1.2e-3
    angle = torch.rad2deg(torch.arccos((normal * coarse_normal).sum(1).clamp(-1, 1)))
    assert angle.mean() < 1.6
    assert not torch.equal(sdf, coarse_sdf)


def test_bf16_trains_through_the_pullback():
    network = NetworkConfig(
        inputs=6, outputs=5, depth=4, width=32, skip_layer=2, skip_columns=6, start="sphere", hidden_dtype="bfloat16"
    ).build(torch.Generator().manual_seed(0))
    ready = network.at()
    value, tape = ready.forward_with_tape(torch.randn(64, 6))
    gradient = ready.pullback(tape, torch.ones_like(value[:, :1]))
    ((gradient.norm(dim=1) - 1) ** 2).mean().backward()
    assert all(p.grad is not None and p.grad.dtype == torch.float32 for p in network.parameters() if p.grad is not None)
    assert sum(p.grad is not None and bool(p.grad.any()) for p in network.parameters()) >= 9


@pytest.mark.parametrize("fast", [True, False])
def test_the_hardware_decides_about_bf16_where_it_is_asked(fast, monkeypatch):
    monkeypatch.setattr(networks, "bf16_is_fast", lambda device: fast)
    config = NetworkConfig(inputs=3, outputs=2, depth=3, width=16, hidden_dtype="auto")
    kinds = [matrix.dtype for matrix in config.build().at().matrices]
    hidden = torch.bfloat16 if fast else torch.float32
    assert kinds == [torch.float32, hidden, hidden, torch.float32]


def test_processor_flags_are_read_where_linux_lists_them(tmp_path):
    file = tmp_path / "cpuinfo"
    file.write_text("processor\t: 0\nmodel name\t: amx_bf16 lookalike\nflags\t\t: fpu avx512f amx_bf16\n")
    assert _processor_flags(file) == {"fpu", "avx512f", "amx_bf16"}
    assert _processor_flags(tmp_path / "absent") == set()
    assert isinstance(bf16_is_fast(), bool)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"skip_columns": 16}, ["skip_columns=16", "width=16"]),
        ({"skip_layer": 5}, ["skip_layer=5", "depth=5"]),
        ({"depth": 0}, ["depth"]),
    ],
)
def test_clashing_sizes_are_refused(change, words):
    with pytest.raises(ValueError) as caught:  # noqa: PT011
        replace(SMALL, **change)
    assert all(word in str(caught.value) for word in words)


def test_wrong_number_of_constants_is_refused():
    with pytest.raises(ValueError, match="4 constant inputs, 0 were given"):
        SMALL.build().at()
