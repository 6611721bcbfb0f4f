"""From posed to canonical space and back, by the skinning of the nearest body vertices."""

from typing import Any, Literal

import torch
from jaxtyping import Float, Int
from torch import Tensor

from twofold.body.blending import blend_transforms, move_points, weighted_transforms
from twofold.body.skeleton import PosedBody
from twofold.deform import skinning_kernels as kernels
from twofold.kernels.parallel import in_parts
from twofold.kernels.sparse_rows import scatter_rows, weighted_rows


def inverse_skinning(
    x_posed: Float[Tensor, "S 3"], weights: Float[Tensor, "S J"], bones: Float[Tensor, "J 4 4"]
) -> Float[Tensor, "S 3"]:
    r"""Moves points into canonical space: the inverse of linear blend skinning (Eq. 1).

    \[ x_c = \Big( \sum_{i=1}^{N_B} \omega_i B_i \Big)^{-1} x_o \]

    >>> bones = torch.eye(4).repeat(2, 1, 1)
    >>> bones[1, 0, 3] = 2.0  # the second bone stands two metres off
    >>> inverse_skinning(torch.tensor([[1.0, 0.0, 0.0]]), torch.tensor([[0.5, 0.5]]), bones)
    tensor([[0., 0., 0.]])

    Args:
        x_posed: points of observation space, metres.
        weights: skinning weights of each point, rows sum to 1.
        bones: canonical-to-posed transform of each joint.
    """
    return move_points(x_posed, invert_affine(weighted_transforms(weights, bones)))


def invert_affine(rows: Float[Tensor, "*b 3 4"]) -> Float[Tensor, "*b 3 4"]:
    r"""Inverse of affine maps given by their upper three rows, by the adjugate (no LAPACK call for each point).

    \[ (A \mid t)^{-1} = (A^{-1} \mid -A^{-1} t), \qquad
    A^{-1} = \frac{1}{a \cdot (b \times c)} \, (b \times c \mid c \times a \mid a \times b)
    \text{ with the rows } a, b, c \text{ of } A \]

    >>> invert_affine(torch.tensor([[2.0, 0, 0, 1], [0, 4, 0, 2], [0, 0, 1, 3]]))[:, [0, 3]]
    tensor([[ 0.5000, -0.5000],
            [ 0.0000, -0.5000],
            [ 0.0000, -3.0000]])
    """
    a, b, c = rows[..., 0, :3], rows[..., 1, :3], rows[..., 2, :3]
    bc, ca, ab = torch.linalg.cross(b, c), torch.linalg.cross(c, a), torch.linalg.cross(a, b)
    determinant = (a * bc).sum(-1, keepdim=True)
    linear = torch.stack([bc, ca, ab], -1) / determinant[..., None]
    return torch.cat([linear, -(linear @ rows[..., 3:])], -1)


def vertex_transforms(body: PosedBody) -> Float[Tensor, "V 3 4"]:
    r"""The blended transform of each vertex, $\sum_i w_{vi} B_i$, canonical to posed.

    >>> bones = torch.eye(4).repeat(24, 1, 1)
    >>> bones[1, 0, 3] = 2.0
    >>> weights = torch.zeros(1, 24)
    >>> weights[0, :2] = 0.5
    >>> point, joints = torch.zeros(1, 3), torch.zeros(24, 3)
    >>> body = PosedBody(point, point, torch.zeros(0, 3, dtype=torch.long), weights, bones, joints, joints)
    >>> vertex_transforms(body)[0, :, 3]  # half of the way
    tensor([1., 0., 0.])
    """
    return blend_transforms(body.weights, body.bones)


def neighbour_weights(squared_distances: Float[Tensor, "S K"]) -> Float[Tensor, "S K"]:
    r"""Weight of each of the K nearest vertices as Vid2Avatar defines it, for distances in the caller's unit.

    \[ \omega_k = \frac{e^{-\min(d_k^2, 4)}}{\sum_l e^{-\min(d_l^2, 4)}} \]

    >>> neighbour_weights(torch.tensor([[0.0, 0.6931]]))  # e to the minus ln 2 is a half
    tensor([[0.6667, 0.3333]])
    """
    return torch.softmax(-squared_distances.clamp_max(4.0), -1)


