"""Surfaces posed by a body whose motion is known."""

import pytest
import torch
from little_body import posed_little_body
from torch import Tensor

from twofold.body.skeleton import JOINT_NAMES, PosedBody, ShapedBody, canonical_pose, pose_body
from twofold.errors import TwofoldError
from twofold.geometry.rotations import axis_angle_to_matrix, rigid_transform
from twofold.methods.base import Avatar, PosedAvatar
from twofold.outputs.mesh import pose_surface, posed_surface


def small_body(seed: int = 0, joints_each: int = 2) -> ShapedBody:
    """Vertices strewn about joints, each skinned to one or two of them; there need not be a surface."""
    generator = torch.Generator().manual_seed(seed)
    joints = torch.randn(24, 3, generator=generator)
    weights = torch.zeros(60, 24)
    for i in range(60):
        weights[i, i % 24] = 0.7 if joints_each == 2 else 1.0
        weights[i, (7 * i + 1) % 24] += 1 - weights[i, i % 24]
    return ShapedBody(
        vertices=torch.randn(60, 3, generator=generator),
        joints=joints,
        faces=torch.tensor([[0, 1, 2]]),
        weights=weights,
        pose_basis=torch.zeros(60, 3, 0),
    )


def posed(pose: Tensor, translation: Tensor) -> PosedBody:
    assert pose.shape == (len(JOINT_NAMES), 3)
    return pose_body(small_body(), pose, translation)


def test_posing_into_the_canonical_pose_changes_nothing() -> None:
    body = posed(canonical_pose(), torch.zeros(3))
    points = torch.randn(50, 3, generator=torch.Generator().manual_seed(1))
    assert torch.allclose(pose_surface(points, body), points, atol=1e-5)


def test_turning_the_root_moves_the_surface_rigidly() -> None:
    pose, translation = canonical_pose(), torch.tensor([0.3, 1.0, -2.0])
    pose[0] = torch.tensor([0.4, 1.1, -0.3])
    body = posed(pose, translation)
    points = torch.randn(50, 3, generator=torch.Generator().manual_seed(1))
    root = small_body().joints[0]
    rotation = axis_angle_to_matrix(pose[0])
    motion = rigid_transform(rotation, root + translation - rotation @ root)
    expected = points @ motion[:3, :3].T + motion[:3, 3]
    assert torch.allclose(pose_surface(points, body), expected, atol=1e-5)


def test_with_one_neighbour_the_body_itself_is_posed_exactly() -> None:
    pose = 0.5 * torch.randn(24, 3, generator=torch.Generator().manual_seed(2))
    body = pose_body(small_body(joints_each=1), pose, torch.tensor([0.1, 0.2, 0.3]))
    assert torch.allclose(pose_surface(body.canonical_vertices, body, neighbours=1), body.vertices, atol=1e-5)


def test_neighbours_share_by_the_exponential_of_their_squared_distance() -> None:
    body = posed(0.5 * torch.randn(24, 3, generator=torch.Generator().manual_seed(2)), torch.zeros(3))
    point = torch.tensor([[0.2, -0.1, 0.3]])
    squared = (body.canonical_vertices - point).square().sum(-1)
    chosen = squared.argsort()[:7]
    shares = torch.exp(-squared[chosen].clamp_max(4))
    weights = ((shares / shares.sum())[:, None] * body.weights[chosen]).sum(0)
    transform = (weights[:, None, None] * body.bones).sum(0)
    expected = transform[:3, :3] @ point[0] + transform[:3, 3]
    assert torch.allclose(pose_surface(point, body)[0], expected, atol=1e-5)


@pytest.mark.parametrize("reach", [0.1, 0.02])
def test_no_surface_is_taken_from_where_samples_are_never_placed(reach: float) -> None:
    body = posed_little_body()

    class Balloon(Avatar[None]):
        """The body, eight centimetres thicker."""

        pose = render = losses = parameter_groups = None  # type: ignore[assignment]
        device = torch.device("cpu")  # type: ignore[assignment]

        @property
        def reach(self) -> float:
            return reach

        def level(self, x: Tensor, posed: object, branch: str = "full") -> Tensor:
            return torch.cdist(x, body.canonical_vertices).amin(1) - 0.08

    avatar = Balloon()
    if reach < 0.08:
        with pytest.raises(TwofoldError, match="within 2 cm"):
            posed_surface(avatar, PosedAvatar(body, None), 0.02)
        return
    vertices, _ = posed_surface(avatar, PosedAvatar(body, None), 0.02)
    assert len(vertices) > 100
