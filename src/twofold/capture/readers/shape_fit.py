"""Shape coefficients of SMPL from rest joints, where a data set stores nothing else."""

import torch
from jaxtyping import Float
from torch import Tensor

from twofold.body.skeleton import Body
from twofold.errors import TwofoldError

_OTHER_BODY = 0.01
"""Metres: rest joints that no shape of the body comes closer to belong to another body."""


def fit_betas(body: Body, rest: Float[Tensor, "24 3"], where: object) -> Float[Tensor, "S"]:
    """Betas whose rest joints are these, by least squares on differences to the pelvis.

    Args:
        body: the model.
        rest: rest joints, metres; where the pelvis is does not matter.
        where: they come from, for the sentence.

    Raises:
        TwofoldError: no shape of this body has these joints.
    """
    basis = body.joint_basis.double()
    directions = (basis - basis[:1]).flatten(0, 1)
    wanted = _from_pelvis(rest.double()) - _from_pelvis(body.joints.double())
    betas = torch.linalg.lstsq(directions, wanted.flatten()[:, None], driver="gelsd").solution[:, 0]
    require_joints(body, betas, rest, where)
    return betas


def require_joints(body: Body, betas: Float[Tensor, "S"], rest: Float[Tensor, "24 3"], where: object) -> None:
    """Refuses a body whose shape does not have these rest joints.

    Raises:
        TwofoldError: a joint is more than a centimetre off.
    """
    joints = body.joints.double() + body.joint_basis.double()[..., : len(betas)] @ betas.double()
    off = float((_from_pelvis(joints) - _from_pelvis(rest.double())).norm(dim=-1).max())
    if off > _OTHER_BODY:
        raise TwofoldError(
            f"The rest joints in {where} differ from every shape of the body by {100 * off:.1f} cm; name the SMPL file "
            "that they were made with by --body (of ZJU-MoCap the neutral one)."
        )


def _from_pelvis(joints: Float[Tensor, "24 3"]) -> Float[Tensor, "24 3"]:
    return joints - joints[:1]
