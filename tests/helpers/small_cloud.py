"""A cloud of a few points for each part of a small skeleton, in double precision."""

import torch
from little_body import JOINTS

from twofold.body.skeleton import joint_transforms
from twofold.field.bone_boxes import initial_half_sizes
from twofold.field.graph import pose_features
from twofold.field.points import PointCloud, PointDeformation, PosedPoints
from twofold.geometry.rotations import axis_angle_to_matrix

JOINTS_64 = torch.tensor(JOINTS, dtype=torch.float64)


def small_cloud(generator: torch.Generator, slots: int = 4) -> PointCloud:
    positions = 2 * torch.rand(slots, 19, 3, generator=generator, dtype=torch.float64) - 1
    return PointCloud(positions, JOINTS_64, initial_half_sizes(JOINTS_64), generator=generator).double()


def random_pose(generator: torch.Generator) -> tuple[torch.Tensor, torch.Tensor]:
    """Features of a pose, and the joints' transforms."""
    pose = 0.3 * torch.randn(24, 3, generator=generator, dtype=torch.float64)
    translation = torch.tensor([0.2, 0.1, -0.3], dtype=torch.float64)
    return pose_features(axis_angle_to_matrix(pose), 5), joint_transforms(JOINTS_64, pose, translation)


def posed_cloud(cloud: PointCloud, generator: torch.Generator) -> PosedPoints:
    deformation = PointDeformation(generator).double()
    return deformation(cloud, *random_pose(generator))
