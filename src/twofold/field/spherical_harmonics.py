"""Real spherical harmonics of a direction, for networks that see the view."""

import torch
from jaxtyping import Float
from torch import Tensor


def spherical_harmonics(directions: Float[Tensor, "*b 3"]) -> Float[Tensor, "*b 16"]:
    r"""The 16 real spherical harmonics of degrees 0 to 3 ("degree 4" as encodings count), by degree, then order -l..l.

    \[ Y_l^m(d), \quad l = 0 \dots 3, \quad m = -l \dots l,
    \qquad \int Y_l^m Y_{l'}^{m'} \, \mathrm{d}\Omega = \delta_{ll'} \delta_{mm'} \]

    Orthonormal on the unit sphere, with the sign (-1)^m of Condon and Shortley, as instant NGP has it.

    >>> spherical_harmonics(torch.tensor([0.0, 0.0, 1.0]))[[0, 2, 6]]
    tensor([0.2821, 0.4886, 0.6308])

    Args:
        directions: unit length.
    """
    x, y, z = directions.unbind(-1)
    xx, yy, zz = x * x, y * y, z * z
    xy, yz, xz = x * y, y * z, x * z
    return torch.stack(
        [
            torch.full_like(x, 0.28209479177387814),
            -0.48860251190291987 * y,
            0.48860251190291987 * z,
            -0.48860251190291987 * x,
            1.0925484305920792 * xy,
            -1.0925484305920792 * yz,
            0.94617469575756008 * zz - 0.31539156525252005,
            -1.0925484305920792 * xz,
            0.54627421529603959 * (xx - yy),
            0.59004358992664352 * y * (yy - 3 * xx),
            2.8906114426405538 * xy * z,
            0.45704579946446572 * y * (1 - 5 * zz),
            0.3731763325901154 * z * (5 * zz - 3),
            0.45704579946446572 * x * (1 - 5 * zz),
            1.4453057213202769 * z * (xx - yy),
            0.59004358992664352 * x * (3 * yy - xx),
        ],
        -1,
    )
