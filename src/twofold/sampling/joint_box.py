"""The box around the joints, where the release's rays begin and end."""

import torch
from jaxtyping import Float
from torch import Tensor

RELEASED_MARGIN = 0.3
"""How far the box of the joints reaches beyond them in the release, metres."""
RELEASED_SLACK = 0.01
"""What it is enlarged by after that, scene units."""


def joint_box(joints: Float[Tensor, "J 3"], scale: float = 1.0) -> Float[Tensor, "2 3"]:
    r"""Lower and upper corner of the axis-aligned box around joints, without gradients.

    \[ [\min_j J_j - m, \; \max_j J_j + m], \qquad m = 0.3 + 0.01 / s \]

    >>> joint_box(torch.zeros(24, 3), scale=0.5)
    tensor([[-0.3200, -0.3200, -0.3200],
            [ 0.3200,  0.3200,  0.3200]])

    Args:
        joints: metres.
        scale: scene units to a metre.
    """
    margin = RELEASED_MARGIN + RELEASED_SLACK / scale
    return torch.stack([joints.detach().amin(0) - margin, joints.detach().amax(0) + margin])
