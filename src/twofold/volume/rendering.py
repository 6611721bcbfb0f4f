"""From signed distances to pixels: density, packed samples, compositing."""

from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor
from torch.autograd.function import once_differentiable

from twofold.volume import rendering_kernels as kernels
from twofold.volume.samples import Samples


def laplace_density(sdf: Float[Tensor, "*b"], beta: Float[Tensor, ""]) -> Float[Tensor, "*b"]:
    r"""Volume density of a signed distance (Eq. 7): the Laplace distribution's CDF of -sdf, over its scale.

    \[ \sigma(s) = \frac{1}{\beta} \Psi_\beta(-s), \qquad
    \Psi_\beta(-s) = \begin{cases} \frac12 e^{-s/\beta} & s > 0 \\ 1 - \frac12 e^{s/\beta} & s \le 0 \end{cases} \]

    >>> laplace_density(torch.tensor([-1.0, 0.0, 1.0]), torch.tensor(0.1))
    tensor([9.9998e+00, 5.0000e+00, 2.2700e-04])

    Args:
        sdf: metres, negative inside.
        beta: scale of the distribution, metres, positive.

    Returns:
        density per metre, between 0 far outside and 1 / beta deep inside.
    """
    tail = 0.5 * torch.exp(-sdf.abs() / beta)
    return torch.where(sdf > 0, tail, 1 - tail) / beta


def composite_weights(density: Float[Tensor, "S"], samples: Samples) -> Float[Tensor, "S"]:
    r"""What each sample adds to its ray; a ray's weights sum to at most one.

    \[ w_i = T_i \, (1 - e^{-\sigma_i \delta_i}), \qquad T_i = \exp\Big(-\sum_{j<i} \sigma_j \delta_j\Big) \]

    Half of the light passes an interval whose density times length is ln 2:

    >>> samples = Samples(torch.tensor([0, 0, 1]), torch.tensor([1.0, 2.0, 1.0]), torch.ones(3))
    >>> composite_weights(torch.full((3,), 0.693147), samples)
    tensor([0.5000, 0.2500, 0.5000])

    Args:
        density: per metre (in the unit of the samples' lengths).
        samples: packed.
    """
    optical = density * samples.delta
    wanted = torch.is_grad_enabled() and optical.requires_grad
    if wanted or optical.is_cuda or optical.dtype != torch.float32:
        return torch.exp(-optical_depth(optical, samples)) * -torch.expm1(-optical)
    out = torch.empty_like(optical)
    kernels.weights(optical.contiguous().numpy(), samples.ray_index.contiguous().numpy(), out.numpy())
    return out


def optical_depth(optical: Float[Tensor, "S"], samples: Samples) -> Float[Tensor, "S"]:
    r"""Sum of sigma_j delta_j over the samples j before each one on its ray.

    \[ \tau_i = \sum_{j<i} \sigma_j \delta_j \]

    >>> samples = Samples(torch.tensor([0, 0, 0, 1, 1]), torch.arange(5.0), torch.ones(5))
    >>> optical_depth(torch.tensor([1.0, 2.0, 4.0, 8.0, 16.0]), samples)
    tensor([0., 1., 3., 0., 8.])
    """
    # One running sum over all rays would lose digits in float32; what a ray starts with is taken off again.
    total = torch.cumsum(optical.double(), 0)
    before = total - optical
    first = torch.ones_like(samples.ray_index, dtype=torch.bool)
    first[1:] = samples.ray_index[1:] != samples.ray_index[:-1]
    start = torch.cummax(torch.where(first, torch.arange(len(samples), device=first.device), 0), 0).values
    return (before - before[start]).to(optical.dtype)


def composite(
    weights: Float[Tensor, "S"], values: Float[Tensor, "S C"], samples: Samples, rays: int
) -> Float[Tensor, "rays C"]:
    r"""Sum of weighted values along each ray (Eq. 8); a ray without samples gets zero.

    \[ \hat C(r) = \sum_i T_i \, (1 - e^{-\sigma_i \delta_i}) \, c_i = \sum_i w_i c_i \]

    >>> samples = Samples(torch.tensor([0, 0, 2]), torch.tensor([1.0, 2.0, 1.0]), torch.ones(3))
    >>> composite(torch.tensor([0.5, 0.25, 1.0]), torch.tensor([[1.0], [0.4], [0.2]]), samples, rays=3)
    tensor([[0.6000],
            [0.0000],
            [0.2000]])

    Args:
        weights: from `composite_weights`.
        values: of each sample: colours, or ones for the opacity, or depths.
        samples: packed.
        rays: how many there are.
    """
    out = torch.zeros(rays, values.shape[-1], dtype=values.dtype, device=values.device)
    return out.index_add(0, samples.ray_index, weights[:, None] * values)


