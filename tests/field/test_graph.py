import math

import pytest
import torch

from twofold.body.skeleton import PARENTS
from twofold.field.bone_boxes import RIGID_PARTS
from twofold.field.encoding import fourier_encoding
from twofold.field.graph import (
    GraphLinear,
    NodeLinear,
    PoseGraph,
    pose_features,
    rotation_features,
    skeleton_adjacency,
)
from twofold.geometry.rotations import axis_angle_to_matrix


def literal_node(layer, x):
    return torch.stack([x[j] @ layer.weight[j] + layer.bias[j] for j in range(len(x))])


def literal_graph(layer, x):
    rows = []
    for i in range(24):
        total = layer.bias.clone()
        for j in range(24):
            if i == j or PARENTS[i] == j or PARENTS[j] == i:
                total = total + layer.adjacency[i, j] * (x[j] @ layer.weight[j])
        rows.append(total)
    return torch.stack(rows)


@pytest.mark.parametrize("shape", [(), (3,), (2, 3)])
def test_layers_are_their_sums_over_nodes(shape, generator):
    x = torch.randn(*shape, 24, 5, generator=generator, dtype=torch.float64)
    for layer, literal in (
        (GraphLinear(5, 4, generator=generator).double(), literal_graph),
        (NodeLinear(24, 5, 4, generator=generator).double(), literal_node),
    ):
        layer.bias.data.normal_(generator=generator)
        expected = torch.stack([literal(layer, row) for row in x.reshape(-1, 24, 5)]).reshape(*shape, 24, 4)
        torch.testing.assert_close(layer(x), expected)


def test_adjacency_starts_with_itself_at_one_and_neighbours_small(generator):
    adjacency = GraphLinear(3, 3, generator=generator).adjacency
    assert (adjacency.diagonal() == 1).all()
    others = adjacency[~torch.eye(24, dtype=torch.bool)]
    assert others.min() >= 0.01 - 1e-7
    assert others.mean().item() == pytest.approx(0.055, abs=0.01)
    assert skeleton_adjacency().sum() == 24 + 2 * 23


def test_pose_is_encoded_without_the_root(generator):
    rotations = axis_angle_to_matrix(torch.randn(24, 3, generator=generator, dtype=torch.float64))
    features = pose_features(rotations, 5)
    assert features.shape == (24, 66)
    assert not features[0].any()
    columns = [x for row in rotations[7].tolist() for x in row[:2]]
    assert rotation_features(rotations)[7].tolist() == columns
    expected = fourier_encoding(torch.tensor([columns], dtype=torch.float64), 5, include_pi=False)[0]
    torch.testing.assert_close(features[7], expected)
    assert torch.equal(pose_features(torch.stack([rotations, rotations]), 5)[1], features)


@pytest.mark.parametrize("parts", [None, RIGID_PARTS])
@pytest.mark.parametrize("activation", ["relu", "sine"])
def test_pose_graph_is_its_four_layers(activation, parts, generator):
    net = PoseGraph(6, 7, parts, activation, width=5, generator=generator).double()
    x = torch.randn(24, 6, generator=generator, dtype=torch.float64)

    def act(h):
        return torch.sin(8 * h) if activation == "sine" else h.clamp_min(0)

    h = act(literal_graph(net.layers[0], x))
    h = act(literal_graph(net.layers[1], h))
    h = act(literal_node(net.layers[2], h))
    h = literal_node(net.layers[3], h if parts is None else h[list(parts)])
    torch.testing.assert_close(net(x), act(h) if activation == "sine" else h)


def test_parameter_counts_are_the_authors():
    def count(*arguments):
        return sum(p.numel() for p in PoseGraph(*arguments).parameters())

    assert count(66, 192, RIGID_PARTS) == 1_464_256  # NPC
    assert count(66, 240) == 1_736_704  # DANBO
    assert count(6, 128, None, "sine") == 1_205_632  # PM-Avatar


def test_sine_layers_start_within_the_bounds_of_the_authors(generator):
    net = PoseGraph(6, 128, None, "sine", generator=generator)
    bounds = [1 / 128, *[math.sqrt(6 / 128) / 8] * 3]
    for layer, bound in zip(net.layers, bounds, strict=True):
        assert 0.99 * bound < layer.weight.abs().max() <= bound
