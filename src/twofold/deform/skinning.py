"""From posed to canonical space and back, by the skinning of the nearest body vertices."""

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
    if nearest.shape[1] == 1:
        rows = weighted_rows(invert_affine(forward).flatten(1), nearest, torch.ones_like(shares)).unflatten(-1, (3, 4))
    else:
        rows = invert_affine(weighted_rows(forward.flatten(1), nearest, shares).unflatten(-1, (3, 4)))
    # A product of the whole batch with elementwise sums: batched 3x3 matrix products are slow on CPUs.
    x_canonical = (rows[..., :3] * x_posed[:, None, :]).sum(-1) + rows[..., 3]
    return x_canonical, rows[..., :3].transpose(-1, -2)


def to_posed(
    x_canonical: Float[Tensor, "S 3"],
    nearest: Int[Tensor, "S K"],
    shares: Float[Tensor, "S K"],
    forward: Float[Tensor, "V 3 4"],
) -> Float[Tensor, "S 3"]:
    """Forward skinning with the weights of the nearest canonical vertices."""
    rows = weighted_rows(forward.flatten(1), nearest, shares).unflatten(-1, (3, 4))
    return (rows[..., :3] * x_canonical[:, None, :]).sum(-1) + rows[..., 3]
