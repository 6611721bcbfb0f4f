"""How far a pose is from the training poses."""

import math

import pytest
import torch
from scipy.spatial.transform import Rotation

from twofold.reproduce.pose_distance import binned, pose_distances


def test_distance_is_the_mean_angle_to_the_nearest_training_pose(generator):
    poses, training = torch.randn(3, 24, 3, generator=generator), torch.randn(5, 24, 3, generator=generator)

    def between(a, b):
        angles = [(Rotation.from_rotvec(a[j]).inv() * Rotation.from_rotvec(b[j])).magnitude() for j in range(1, 24)]
        return math.degrees(sum(angles) / 23)

    expected = [min(between(a.numpy(), b.numpy()) for b in training) for a in poses]
    assert pose_distances(poses, training).tolist() == pytest.approx(expected, abs=1e-4)


def test_training_poses_are_at_zero_and_turning_the_root_changes_nothing(generator):
    training = torch.randn(4, 24, 3, generator=generator)
    turned = training.clone()
    turned[:, 0] += 1
    assert pose_distances(turned, training).tolist() == pytest.approx([0] * 4, abs=1e-4)


def test_bins_hold_all_values_once():
    found = binned([5.0, 1.0, 4.0, 2.0, 3.0], [50.0, 10.0, 40.0, 20.0, 30.0], bins=2)
    assert [count for *_, count in found] == [2, 3]
    assert [(distance, value) for distance, value, _, _ in found] == [(1.5, 15), (4, 40)]
    assert found[1][2] == pytest.approx(10 / math.sqrt(3))


def test_images_of_one_frame_share_a_bin():
    found = binned([8.0, 3.0, 8.0, 3.0, 8.0], [1.0, 5.0, 2.0, 7.0, 3.0], bins=4)
    assert [(distance, value, count) for distance, value, _, count in found] == [(3.0, 6.0, 2), (8.0, 2.0, 3)]


def test_fewer_values_than_bins_are_bins_of_one():
    assert [count for *_, count in binned([1.0, 2.0], [3.0, 4.0], bins=4)] == [1, 1]
    assert binned([], []) == []
