"""Corrections of a pose by a network that sees the pose (HumanNeRF, MonoHuman).

`deform.pose_refinement` holds the other form: a table with one correction for each frame.
"""

import torch
from jaxtyping import Float
from torch import Tensor, nn

from twofold.geometry.rotations import axis_angle_to_matrix, cross_matrix
from twofold.kernels.mlp import MLP

POSE_OFFSET = 0.01
"""Added to the body pose where a network of HumanNeRF or MonoHuman is conditioned on it."""
ANGLE_OFFSET = 1e-5
"""Added to the squared angle of a correction, so that its derivative is finite at zero."""


def body_pose_condition(pose: Float[Tensor, "24 3"]) -> Float[Tensor, "69"]:
    r"""What the networks are conditioned on: the 23 body rotations without the root, radians, plus 0.01.

    \[ \hat\theta = (\theta_1, \dots, \theta_{23}) + 0.01 \]

    >>> body_pose_condition(torch.zeros(24, 3))[:2]
    tensor([0.0100, 0.0100])
    """
    return pose[1:].flatten() + POSE_OFFSET


def correction_matrix(axis_angle: Float[Tensor, "*b 3"]) -> Float[Tensor, "*b 3 3"]:
    r"""Rodrigues' formula I + sin(a) K + (1 - cos a) K^2 with a = sqrt(1e-5 + |r|^2) and K the cross matrix of r / a.

    \[ R = I + \sin(a) K + (1 - \cos a) K^2, \quad a = \sqrt{10^{-5} + \lVert r \rVert^2}, \quad K = [r / a]_\times \]

    The axis r / a is shorter than one for small r, so the result is a rotation only up to about 1e-5, as in the
    authors' programs; `geometry.rotations.axis_angle_to_matrix` is the exact form.

    >>> correction_matrix(torch.zeros(3))
    tensor([[1., 0., 0.],
            [0., 1., 0.],
            [0., 0., 1.]])
    """
    angle = (ANGLE_OFFSET + axis_angle.square().sum(-1, keepdim=True)).sqrt()
    cross = cross_matrix(axis_angle / angle)
    angle = angle[..., None]
    identity = torch.eye(3, dtype=axis_angle.dtype, device=axis_angle.device)
    return identity + angle.sin() * cross + (1 - angle.cos()) * (cross @ cross)


class PoseCorrection(nn.Module):
    """R_j <- R_j dR_j for the joints 1..23, dR_j from a network conditioned on the pose (HumanNeRF Eq. 8).

    The network has 69 inputs, four hidden layers of 256 and 69 outputs (233,029 parameters). Its last layer starts at
    U(+-1e-5), so poses start nearly uncorrected.
    """

    def __init__(self, generator: torch.Generator | None = None) -> None:
        super().__init__()
        self.network = MLP(69, [256] * 4, 69, last_bound=1e-5, generator=generator)

    def forward(self, pose: Float[Tensor, "24 3"]) -> Float[Tensor, "24 3 3"]:
        """Rotation matrices of the corrected pose, for `joint_transforms_of_rotations`; the root's stays as it is.

        Args:
            pose: axis-angle, root first, radians.
        """
        corrections = correction_matrix(self.network(body_pose_condition(pose)[None]).unflatten(-1, (23, 3))[0])
        rotations = axis_angle_to_matrix(pose)
        return torch.cat([rotations[:1], rotations[1:] @ corrections])