def smooth_neighbour_weights(squared_distances: Float[Tensor, "S K"]) -> Float[Tensor, "S K"]:
    r"""Weight of each of the K nearest vertices that falls to nothing at the last of them.

    \[ \omega_k \propto (1 - d_k^2 / d_K^2)^2 + 10^{-6} \]

    A vertex that comes among the nearest, or leaves them, does so with weight zero, so neighbouring points move alike.
    Points as far from all K take their mean.

    >>> smooth_neighbour_weights(torch.tensor([[0.0, 0.5, 1.0]]))
    tensor([[8.0000e-01, 2.0000e-01, 8.0000e-07]])
    """
    if _compiled(squared_distances):
        weights = torch.empty_like(squared_distances)
        given = (squared_distances.detach().contiguous().numpy(), weights.numpy())
        in_parts(len(weights), lambda begin, end: kernels.smooth_weights(*given, begin, end))
        return weights
    farthest = squared_distances.amax(-1, keepdim=True)
    raw = (1 - squared_distances / farthest.clamp_min(1e-12)).square() + 1e-6
    return raw / raw.sum(-1, keepdim=True)


def weights_by(
    falloff: Literal["exponential", "scene", "smooth"], squared_distances: Float[Tensor, "S K"], scale: float = 1.0
) -> Float[Tensor, "S K"]:
    r"""`neighbour_weights` of distances in metres ("exponential") or in scene units, or `smooth_neighbour_weights`.

    Scene units multiply distances: $d \to s \, d$ with the scale $s$.

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
    weights: Float[Tensor, "S K"],
    forward: Float[Tensor, "V 3 4"],
) -> tuple[Float[Tensor, "S 3"], Float[Tensor, "S 3 3"]]:
    r"""`inverse_skinning` with the weights of the nearest vertices, and the matrix for normals.

    \[ x_c = \Big( \sum_k \omega_k F_{v_k} \Big)^{-1} x_o, \qquad \nabla_{x_o} s = J^{-\top} \nabla_{x_c} s \]

    with the transforms $F_v$ of the vertices and the linear part $J$ of their blend.

    >>> forward = torch.tensor([[[2.0, 0, 0, 1], [0, 1, 0, 0], [0, 0, 1, 0]]])  # doubles x, then adds 1
    >>> x_c, turn = to_canonical(torch.tensor([[5.0, 0.0, 0.0]]), torch.tensor([[0]]), torch.ones(1, 1), forward)
    >>> x_c, turn[0].diagonal()
    (tensor([[2., 0., 0.]]), tensor([0.5000, 1.0000, 1.0000]))

    Blending vertices' weights is blending their transforms, so the K rows are mixed and inverted once. With one
    neighbour the transforms are inverted at the vertices instead, of which there are fewer than samples. Which vertices
    are nearest and their weights carry no gradient; the pose gets its gradient through `forward`.

    Args:
        x_posed: points of observation space, metres.
        nearest: their K nearest posed vertices.
        weights: weight of each of these.
        forward: `vertex_transforms` of the posed body.

    Returns:
        canonical points, and J^-T of the skinning: a canonical gradient times it is the gradient in observation space.
    """
    x_canonical, rows = map_to_canonical(x_posed, nearest, weights, forward)
    return x_canonical, rows[..., :3].transpose(-1, -2)


def map_to_canonical(
    x_posed: Float[Tensor, "S 3"],
    nearest: Int[Tensor, "S K"],
    weights: Float[Tensor, "S K"],
    forward: Float[Tensor, "V 3 4"],
) -> tuple[Float[Tensor, "S 3"], Float[Tensor, "S 3 4"]]:
    r"""Canonical points as `to_canonical` gives them, and each sample's whole posed-to-canonical transform.

    \[ x_c = (A \mid t) \, x_o, \qquad (A \mid t) = \Big( \sum_k \omega_k F_{v_k} \Big)^{-1} \]

    >>> forward = torch.tensor([[[2.0, 0, 0, 1], [0, 1, 0, 0], [0, 0, 1, 0]]])
    >>> x_c, inverse = map_to_canonical(torch.tensor([[5.0, 0.0, 0.0]]), torch.tensor([[0]]), torch.ones(1, 1), forward)
    >>> x_c, inverse[0, 0, [0, 3]]
    (tensor([[2., 0., 0.]]), tensor([ 0.5000, -0.5000]))
    """
    if _compiled(x_posed, weights, forward):
        x_canonical, rows = torch.empty_like(x_posed), torch.empty(len(x_posed), 3, 4)
        given = (t.detach().contiguous().numpy() for t in (x_posed, nearest, weights, forward))
        arrays = (*given, x_canonical.numpy(), rows.numpy())
        in_parts(len(x_posed), lambda begin, end: kernels.map_points(*arrays, begin, end))
        return x_canonical, rows
    rows = _inverse_rows(nearest, weights, forward)
    # A product of the whole batch with elementwise sums: batched 3x3 matrix products are slow on CPUs.
    return (rows[..., :3] * x_posed[:, None, :]).sum(-1) + rows[..., 3], rows


def _compiled(*tensors: Tensor) -> bool:
    """Whether the compiled form can be used: single precision on a CPU, without gradients."""
    wanted = torch.is_grad_enabled() and any(tensor.requires_grad for tensor in tensors)
    return not wanted and all(t.dtype == torch.float32 and not t.is_cuda and t.ndim > 1 for t in tensors)


class _WithPoseGradient(torch.autograd.Function):
    @staticmethod
    def forward(  # type: ignore[override]
        ctx: Any, forward: Tensor, x_canonical: Tensor, inverse: Tensor, nearest: Tensor, weights: Tensor
    ) -> tuple[Tensor, Tensor]:
        ctx.save_for_backward(x_canonical, inverse, nearest, weights)
        ctx.vertices = forward.shape[0]
        if _compiled(inverse):
            transposed = torch.empty(len(inverse), 3, 3)
            kernels.transposed_linear(inverse.contiguous().numpy(), transposed.numpy())
            return x_canonical.clone(), transposed
        return x_canonical.clone(), inverse[..., :3].transpose(-1, -2).contiguous()

    @staticmethod
    def backward(ctx: Any, by_x: Tensor, by_transposed: Tensor) -> tuple[Tensor | None, ...]:  # type: ignore[override]
        x_canonical, inverse, nearest, weights = ctx.saved_tensors
        given = (x_canonical, inverse, nearest, weights, by_x, by_transposed)
        if _compiled(x_canonical, inverse, weights, by_x, by_transposed):
            out = torch.zeros(ctx.vertices, 3, 4)
            kernels.map_points_backward(*(tensor.contiguous().numpy() for tensor in given), out.numpy())
            return out, None, None, None, None
        transposed = inverse[..., :3].transpose(-1, -2)
        # x_c = R^-1 (x_o - t):  d/dR = -(R^-T g) x_c^T,  d/dt = -R^-T g.
        pulled = (transposed * by_x[:, None, :]).sum(-1)
        by_rows = -pulled[:, :, None] * torch.cat([x_canonical, torch.ones_like(x_canonical[:, :1])], -1)[:, None, :]
        # The transform's inverse: d/dR = -R^-T G R^-T, with G the gradient by R^-1.
        by_rows[..., :3] -= transposed @ by_transposed.transpose(-1, -2) @ transposed
        summed = scatter_rows(by_rows.flatten(1), nearest, weights, ctx.vertices)
        return summed.unflatten(-1, (3, 4)), None, None, None, None


def with_pose_gradient(
    x_canonical: Float[Tensor, "S 3"],
    inverse: Float[Tensor, "S 3 4"],
    nearest: Int[Tensor, "S K"],
    weights: Float[Tensor, "S K"],
    forward: Float[Tensor, "V 3 4"],
) -> tuple[Float[Tensor, "S 3"], Float[Tensor, "S 3 3"]]:
    r"""What `to_canonical` returns, from results of `map_to_canonical` without gradients; differentiable by `forward`.

    \[ \frac{\partial L}{\partial t} = -A^{-\top} g, \qquad
    \frac{\partial L}{\partial A} = -A^{-\top} g \, x_c^\top - A^{-\top} G A^{-\top} \]

    with the blended transform $(A \mid t)$ and the gradients $g$ by $x_c$ and $G$ by $A^{-1}$.

    >>> forward = torch.tensor([[[2.0, 0, 0, 1], [0, 1, 0, 0], [0, 0, 1, 0]]]).requires_grad_()
    >>> vertex, one = torch.tensor([[0]]), torch.ones(1, 1)
    >>> x_c, inverse = map_to_canonical(torch.tensor([[5.0, 0.0, 0.0]]), vertex, one, forward.detach())
    >>> with_pose_gradient(x_c, inverse, vertex, one, forward)[0][0, 0].backward()
    >>> forward.grad[0, 0, [0, 3]]  # of (5 - t) / a at a = 2, t = 1
    tensor([-1.0000, -0.5000])

    Samplers map samples once to choose among them; nothing is computed again for the samples that are kept.

    Args:
        x_canonical: of the samples that are kept, metres.
        inverse: their posed-to-canonical transforms.
        nearest: their K nearest posed vertices.
        weights: weight of each of these.
        forward: `vertex_transforms` of the posed body, which both were computed from.
    """
    if not (torch.is_grad_enabled() and forward.requires_grad):
        return x_canonical, inverse[..., :3].transpose(-1, -2)
    return _WithPoseGradient.apply(forward, x_canonical, inverse, nearest, weights)  # type: ignore[return-value]


def normal_matrices(
    nearest: Int[Tensor, "S K"], weights: Float[Tensor, "S K"], forward: Float[Tensor, "V 3 4"]
) -> Float[Tensor, "S 3 3"]:
    r"""$J^{-\top}$ of `to_posed`: a canonical gradient times it is the gradient in observation space.

    \[ J = \Big[ \sum_k \omega_k F_{v_k} \Big]_{3 \times 3}, \qquad
    n = \frac{J^{-\top} \nabla_{x_c} s}{\lVert J^{-\top} \nabla_{x_c} s \rVert} \]

    >>> forward = torch.tensor([[[2.0, 0, 0, 1], [0, 1, 0, 0], [0, 0, 1, 0]]])
    >>> normal_matrices(torch.tensor([[0]]), torch.ones(1, 1), forward)[0].diagonal()
    tensor([0.5000, 1.0000, 1.0000])

    Args:
        nearest: the K nearest canonical vertices of canonical points. The release takes normals by these, though the
            posed vertex that carried a point into canonical space often is another one.
        weights: weight of each of these.
        forward: `vertex_transforms` of the posed body.
    """
    return _inverse_rows(nearest, weights, forward)[..., :3].transpose(-1, -2)


def _inverse_rows(nearest: Tensor, weights: Tensor, forward: Tensor) -> Tensor:
    """Inverse of the mixed transforms, [S 3 4]; with one neighbour inverted at the vertices, which are fewer."""
    if nearest.shape[1] == 1:
        return weighted_rows(invert_affine(forward).flatten(1), nearest, torch.ones_like(weights)).unflatten(-1, (3, 4))
    return invert_affine(weighted_rows(forward.flatten(1), nearest, weights).unflatten(-1, (3, 4)))


def to_posed(
    x_canonical: Float[Tensor, "S 3"],
    nearest: Int[Tensor, "S K"],
    weights: Float[Tensor, "S K"],
    forward: Float[Tensor, "V 3 4"],
) -> Float[Tensor, "S 3"]:
    r"""Forward skinning with the weights of the nearest canonical vertices.

    \[ x_o = \sum_k \omega_k F_{v_k} \, x_c \]

    >>> forward = torch.eye(3, 4).repeat(2, 1, 1)
    >>> forward[1, 0, 3] = 2.0
    >>> to_posed(torch.zeros(1, 3), torch.tensor([[0, 1]]), torch.tensor([[0.75, 0.25]]), forward)
    tensor([[0.5000, 0.0000, 0.0000]])

    Args:
        x_canonical: points of canonical space, metres.
        nearest: their K nearest canonical vertices.
        weights: weight of each of these.
        forward: `vertex_transforms` of the posed body.
    """
    rows = weighted_rows(forward.flatten(1), nearest, weights).unflatten(-1, (3, 4))
    return (rows[..., :3] * x_canonical[:, None, :]).sum(-1) + rows[..., 3]
