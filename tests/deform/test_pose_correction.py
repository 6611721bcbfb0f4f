import math

import pytest
import torch

from twofold.deform.pose_correction import PoseCorrection, body_pose_condition, correction_matrix
from twofold.geometry.rotations import axis_angle_to_matrix


def literal_rodrigues(r):
    """Entry by entry: cos a I + (1 - cos a) n n^T + sin a [n], plus what n lacks of length one."""
    angle = math.sqrt(1e-5 + sum(x * x for x in r))
    n = [x / angle for x in r]
    length = sum(x * x for x in n)
    k = [[0, -n[2], n[1]], [n[2], 0, -n[0]], [-n[1], n[0], 0]]
    matrix = torch.zeros(3, 3, dtype=torch.float64)
    for i in range(3):
        for j in range(3):
            same = float(i == j)
            square = n[i] * n[j] - length * same
            matrix[i, j] = same + math.sin(angle) * k[i][j] + (1 - math.cos(angle)) * square
    return matrix


def test_correction_is_rodrigues_formula_with_an_offset_angle(generator):
    vectors = torch.randn(5, 3, generator=generator, dtype=torch.float64)
    expected = torch.stack([literal_rodrigues(v.tolist()) for v in vectors])
    torch.testing.assert_close(correction_matrix(vectors), expected)


def test_correction_is_nearly_the_exact_rotation(generator):
    vectors = torch.randn(50, 3, generator=generator, dtype=torch.float64)
    assert (correction_matrix(vectors) - axis_angle_to_matrix(vectors)).abs().max() < 1e-3


def test_correction_is_differentiable_at_zero():
    zero = torch.zeros(2, 3, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(correction_matrix, zero)


def test_poses_start_uncorrected_and_the_root_stays(generator):
    net = PoseCorrection(generator)
    pose = torch.randn(24, 3, generator=generator)
    torch.testing.assert_close(net(pose), axis_angle_to_matrix(pose), atol=2e-3, rtol=0)
    net.network.layers[-1].bias.data.fill_(0.3)
    corrected = net(pose)
    torch.testing.assert_close(corrected[0], axis_angle_to_matrix(pose)[0])
    turn = axis_angle_to_matrix(torch.full((23, 3), 0.3))
    torch.testing.assert_close(corrected[1:], axis_angle_to_matrix(pose)[1:] @ turn, atol=2e-3, rtol=0)


def test_parameter_count_is_the_authors():
    assert sum(p.numel() for p in PoseCorrection().parameters()) == 233_029


def test_condition_is_the_body_pose_without_the_root(generator):
    pose = torch.randn(24, 3, generator=generator)
    assert body_pose_condition(pose).tolist() == pytest.approx([x + 0.01 for row in pose[1:].tolist() for x in row])
