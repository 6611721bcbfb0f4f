"""Measures of detail against torchmetrics, a loop over pixels and what they promise."""

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from skimage.filters import gaussian
from torch import Tensor
from torchmetrics.functional.image import structural_similarity_index_measure

from twofold.errors import TwofoldError
from twofold.metrics.detail import GRADIENT_SCALES, SCALE_WEIGHTS, gradient_error, ms_ssim
from twofold.metrics.image import psnr, to_8bit


def textured(seed: int, height: int = 32, width: int = 40) -> Tensor:
    generator = torch.Generator().manual_seed(seed)
    noise = torch.rand(height, width, 3, generator=generator).numpy()
    smooth = torch.from_numpy(gaussian(noise, 1.2, channel_axis=-1))
    return ((smooth - smooth.min()) / (smooth.max() - smooth.min())).float()


def stored(image: Tensor) -> Tensor:
    return to_8bit(image).double() / 255


def literal_ms_ssim(image: Tensor, truth: Tensor, scales: int) -> float:
    """By torchmetrics' maps, scale by scale; windows that hang over the edge are left out at every scale."""
    x, y = (stored(p).movedim(-1, 0)[None] for p in (image, truth))
    product = torch.ones(3, dtype=torch.float64)
    for scale, weight in enumerate(SCALE_WEIGHTS[:scales]):
        for c in range(3):
            one, other = x[:, [c]], y[:, [c]]
            if scale == scales - 1:
                _, full = structural_similarity_index_measure(one, other, data_range=1.0, return_full_image=True)
                mean = full[..., 5:-5, 5:-5].mean()
            else:
                _, mean = structural_similarity_index_measure(
                    one, other, data_range=1.0, return_contrast_sensitivity=True
                )
            product[c] *= mean.item() ** (weight / sum(SCALE_WEIGHTS[:scales]))
        x, y = (torch.nn.functional.avg_pool2d(p, 2) for p in (x, y))
    return product.mean().item()


@pytest.mark.parametrize(("size", "scales"), [(176, 5), (87, 3), (32, 2), (20, 1)])
def test_ms_ssim_is_built_of_torchmetrics_maps(size: int, scales: int) -> None:
    truth = textured(0, size, size + 7)
    image = (truth + 0.2 * torch.randn(truth.shape, generator=torch.Generator().manual_seed(1))).clamp(0, 1)
    assert ms_ssim(image, truth) == pytest.approx(literal_ms_ssim(image, truth, scales), abs=1e-6)


def test_ms_ssim_needs_room_for_one_window() -> None:
    with pytest.raises(TwofoldError, match="at least 11x11 pixels, it got 10x40"):
        ms_ssim(textured(0)[:10], textured(1)[:10])


def literal_gradient_error(image: Tensor, truth: Tensor, inside: Tensor) -> float:
    x, y = stored(image), stored(truth)
    errors = []
    for _ in range(GRADIENT_SCALES):
        height, width = x.shape[:2]
        if min(height, width) < 2:
            break
        above = below = 0.0
        for r in range(height):
            for c in range(width):
                for s, d in ((r + 1, c), (r, c + 1)):
                    if s < height and d < width and inside[r, c] and inside[s, d]:
                        one, other = x[s, d] - x[r, c], y[s, d] - y[r, c]
                        above += (one - other).abs().sum().item()
                        below += (one.abs() + other.abs()).sum().item()
        errors.append(above / below if below else 0.0)
        half = [slice(0, height // 2 * 2, 2), slice(1, height // 2 * 2, 2)]
        side = [slice(0, width // 2 * 2, 2), slice(1, width // 2 * 2, 2)]
        x, y = (sum(p[a][:, b] for a in half for b in side) / 4 for p in (x, y))
        inside = torch.stack([inside[a][:, b] for a in half for b in side]).all(0)
    return sum(errors) / len(errors)


def test_gradient_error_is_the_loop_over_neighbours() -> None:
    image, truth = textured(1, 13, 18), textured(2, 13, 18)
    everywhere = torch.ones(13, 18, dtype=torch.bool)
    mask = everywhere.clone()
    mask[:3], mask[:, 14:] = False, False
    assert gradient_error(image, truth) == pytest.approx(literal_gradient_error(image, truth, everywhere), abs=1e-12)
    assert gradient_error(image, truth, mask) == pytest.approx(literal_gradient_error(image, truth, mask), abs=1e-12)
    assert gradient_error(image[:2], truth[:2]) == pytest.approx(
        literal_gradient_error(image[:2], truth[:2], everywhere[:2]), abs=1e-12
    )


@settings(max_examples=20)
@given(st.integers(0, 99), st.integers(100, 199))
def test_gradient_error_is_symmetric_between_0_and_1(first: int, second: int) -> None:
    x, y = textured(first, 9, 12), textured(second, 9, 12)
    assert gradient_error(x, y) == gradient_error(y, x)
    assert 0 < gradient_error(x, y) <= 1
    assert gradient_error(x, x) == 0


def test_detail_that_is_lost_costs_more_than_brightness_at_equal_psnr() -> None:
    truth = 0.2 + 0.6 * textured(3)
    blurred = torch.from_numpy(gaussian(truth.numpy(), 1.0, channel_axis=-1)).float()
    shift = (stored(blurred) - stored(truth)).square().mean().sqrt().item()
    brighter = truth + shift
    assert psnr(brighter, truth) == pytest.approx(psnr(blurred, truth), abs=0.3)
    assert gradient_error(blurred, truth) > 5 * gradient_error(brighter, truth)
    assert ms_ssim(blurred, truth) < ms_ssim(brighter, truth)
