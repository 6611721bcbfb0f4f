"""What a field answers at a point."""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional as F

from twofold.field import output_kernels as kernels
from twofold.kernels.parallel import in_parts

_LEAST = 1e-6
"""Shorter gradients than this have shorter normals."""


@dataclass(frozen=True)
class FieldOutput:
    """Signed distance and colour at points of canonical space.

    Attributes:
        sdf: metres, negative inside.
        color: 0..1 for a field that has learned; not clamped.
        gradient: of the signed distance by the canonical point; None where nobody asked for it.
        base: the pose-independent branch alone, where there is one beside the whole.
    """

    sdf: Float[Tensor, "S"]
    color: Float[Tensor, "S 3"]
    gradient: Float[Tensor, "S 3"] | None
    base: "FieldOutput | None" = None

    def normals(self, to_observation: Float[Tensor, "S 3 3"]) -> Float[Tensor, "S 3"]:
        """Unit normals of observation space: the gradients turned by `to_observation`.

        Raises:
            ValueError: nobody asked for gradients.
        """
        if self.gradient is None:
            raise ValueError("normals need the gradient of the distance; this field gave none")
        wanted = torch.is_grad_enabled() and (self.gradient.requires_grad or to_observation.requires_grad)
        single = self.gradient.dtype == to_observation.dtype == torch.float32
        if wanted or self.gradient.is_cuda or not single or len(to_observation) != len(self.gradient):
            return F.normalize((to_observation * self.gradient[:, None]).sum(-1), dim=-1, eps=_LEAST)
        out = torch.empty_like(self.gradient, memory_format=torch.contiguous_format)
        turn, gradient = (t.detach().contiguous().numpy() for t in (to_observation, self.gradient))
        given = (turn, gradient, np.float32(_LEAST), out.numpy())
        in_parts(len(out), lambda begin, end: kernels.turned(*given, begin, end), least=8192)
        return out


@dataclass(frozen=True)
class RadianceOutput:
    """Volume density and colour at points: what a field without a surface gives.

    Attributes:
        density: per metre, not negative.
        color: 0..1.
    """

    density: Float[Tensor, "S"]
    color: Float[Tensor, "S 3"]