def composite_surface(
    sdf: Float[Tensor, "S"], beta: Float[Tensor, ""], color: Float[Tensor, "S 3"], normals: Float[Tensor, "S 3"],
    samples: Samples, rays: int,
) -> Float[Tensor, "rays 8"]:  # fmt: skip
    r"""Colour, opacity, depth and normal of each ray: `laplace_density`, `composite_weights` and `composite` in one.

    \[ \big( \hat C, \hat A, \hat D, \hat N \big)(r) = \sum_i w_i \, (c_i, 1, t_i, n_i), \qquad
    w_i = e^{-\sum_{j<i} \sigma(s_j) \delta_j} \, (1 - e^{-\sigma(s_i) \delta_i}) \]

    Differentiable by distances, colours and scale; normals count as constants. On CPUs in single precision it is one
    compiled loop with a reverse pass written by hand.

    >>> samples = Samples(torch.tensor([0, 0]), torch.tensor([1.0, 2.0]), torch.ones(2))
    >>> red, up = torch.tensor([[1.0, 0.0, 0.0]] * 2), torch.tensor([[0.0, 1.0, 0.0]] * 2)
    >>> composite_surface(torch.zeros(2), torch.tensor(0.721348), red, up, samples, rays=1)  # each lets half through
    tensor([[0.7500, 0.0000, 0.0000, 0.7500, 1.0000, 0.0000, 0.7500, 0.0000]])

    Args:
        sdf: signed distance of each sample, in the unit of `beta`.
        beta: scale of the density.
        color: of each sample.
        normals: of each sample.
        samples: packed, lengths in the unit of `beta`.
        rays: how many there are.
    """
    normals = normals.detach()
    if sdf.dtype == torch.float32 and not sdf.is_cuda:
        if len(samples) and int(samples.ray_index[-1]) >= rays:
            raise ValueError(f"samples are of {rays} rays, the last one is of ray {int(samples.ray_index[-1])}")
        given = samples.depth, samples.delta, samples.ray_index, rays
        return _Surface.apply(sdf, beta, color, normals, *given)  # type: ignore[return-value]
    weights = composite_weights(laplace_density(sdf, beta), samples)
    values = torch.cat([color, torch.ones_like(sdf)[:, None], samples.depth[:, None], normals], -1)
    return composite(weights, values, samples, rays)


class _Surface(torch.autograd.Function):
    @staticmethod
    def forward(  # type: ignore[override]
        ctx: Any, sdf: Tensor, beta: Tensor, color: Tensor, normals: Tensor, depth: Tensor, delta: Tensor,
        ray_index: Tensor, rays: int,
    ) -> Tensor:  # fmt: skip
        given = tuple(t.detach().contiguous() for t in (sdf, color, normals, depth, delta, ray_index))
        weight, optical, out = torch.empty_like(given[0]), torch.empty_like(given[0]), torch.zeros(rays, 8)
        sdf_, *rest = (tensor.numpy() for tensor in given)
        kernels.surface(sdf_, np.float32(beta), *rest, weight.numpy(), optical.numpy(), out.numpy())
        ctx.save_for_backward(*given, beta, weight, optical)
        return out

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, by_out: Tensor) -> tuple[Tensor | None, ...]:  # type: ignore[override]
        *given, beta, weight, optical = ctx.saved_tensors
        sdf, *rest = (tensor.numpy() for tensor in given)
        by_sdf, by_color = torch.empty_like(given[0]), torch.empty_like(given[1])
        more = (weight.numpy(), optical.numpy(), by_out.contiguous().numpy(), by_sdf.numpy(), by_color.numpy())
        by_beta = kernels.surface_backward(sdf, np.float32(beta.detach()), *rest, *more)
        return by_sdf, beta.new_tensor(by_beta), by_color, None, None, None, None, None
