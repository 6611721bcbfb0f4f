"""Which changes of a pose the training cameras see, so that pose refinement leaves the others as they came.

One camera does not see a limb that swings towards it. Where several cameras have agreed on a pose, training on one of
them has no evidence about that direction; the correction is projected onto what is observed.
"""

import torch
from jaxtyping import Float
from torch import Tensor

from twofold.body.skeleton import JOINT_NAMES, PARENTS, ShapedBody, joint_transforms
from twofold.geometry.rotations import cross_matrix

MIN_SEEN = 0.45
"""Least share of a motion that cameras have to see: of what is kept, little more goes in depth than across."""
NEUTRAL = 0.1
"""Motions this much smaller than usual (squared) count as half seen."""
_REACH = 0.05
"""Metres: around each joint stand points this far off along the axes, so that a twist moves something."""


def left_jacobian(rotation: Float[Tensor, "*b 3"]) -> Float[Tensor, "*b 3 3"]:
    r"""How exp of an axis-angle vector turns when the vector changes, with a its length and K its cross matrix.

    \[ J = I + \frac{1 - \cos a}{a^2} K + \frac{a - \sin a}{a^3} K^2, \qquad
    \exp(r + \delta) \approx \exp(J \delta) \exp(r) \]

    >>> left_jacobian(torch.zeros(3)).diagonal()
    tensor([1., 1., 1.])
    """
    angle = rotation.norm(dim=-1)[..., None, None].clamp_min(1e-6)
    cross = cross_matrix(rotation)
    identity = torch.eye(3, dtype=rotation.dtype, device=rotation.device)
    first = torch.where(angle < 1e-3, torch.full_like(angle, 0.5), (1 - angle.cos()) / angle**2)
    second = torch.where(angle < 1e-3, torch.full_like(angle, 1 / 6), (angle - angle.sin()) / angle**3)
    return identity + first * cross + second * cross @ cross


def pose_jacobian(
    shaped: ShapedBody, pose: Float[Tensor, "24 3"], translation: Float[Tensor, "3"]
) -> tuple[Float[Tensor, "n 3"], Float[Tensor, "n 3 75"]]:
    r"""Points about the joints, world, metres, and how they move with the pose's 72 numbers and the translation.

    For a point x that a joint k or one below it carries,

    \[ \frac{\partial x}{\partial \theta_{k}} = -[x - x_k]_\times \, R_{\mathrm{parent}(k)} \, J(\theta_k) \]

    with the joint's position x_k, the rotation R of the joint above it, and `left_jacobian` J.

    >>> joints = torch.arange(72.0).reshape(24, 3) / 72
    >>> shaped = ShapedBody(joints, joints, torch.zeros(0, 3).long(), torch.eye(24), torch.zeros(24, 3, 0))
    >>> points, moves = pose_jacobian(shaped, torch.zeros(24, 3), torch.zeros(3))
    >>> points.shape, moves.shape, moves[0, :, 72:].diagonal().tolist()
    (torch.Size([168, 3]), torch.Size([168, 3, 75]), [1.0, 1.0, 1.0])
    """
    transforms = joint_transforms(shaped.joints, pose, translation)
    positions = (transforms[:, :3, :3] @ shaped.joints[:, :, None])[..., 0] + transforms[:, :3, 3]
    offsets = _REACH * torch.cat([torch.zeros(1, 3), torch.eye(3), -torch.eye(3)]).to(pose)
    points = positions[:, None] + (transforms[:, None, :3, :3] @ offsets[..., None])[..., 0]
    above = torch.stack([transforms[max(p, 0), :3, :3] if p >= 0 else torch.eye(3).to(pose) for p in PARENTS])
    turning = above @ left_jacobian(pose)
    arms = points[:, :, None] - positions
    moves = -cross_matrix(arms) @ turning
    carried = _carried().to(pose)[:, None, :, None, None]
    by_pose = (moves * carried).transpose(2, 3).flatten(3).flatten(0, 1)
    by_shift = torch.eye(3).to(pose).expand(len(by_pose), 3, 3)
    return points.flatten(0, 1), torch.cat([by_pose, by_shift], -1)


def _carried() -> Float[Tensor, "24 24"]:
    """1 where the joint of a row moves with the joint of a column."""
    below = torch.zeros(len(JOINT_NAMES), len(JOINT_NAMES))
    for joint in range(len(JOINT_NAMES)):
        ancestor = joint
        while ancestor >= 0:
            below[joint, ancestor] = 1
            ancestor = PARENTS[ancestor]
    return below


def observed_projection(
    points: Float[Tensor, "n 3"], moves: Float[Tensor, "n 3 p"], centers: Float[Tensor, "c 3"]
) -> Float[Tensor, "p p"]:
    r"""The projection of a pose's change onto the directions that cameras see.

    With G all displacements of the points and V their parts across the cameras' rays, the generalised eigenvectors of

    \[ \big( V^T V + \tfrac{1}{2} \epsilon I \big) u = \mu \, \big( G^T G + \epsilon I \big) u \]

    are motions of which the share mu is seen (up to 1 by one camera); epsilon keeps what hardly moves anything apart
    from what does. Those with mu below `MIN_SEEN` are removed, orthogonally in the metric on the right.

    Args:
        points: of the body, world, metres.
        moves: their displacements by each of the pose's numbers.
        centers: of the training cameras that took this frame.

    A point that moves along x, or along z away from the only camera:

    >>> moves = torch.tensor([[[1.0, 0.0], [0.0, 0.0], [0.0, 1.0]]])
    >>> observed_projection(torch.tensor([[0.0, 0.0, 3.0]]), moves, torch.zeros(1, 3)).abs().round().tolist()
    [[1.0, 0.0], [0.0, 0.0]]
    """
    moves, points, centers = moves.double(), points.double(), centers.double()
    every = moves.flatten(0, 1)
    metric = every.T @ every
    slack = NEUTRAL * metric.diagonal().mean() * torch.eye(len(metric)).to(metric)
    rays = torch.nn.functional.normalize(points[None] - centers[:, None], dim=-1)
    across = moves[None] - rays[..., None] * (rays[:, :, None] @ moves[None])
    across = across.flatten(0, 2)
    factor = torch.linalg.cholesky(metric + slack)
    half = torch.linalg.solve_triangular(factor, across.T @ across + 0.5 * slack, upper=False)
    fractions, vectors = torch.linalg.eigh(torch.linalg.solve_triangular(factor, half.T, upper=False))
    seen = vectors[:, fractions >= MIN_SEEN]
    return torch.linalg.solve_triangular(factor.T, seen @ (seen.T @ factor.T), upper=True)
