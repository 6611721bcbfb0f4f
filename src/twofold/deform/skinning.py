"""From posed to canonical space and back, by the skinning of the nearest body vertices."""

from typing import Literal

import torch
from jaxtyping import Float, Int
from torch import Tensor

from twofold.body.skeleton import PosedBody
from twofold.kernels.sparse_rows import weighted_rows


def inverse_skinning(
    x_posed: Float[Tensor, "S 3"], weights: Float[Tensor, "S J"], bones: Float[Tensor, "J 4 4"]
) -> Float[Tensor, "S 3"]:
    """Carries points home: x_c = (sum_i w_i B_i)^-1 x_o (Eq. 1).

    Args:
        x_posed: points of observation space, metres.
        weights: skinning weights of each point, rows sum to 1.
        bones: canonical-to-posed transform of each joint.
    """
    rows = (weights @ bones[:, :3].flatten(1)).unflatten(-1, (3, 4))
    inverse = invert_affine(rows)
    return (inverse[..., :3] @ x_posed[..., None])[..., 0] + inverse[..., 3]


def invert_affine(rows: Float[Tensor, "*b 3 4"]) -> Float[Tensor, "*b 3 4"]:
    """Inverse of affine maps given by their upper three rows, by the adjugate (no LAPACK call for each point)."""
    a, b, c = rows[..., 0, :3], rows[..., 1, :3], rows[..., 2, :3]
    bc, ca, ab = torch.linalg.cross(b, c), torch.linalg.cross(c, a), torch.linalg.cross(a, b)
    determinant = (a * bc).sum(-1, keepdim=True)
    linear = torch.stack([bc, ca, ab], -1) / determinant[..., None]
    return torch.cat([linear, -(linear @ rows[..., 3:])], -1)


def vertex_transforms(body: PosedBody) -> Float[Tensor, "V 3 4"]:
    """sum_i w_i B_i at each vertex of the body, canonical to posed."""
    return (body.weights @ body.bones[:, :3].flatten(1)).unflatten(-1, (3, 4))


def neighbour_weights(squared_distances: Float[Tensor, "S K"]) -> Float[Tensor, "S K"]:
    """Share of each of the K nearest vertices as Vid2Avatar defines it: exp(-min(d^2, 4)), d in metres, normalised."""
    return torch.softmax(-squared_distances.clamp_max(4.0), -1)


def smooth_neighbour_weights(squared_distances: Float[Tensor, "S K"]) -> Float[Tensor, "S K"]:
    """Share of each of the K nearest vertices, (1 - d^2 / d_K^2)^2 normalised, so that the last one counts nothing.

    A vertex that comes among the nearest, or leaves them, does so with weight zero, so neighbouring points are carried
    alike. Points as far from all K take their mean.
    """
    farthest = squared_distances.amax(-1, keepdim=True)
    raw = (1 - squared_distances / farthest.clamp_min(1e-12)).square() + 1e-6
    return raw / raw.sum(-1, keepdim=True)


def weights_by(
    falloff: Literal["exponential", "scene", "smooth"], squared_distances: Float[Tensor, "S K"], scale: float = 1.0
) -> Float[Tensor, "S K"]:
    """`neighbour_weights` of distances in metres ("exponential") or in scene units, or `smooth_neighbour_weights`.

    >>> weights_by("scene", torch.tensor([[0.0, 0.01]]), scale=10.0)  # 1 m is 10 units, so 10 cm are one
    tensor([[0.7311, 0.2689]])

    Args:
        falloff: which.
        squared_distances: metres squared.
        scale: scene units to a metre.
    """
    if falloff == "smooth":
        return smooth_neighbour_weights(squared_distances)
    return neighbour_weights(squared_distances * scale**2 if falloff == "scene" else squared_distances)


def to_canonical(
    x_posed: Float[Tensor, "S 3"],
    nearest: Int[Tensor, "S K"],
    shares: Float[Tensor, "S K"],
    forward: Float[Tensor, "V 3 4"],
) -> tuple[Float[Tensor, "S 3"], Float[Tensor, "S 3 3"]]:
    """`inverse_skinning` with the weights of the nearest vertices, and the matrix for normals.

    Blending vertices' weights is blending their transforms, so the K rows are mixed and inverted once. With one
    neighbour the transforms are inverted at the vertices instead, of which there are fewer than samples. Which vertices
    are nearest and their shares carry no gradient; the pose gets its gradient through `forward`.

    Args:
        x_posed: points of observation space, metres.
        nearest: their K nearest posed vertices.
        shares: weight of each of these.
        forward: `vertex_transforms` of the posed body.

    Returns:
        canonical points, and J^-T of the skinning: a canonical gradient times it is the gradient in observation space.
    """
    rows = _inverse_rows(nearest, shares, forward)
    # A product of the whole batch with elementwise sums: batched 3x3 matrix products are slow on CPUs.
    x_canonical = (rows[..., :3] * x_posed[:, None, :]).sum(-1) + rows[..., 3]
    return x_canonical, rows[..., :3].transpose(-1, -2)


def normal_matrices(
    nearest: Int[Tensor, "S K"], shares: Float[Tensor, "S K"], forward: Float[Tensor, "V 3 4"]
) -> Float[Tensor, "S 3 3"]:
    """J^-T of `to_posed`: a canonical gradient times it is the gradient in observation space.

    Args:
        nearest: the K nearest canonical vertices of canonical points. The release takes normals by these, though the
            posed vertex that carried a point into canonical space often is another one.
        shares: weight of each of these.
        forward: `vertex_transforms` of the posed body.
    """
    return _inverse_rows(nearest, shares, forward)[..., :3].transpose(-1, -2)


def _inverse_rows(nearest: Tensor, shares: Tensor, forward: Tensor) -> Tensor:
    """Inverse of the mixed transforms, [S 3 4]; with one neighbour inverted at the vertices, which are fewer."""
    if nearest.shape[1] == 1:
        return weighted_rows(invert_affine(forward).flatten(1), nearest, torch.ones_like(shares)).unflatten(-1, (3, 4))
    return invert_affine(weighted_rows(forward.flatten(1), nearest, shares).unflatten(-1, (3, 4)))


def to_posed(
    x_canonical: Float[Tensor, "S 3"],
    nearest: Int[Tensor, "S K"],
    shares: Float[Tensor, "S K"],
    forward: Float[Tensor, "V 3 4"],
) -> Float[Tensor, "S 3"]:
    """Forward skinning with the weights of the nearest canonical vertices."""
    rows = weighted_rows(forward.flatten(1), nearest, shares).unflatten(-1, (3, 4))
    return (rows[..., :3] * x_canonical[:, None, :]).sum(-1) + rows[..., 3]
