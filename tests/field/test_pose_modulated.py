import pytest
import torch

from twofold.field.pose_modulated import PoseModulatedField


def literal_features(field, pose, x):
    """All 24 boxes of every sample, as printed."""
    window = torch.exp(-2 * x.pow(6).sum(-1)).detach()
    u = torch.sin(8 * field.window_encoder.linear(x))
    a = (pose + field.point_map(u)) * window[..., None]
    m = a.max(1).values
    first, second, third = field.window
    second_window = torch.sigmoid(third(torch.sin(8 * second.linear(torch.sin(8 * first.linear(m))))))
    w = window * second_window
    h = (w[..., None] * pose).sum(1)
    for layer in field.pose_extractor[:3]:
        h = torch.sin(8 * layer.linear(h))
    h = field.pose_extractor[3](h)
    frequency, phase = h[:, :768].reshape(-1, 3, 256), h[:, 768:].reshape(-1, 3, 256)
    y = (w[..., None] * torch.sin(16 * field.value_encoder.linear(x))).flatten(1)
    outputs = []
    for i, layer in enumerate(field.modulated):
        y = torch.sin((15 * frequency[:, i] + 30) * layer(y) + phase[:, i])
        outputs.append(y)
    return torch.cat(outputs, 1)


@pytest.fixture
def field(generator):
    return PoseModulatedField(generator).double()


def test_features_are_those_of_all_boxes(field, generator):
    pose = field.pose(torch.randn(24, 6, generator=generator, dtype=torch.float64))
    near = 0.7 * torch.randn(4, 24, 3, generator=generator, dtype=torch.float64)
    far = 2 * torch.randn(4, 24, 3, generator=generator, dtype=torch.float64)
    nowhere = torch.full((1, 24, 3), 5.0, dtype=torch.float64)
    x = torch.cat([near, far, nowhere])
    torch.testing.assert_close(field(pose, x), literal_features(field, pose, x))


def test_largest_of_24_boxes_may_be_negative(field, generator):
    pose = field.pose(torch.randn(24, 6, generator=generator, dtype=torch.float64))[:1].expand(24, -1)
    x = 0.3 * torch.randn(4, 1, 3, generator=generator, dtype=torch.float64).expand(4, 24, 3)
    torch.testing.assert_close(field(pose, x), literal_features(field, pose, x))


def test_gradients_are_those_of_all_boxes(field, generator):
    features = torch.randn(24, 6, generator=generator, dtype=torch.float64)
    x = torch.randn(5, 24, 3, generator=generator, dtype=torch.float64, requires_grad=True)
    mix = torch.randn(5, 768, generator=generator, dtype=torch.float64)
    parameters = [x, *field.parameters()]
    ours = torch.autograd.grad((field(field.pose(features), x) * mix).sum(), parameters)
    literal = torch.autograd.grad((literal_features(field, field.pose(features), x) * mix).sum(), parameters)
    for a, b in zip(ours, literal, strict=True):
        torch.testing.assert_close(a, b)


def test_boxes_with_little_weight_change_little(field, generator):
    pose = field.pose(torch.randn(24, 6, generator=generator, dtype=torch.float64))
    x = torch.randn(50, 24, 3, generator=generator, dtype=torch.float64)
    difference = (field(pose, x, min_window=1e-6) - field(pose, x)).abs()
    assert 0 < difference.max() < 1e-2


def test_parameter_counts_are_the_authors(field):
    def count(*modules):
        return sum(p.numel() for module in modules for p in module.parameters())

    assert count(field.pose_graph) == 1_205_632
    assert count(field.window_encoder, field.value_encoder) == 512
    assert count(field.pose_map, field.point_map, field.window) == 60_952
    assert count(field.pose_extractor) == 247_680
    assert count(field.modulated) == 525_056
