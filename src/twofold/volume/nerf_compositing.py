"""Compositing as NeRF and its successors do it: the last interval of a ray is open.

HumanNeRF, MonoHuman, DANBO and PM-Avatar multiply up 1 - alpha; NPC integrates density as the SDF methods do. All
functions take packed samples, so rays may have any number of them.
"""

import torch
from jaxtyping import Float, Int
from torch import Tensor

from twofold.volume.samples import Samples

OPEN_INTERVAL = 1e10
"""Length of the last interval of a ray."""
ALPHA_OFFSET = 1e-10
"""Added to 1 - alpha, so that a product over opaque samples has a derivative."""
MAX_OPTICAL_LENGTH = 80.0
"""Density times length beyond which nothing shines through in single precision."""
MIN_DENSITY = 2.0
"""Densities per metre below this are set to zero when NPC renders a test image."""


def open_samples(depths: Float[Tensor, "R n"], last: float = OPEN_INTERVAL) -> Samples:
    r"""Packed samples at all depths of each ray; the last one's interval is open.

    \[ \delta_i = t_{i+1} - t_i, \qquad \delta_n = 10^{10} \]

    >>> open_samples(torch.tensor([[1.0, 1.5]]), last=9.0)
    Samples(ray_index=tensor([0, 0]), depth=tensor([1.0000, 1.5000]), delta=tensor([0.5000, 9.0000]))

    Args:
        depths: ascending, metres.
        last: length of the last interval.
    """
    rays, count = depths.shape
    ray_index = torch.arange(rays, device=depths.device).repeat_interleave(count)
    delta = torch.cat([depths.diff(dim=1), torch.full_like(depths[:, :1], last)], 1)
    return Samples(ray_index, depths.flatten(), delta.flatten())


def alpha_of_density(density: Float[Tensor, "S"], delta: Float[Tensor, "S"]) -> Float[Tensor, "S"]:
    r"""alpha = 1 - exp(-sigma delta): how much of the light a sample stops.

    \[ \alpha = 1 - e^{-\sigma \delta} \]

    >>> alpha_of_density(torch.tensor([0.0, 2.0]), torch.tensor([1.0, 1e10]))
    tensor([0., 1.])
    """
    return -torch.expm1(-density * delta)


def alpha_weights(alpha: Float[Tensor, "S"], ray_index: Int[Tensor, "S"]) -> Float[Tensor, "S"]:
    r"""What each sample adds to its ray: alpha_i prod_{j<i} (1 - alpha_j + 1e-10).

    \[ w_i = \alpha_i \prod_{j<i} (1 - \alpha_j + 10^{-10}) \]

    >>> alpha_weights(torch.tensor([0.5, 0.5, 1.0]), torch.tensor([0, 0, 1]))
    tensor([0.5000, 0.2500, 1.0000])

    Args:
        alpha: of each sample, 0..1; for HumanNeRF times the likelihood that the sample belongs to the person, which
            may be a little more than one. The product is then negative, as in the authors' programs.
        ray_index: the ray of each sample, ascending.
    """
    # The product as a running sum of logarithms over all rays, in double precision: each ray's own start is taken off.
    factor = 1 - alpha.double() + ALPHA_OFFSET
    through = torch.exp(_sum_before(factor.abs().log(), ray_index))
    negative = _sum_before((factor.detach() < 0).double(), ray_index) % 2
    return alpha * (through * (1 - 2 * negative)).to(alpha.dtype)


def open_density_weights(
    density: Float[Tensor, "S"], delta: Float[Tensor, "S"], ray_index: Int[Tensor, "S"]
) -> Float[Tensor, "S"]:
    r"""What each sample adds to its ray, exp(-sum_{j<i} sigma_j delta_j) (1 - exp(-sigma_i delta_i)), for NPC.

    \[ w_i = e^{-\sum_{j<i} \sigma_j \delta_j} \, (1 - e^{-\sigma_i \delta_i}) \]

    As `volume.rendering.composite_weights`, but accurate with open intervals, where that one loses digits.

    >>> open_density_weights(torch.tensor([0.0, 3.0]), torch.tensor([1.0, 1e10]), torch.tensor([0, 0]))
    tensor([0., 1.])

    Args:
        density: of each sample, per metre.
        delta: length of each interval, metres.
        ray_index: the ray of each sample, ascending.
    """
    optical = (density * delta).clamp_max(MAX_OPTICAL_LENGTH)
    through = torch.exp(-_sum_before(optical.double(), ray_index)).to(density.dtype)
    return through * -torch.expm1(-optical)


def without_thin_density(density: Float[Tensor, "*b"], min_density: float = MIN_DENSITY) -> Float[Tensor, "*b"]:
    r"""Densities below `min_density` (per metre) set to zero, as NPC renders test images.

    \[ \sigma' = \sigma \text{ where } \sigma \ge \sigma_{\min}, \text{ else } 0 \]

    >>> without_thin_density(torch.tensor([1.9, 2.0]))
    tensor([0., 2.])
    """
    return torch.where(density < min_density, torch.zeros_like(density), density)


def _sum_before(values: Tensor, ray_index: Tensor) -> Tensor:
    """Sum of the values of the samples before each one on its ray."""
    before = values.cumsum(0) - values
    new = torch.ones_like(ray_index, dtype=torch.bool)
    new[1:] = ray_index[1:] != ray_index[:-1]
    first = torch.cummax(torch.where(new, torch.arange(len(values), device=values.device), 0), 0).values
    return before - before[first]
