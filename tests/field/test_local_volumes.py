import math

import torch

from twofold.field.bone_boxes import RIGID_PARTS, inside_boxes
from twofold.field.local_volumes import LocalVolumes, line_features


def literal_line(line, x):
    """Interpolation in one table whose first and last entries lie at -1 and 1."""
    place = (min(max(x, -1), 1) + 1) / 2 * (len(line) - 1)
    low = min(math.floor(place), len(line) - 2)
    return (low + 1 - place) * line[low] + (place - low) * line[low + 1]


def test_lookup_is_interpolation_axis_by_axis(generator):
    lines = torch.randn(4, 3, 6, 3, generator=generator, dtype=torch.float64)
    x = torch.randn(10, 3, generator=generator, dtype=torch.float64)
    x[0], x[1] = 1.0, -1.0
    part = torch.randint(4, (10,), generator=generator)
    found = line_features(lines, x, part)
    for n in range(10):
        expected = [
            literal_line(lines[part[n], f, :, axis].tolist(), x[n, axis].item()) for axis in range(3) for f in range(3)
        ]
        torch.testing.assert_close(found[n], torch.tensor(expected, dtype=torch.float64))


def test_lookup_is_differentiable(generator):
    lines = torch.randn(2, 2, 4, 3, generator=generator, dtype=torch.float64, requires_grad=True)
    x = (torch.rand(3, 3, generator=generator, dtype=torch.float64) - 0.5).requires_grad_()
    part = torch.tensor([0, 1, 1])
    assert torch.autograd.gradcheck(lambda lines, x: line_features(lines, x, part), (lines, x))


def literal_blend(volumes, tables, x):
    """The feature of one sample, part by part."""
    local = []
    for j in range(24):
        window = math.exp(-2 * sum(c**6 for c in x[j].tolist()))
        lookup = [literal_line(tables[j, f, :, a].tolist(), x[j, a].item()) for a in range(3) for f in range(5)]
        local.append(window * torch.tensor(lookup, dtype=torch.float64))
    graph, second, third = volumes.blending
    mapped = torch.stack([local[j] @ graph.weight[j] for j in range(24)])
    h = ((graph.adjacency * graph.mask) @ mapped + graph.bias).relu()
    h = torch.stack([h[j] @ second.weight[j] + second.bias[j] for j in range(24)]).relu()
    a = torch.stack([h[j] @ third.weight[j] + third.bias[j] for j in range(24)])[:, 0]
    p = [float(max(abs(c) for c in x[j].tolist()) <= 1) * (1.002 * a[j].sigmoid() - 0.001) for j in range(24)]
    return sum(p[j] * local[j] for j in RIGID_PARTS), torch.stack(p)


def test_features_are_blended_as_printed(generator):
    volumes = LocalVolumes(generator).double()
    tables = volumes.tables(torch.randn(24, 66, generator=generator, dtype=torch.float64))
    x = torch.randn(3, 24, 3, generator=generator, dtype=torch.float64)
    feature, probability = volumes(tables, x, inside_boxes(x))
    for n in range(3):
        expected, p = literal_blend(volumes, tables.detach(), x[n])
        torch.testing.assert_close(feature[n], expected)
        torch.testing.assert_close(probability[n], p)


def test_parameter_counts_are_the_authors():
    volumes = LocalVolumes()
    assert sum(p.numel() for p in volumes.pose_graph.parameters()) == 1_736_704
    assert sum(p.numel() for p in volumes.blending.parameters()) == 38_264
