"""Where a body stands in the world: four conventions of data sets, brought to SMPL's own.

Let x be a point of the body whose root is not turned, and j the rest position of the root joint for its shape (it
depends on the betas and on the model file). The conventions place x at

- SMPL's own, which captures have: R (x - j) + j + t;
- about the model's origin (ZJU-MoCap, EasyMocap): R x + T;
- about the pelvis (HumanNeRF's files of videos): R (x - j) + T, so that T is where the pelvis is;
- scaled (Vid2Avatar at run time): s (R (x - j) + j + t).

Everything is computed in the precision that is given.
"""

from jaxtyping import Float
from torch import Tensor

from twofold.geometry.rotations import axis_angle_to_matrix, matrix_to_axis_angle


def from_model_origin(
    turn: Float[Tensor, "t 3"], shift: Float[Tensor, "t 3"], root: Float[Tensor, "t 3"], joint: Float[Tensor, "3"]
) -> tuple[Float[Tensor, "t 3"], Float[Tensor, "t 3"]]:
    """SMPL's root rotation (axis-angle, radians) and translation (metres) of a body placed by R x + T.

    Args:
        turn: `Rh`, axis-angle, radians.
        shift: `Th`, metres.
        root: the pose's own root rotation, about the joint, within `turn`; usually zero.
        joint: rest position of the root joint, metres.
    """
    rotation = axis_angle_to_matrix(turn)
    whole = matrix_to_axis_angle(rotation @ axis_angle_to_matrix(root))
    return whole, shift - joint + rotation @ joint


def to_model_origin(
    root: Float[Tensor, "t 3"], translation: Float[Tensor, "t 3"], joint: Float[Tensor, "3"]
) -> tuple[Float[Tensor, "t 3"], Float[Tensor, "t 3"]]:
    """`Rh` and `Th` of R x + T for a body in SMPL's own convention; the pose's root is zero then."""
    return root, translation + joint - axis_angle_to_matrix(root) @ joint


def from_pelvis(
    turn: Float[Tensor, "t 3"], shift: Float[Tensor, "t 3"], root: Float[Tensor, "t 3"], joint: Float[Tensor, "3"]
) -> tuple[Float[Tensor, "t 3"], Float[Tensor, "t 3"]]:
    """SMPL's root rotation and translation of a body placed by R (x - j) + T; see `from_model_origin`."""
    whole = matrix_to_axis_angle(axis_angle_to_matrix(turn) @ axis_angle_to_matrix(root))
    return whole, shift - joint


def to_pelvis(
    root: Float[Tensor, "t 3"], translation: Float[Tensor, "t 3"], joint: Float[Tensor, "3"]
) -> tuple[Float[Tensor, "t 3"], Float[Tensor, "t 3"]]:
    """`Rh` and `Th` of R (x - j) + T for a body in SMPL's own convention."""
    return root, translation + joint


def moved_world(
    rotation: Float[Tensor, "t 3 3"],
    shift: Float[Tensor, "t 3"],
    root: Float[Tensor, "t 3"],
    translation: Float[Tensor, "t 3"],
    joint: Float[Tensor, "3"],
) -> tuple[Float[Tensor, "t 3"], Float[Tensor, "t 3"]]:
    """SMPL's root rotation and translation in a world whose points X are now at `rotation` X + `shift`, frame by frame.

    That is how a moving camera, expressed by a moving world, becomes a body that moves before a camera at rest.
    """
    turned = matrix_to_axis_angle(rotation @ axis_angle_to_matrix(root))
    moved = (rotation @ (joint + translation)[..., None])[..., 0] + shift - joint
    return turned, moved


def as_rows(pose: Float[Tensor, "t 72"] | Float[Tensor, "t 24 3"]) -> Float[Tensor, "t 24 3"]:
    """Poses given flat or joint by joint, joint by joint."""
    return pose.reshape(len(pose), 24, 3)
