"""Transforms blended by skinning weights, of which few are not zero: on CPUs only these are looked at."""

import contextlib
from collections.abc import Generator
from contextvars import ContextVar
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor
from torch.autograd.function import once_differentiable
from torch.utils.weak import WeakTensorKeyDictionary

from twofold.body import blending_kernels as kernels

_PLAIN: ContextVar[bool] = ContextVar("_PLAIN", default=False)
_Entries = tuple[np.ndarray, np.ndarray, np.ndarray]
_known: "WeakTensorKeyDictionary" = WeakTensorKeyDictionary()
"""The entries of weights that are in use, and which version of these they are of: a body has the same in every step."""


@contextlib.contextmanager
def in_pytorch() -> Generator[None]:
    """While the block lasts, bodies are posed without compiled loops, which round otherwise."""
    token = _PLAIN.set(True)
    try:
        yield
    finally:
        _PLAIN.reset(token)


def has_kernel(*tensors: Tensor) -> bool:
    """Whether compiled loops are used: in single precision on a CPU, with nothing like `torch.vmap`."""
    if torch.compiler.is_compiling() or torch._C._are_functorch_transforms_active():  # pyright: ignore[reportPrivateUsage]
        return False
    return not _PLAIN.get() and all(t.dtype == torch.float32 and t.device.type == "cpu" for t in tensors)


def blend_transforms(weights: Float[Tensor, "n J"], transforms: Float[Tensor, "J 4 4"]) -> Float[Tensor, "n 3 4"]:
    r"""The upper three rows of the weighted mean of transforms, $\sum_j w_{vj} B_j$.

    Differentiable once where `has_kernel` says so and the weights do not learn, else as often as one likes.

    >>> shifts = torch.eye(4).repeat(2, 1, 1)
    >>> shifts[1, 0, 3] = 2.0
    >>> blend_transforms(torch.tensor([[0.25, 0.75]]), shifts)[0, :, 3]
    tensor([1.5000, 0.0000, 0.0000])

    Args:
        weights: rows sum to 1.
        transforms: affine.
    """
    if has_kernel(weights, transforms) and not weights.requires_grad:
        return _Blend.apply(weights, transforms)  # type: ignore[return-value]
    return weighted_transforms(weights, transforms)


def weighted_transforms(weights: Float[Tensor, "*b J"], transforms: Float[Tensor, "J 4 4"]) -> Float[Tensor, "*b 3 4"]:
    """What `blend_transforms` gives, as one product in PyTorch for any device, precision and number of derivatives."""
    return (weights @ transforms[:, :3].flatten(1)).unflatten(-1, (3, 4))


def skin_vertices(
    points: Float[Tensor, "n 3"], weights: Float[Tensor, "n J"], transforms: Float[Tensor, "J 4 4"]
) -> Float[Tensor, "n 3"]:
    """`skin` of a body, metres, with compiled loops in the same cases as `blend_transforms`."""
    if has_kernel(points, weights, transforms) and not weights.requires_grad:
        return _Skin.apply(points, weights, transforms)  # type: ignore[return-value]
    return move_points(points, blend_transforms(weights, transforms))


def move_points(points: Float[Tensor, "*b 3"], transforms: Float[Tensor, "*b 3 4"]) -> Float[Tensor, "*b 3"]:
    """Each point moved by the transform of which it has the upper rows."""
    return (transforms[..., :3] @ points[..., None])[..., 0] + transforms[..., 3]


def _entries(weights: Tensor) -> _Entries:
    """Weights [n J] as `compress` lists them; worked out once for each tensor, and anew where it was changed."""
    if weights.is_inference():  # Nothing tells whether such a tensor was changed.
        return _compressed(weights)
    found = _known.get(weights)
    if found is None or found[0] != weights._version:
        found = _known[weights] = (weights._version, _compressed(weights))
    return found[1]


def _compressed(weights: Tensor) -> _Entries:
    start = np.empty(len(weights) + 1, np.int64)
    joint, value = np.empty(weights.numel(), np.int64), np.empty(weights.numel(), np.float32)
    count = kernels.compress(weights.detach().contiguous().numpy(), start, joint, value)
    return start, joint[:count].copy(), value[:count].copy()


class _Blend(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, weights: Tensor, transforms: Tensor) -> Tensor:  # type: ignore[override]
        ctx.entries, ctx.joints = _entries(weights), len(transforms)
        out = torch.empty(len(weights), 3, 4)
        kernels.blend(*ctx.entries, transforms.detach().contiguous().numpy(), out.numpy())
        return out

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, by_blended: Tensor) -> tuple[None, Tensor]:  # type: ignore[override]
        out = torch.empty(ctx.joints, 4, 4)
        kernels.blend_backward(*ctx.entries, by_blended.detach().contiguous().numpy(), out.numpy())
        return None, out


class _Skin(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, points: Tensor, weights: Tensor, transforms: Tensor) -> Tensor:  # type: ignore[override]
        points, transforms = points.detach().contiguous(), transforms.detach().contiguous()
        ctx.entries = _entries(weights)
        ctx.save_for_backward(points, transforms)
        out = torch.empty_like(points)
        kernels.skin(points.numpy(), *ctx.entries, transforms.numpy(), out.numpy())
        return out

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, given: Tensor) -> tuple[Tensor, None, Tensor]:  # type: ignore[override]
        points, transforms = ctx.saved_tensors
        by_points, by_transforms = torch.empty_like(points), torch.empty_like(transforms)
        arrays = (tensor.detach().contiguous().numpy() for tensor in (transforms, given, by_points, by_transforms))
        kernels.skin_backward(points.numpy(), *ctx.entries, *arrays)
        return by_points, None, by_transforms
