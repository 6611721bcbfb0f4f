"""The weighted loss terms of a method with a signed distance, from what it rendered."""

from collections.abc import Callable

import torch
from jaxtyping import Float
from torch import Tensor

from twofold import losses
from twofold.losses import LossConfig
from twofold.methods.base import Batch, Rendering
from twofold.metrics.perceptual import LPIPS

Gradients = Callable[[Float[Tensor, "n 3"]], Float[Tensor, "n 3"]]
"""Gradient of the signed distance at canonical points."""


def loss_terms(
    config: LossConfig, rendering: Rendering, batch: Batch, vertices: Float[Tensor, "V 3"], gradients: Gradients,
    perceptual: LPIPS | None, step: int, generator: torch.Generator,
) -> dict[str, Float[Tensor, ""]]:  # fmt: skip
    """Every term that has a weight, times this weight.

    Args:
        config: the weights.
        rendering: of the batch's rays.
        batch: what was seen along them.
        vertices: of the canonical body, metres, around which the eikonal term looks.
        gradients: of the signed distance.
        perceptual: the network of the perceptual term; None leaves it out.
        step: of the training.
        generator: draws what is random.
    """
    terms: dict[str, Tensor] = {}
    terms["reconstruction"] = losses.reconstruction(rendering.color, batch.color, config.reduction)
    if config.common and rendering.base is not None:
        terms["common"] = losses.common(rendering.base.color, batch.color, config.reduction)
    if config.eikonal:
        terms["eikonal"] = losses.eikonal(gradients(points_near(vertices, config, generator)))
    if config.mask:
        terms["mask"] = _mask_term(config, rendering.opacity, batch)
    if config.base_mask and rendering.base is not None:
        terms["base_mask"] = _mask_term(config, rendering.base.opacity, batch)
    if config.s3im and batch.singles:
        singles = slice(0, batch.singles)
        terms["s3im"] = losses.s3im(rendering.color[singles], batch.color[singles], generator, config.s3im_center)
    if config.lpips and perceptual is not None and step >= config.lpips_start and len(batch.patch_pixels):
        patches = patch_pair(config, rendering.color, batch)
        terms["lpips"] = perceptual(*patches, config.lpips_dropout, generator).mean()
    return {name: getattr(config, name) * term for name, term in terms.items()}


def _mask_term(config: LossConfig, opacity: Tensor, batch: Batch) -> Tensor:
    if config.mask_form == "hard":
        return losses.hard_mask(opacity, batch.mask, batch.singles)
    return losses.mask(opacity, batch.mask, "mean" if config.mask_form == "mean" else "sides")


def points_near(vertices: Float[Tensor, "V 3"], config: LossConfig, generator: torch.Generator) -> Float[Tensor, "n 3"]:
    r"""Random vertices, each moved by a normal deviate, $v_i + \epsilon$ with $\epsilon \sim N(0, \sigma^2)$."""
    count, device = config.eikonal_points, generator.device
    if config.eikonal_replacement:
        which = torch.randint(len(vertices), (count,), generator=generator, device=device)
    else:
        # Of a body with too few vertices each is taken equally often.
        order = torch.randperm(len(vertices), generator=generator, device=device)
        which = order[torch.arange(count, device=device) % len(vertices)]
    moved = torch.randn(count, 3, generator=generator, device=device)
    return vertices[which.to(vertices.device)] + config.eikonal_spread * moved.to(vertices.device)


def patch_pair(
    config: LossConfig, color: Float[Tensor, "R 3"], batch: Batch
) -> tuple[Float[Tensor, "n 3 P P"], Float[Tensor, "n 3 P P"]]:
    """The patches as rendered and as photographed, for the perceptual term."""
    if config.lpips_off_box == "black":
        return batch.patches(color), batch.patches(batch.color)
    return batch.patches(color, batch.background), batch.patch_color.permute(0, 3, 1, 2)
