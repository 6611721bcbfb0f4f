"""Rotations: axis-angle vectors, matrices, and rigid transforms."""

import torch
from jaxtyping import Float
from torch import Tensor


def axis_angle_to_matrix(axis_angle: Float[Tensor, "*b 3"]) -> Float[Tensor, "*b 3 3"]:
    """Rodrigues' formula, differentiable everywhere, the identity included.

    Args:
        axis_angle: rotation axis times angle, radians.
    """
    squared = (axis_angle * axis_angle).sum(-1)
    small = squared < 1e-8
    angle = torch.where(small, torch.ones_like(squared), squared).sqrt()
    # Taylor series near zero keep both the value and its derivative finite.
    first = torch.where(small, 1 - squared / 6, angle.sin() / angle)
    # (1 - cos) / angle^2 without the cancellation that degrades its derivative in single precision.
    second = torch.where(small, 0.5, 2 * ((angle / 2).sin() / angle).square())
    cross = cross_matrix(axis_angle)
    identity = torch.eye(3, dtype=axis_angle.dtype, device=axis_angle.device)
    return identity + first[..., None, None] * cross + second[..., None, None] * (cross @ cross)


def cross_matrix(vector: Float[Tensor, "*b 3"]) -> Float[Tensor, "*b 3 3"]:
    """The matrix K with K u = vector x u."""
    x, y, z = vector.unbind(-1)
    zero = torch.zeros_like(x)
    return torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], -1).unflatten(-1, (3, 3))


def matrix_to_axis_angle(matrix: Float[Tensor, "*b 3 3"]) -> Float[Tensor, "*b 3"]:
    """The logarithm of a rotation; angles in [0, pi]. Goes through the unit quaternion, stable at 0 and pi."""
    m00, m01, m02, m10, m11, m12, m20, m21, m22 = matrix.flatten(-2).unbind(-1)
    trace = m00 + m11 + m22
    x, y, z = m21 - m12, m02 - m20, m10 - m01
    xy, xz, yz = m01 + m10, m02 + m20, m12 + m21
    # Each row is the quaternion (w, x, y, z) scaled by its own largest entry; the best-conditioned row is taken.
    rows = (
        (1 + trace, x, y, z),
        (x, 1 + 2 * m00 - trace, xy, xz),
        (y, xy, 1 + 2 * m11 - trace, yz),
        (z, xz, yz, 1 + 2 * m22 - trace),
    )
    candidates = torch.stack([torch.stack(row, -1) for row in rows], -2)
    best = candidates.diagonal(dim1=-2, dim2=-1).argmax(-1)
    quaternion = torch.take_along_dim(candidates, best[..., None, None], dim=-2).squeeze(-2)
    quaternion = quaternion / quaternion.norm(dim=-1, keepdim=True)
    quaternion = torch.where(quaternion[..., :1] < 0, -quaternion, quaternion)
    sine = quaternion[..., 1:].norm(dim=-1, keepdim=True)
    angle = 2 * torch.atan2(sine, quaternion[..., :1])
    scale = torch.where(sine > 1e-7, angle / sine.clamp_min(1e-7), torch.full_like(sine, 2.0))
    return quaternion[..., 1:] * scale


def shortest_turn(start: Float[Tensor, "*b 3"], end: Float[Tensor, "*b 3"]) -> Float[Tensor, "*b 3 3"]:
    """The smallest rotation from one direction to another (of any length, not opposite).

    >>> turn = shortest_turn(torch.tensor([1.0, 0, 0]), torch.tensor([0.0, 2, 0]))
    >>> (turn @ torch.tensor([1.0, 0, 0])).abs().round(decimals=6).tolist()
    [0.0, 1.0, 0.0]
    """
    a, b = torch.nn.functional.normalize(start, dim=-1), torch.nn.functional.normalize(end, dim=-1)
    axis = torch.linalg.cross(a, b, dim=-1)
    sine = axis.norm(dim=-1, keepdim=True)
    angle = torch.atan2(sine, (a * b).sum(-1, keepdim=True))
    return axis_angle_to_matrix(axis / sine.clamp_min(1e-12) * angle)


def rigid_transform(rotation: Float[Tensor, "*b 3 3"], translation: Float[Tensor, "*b 3"]) -> Float[Tensor, "*b 4 4"]:
    """The 4x4 matrix [R t; 0 1]."""
    top = torch.cat([rotation, translation[..., None]], -1)
    bottom = torch.zeros_like(top[..., :1, :])
    bottom[..., 3] = 1
    return torch.cat([top, bottom], -2)


def rigid_inverse(transform: Float[Tensor, "*b 4 4"]) -> Float[Tensor, "*b 4 4"]:
    """Inverse of a rotation followed by a translation (not of a general matrix)."""
    rotation = transform[..., :3, :3].transpose(-1, -2)
    return rigid_transform(rotation, -(rotation @ transform[..., :3, 3:])[..., 0])
