"""Image figures against scikit-image and against sums by hand."""

import math

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from skimage.metrics import peak_signal_noise_ratio, structural_similarity
from torch import Tensor
from torchmetrics.functional.image import structural_similarity_index_measure

from twofold.errors import TwofoldError
from twofold.metrics.image import (
    PROTOCOLS,
    PSNR_CEILING,
    compare,
    psnr,
    psnr_box,
    silhouette_iou,
    ssim,
    ssim_box,
    subject_box,
    to_8bit,
)


def pair(seed: int, height: int = 40, width: int = 33, noise: float = 0.1) -> tuple[Tensor, Tensor]:
    """A smooth image and a noisy copy that leaves 0..1 in places."""
    generator = torch.Generator().manual_seed(seed)
    rows, columns = torch.meshgrid(torch.linspace(0, 3, height), torch.linspace(0, 4, width), indexing="ij")
    truth = torch.stack([rows.sin(), (rows * columns).cos(), columns / 3], -1) * 0.5 + 0.5
    return truth + noise * torch.randn(truth.shape, generator=generator), truth


def as_stored(image: Tensor) -> np.ndarray:
    return np.round(np.clip(image.numpy().astype(np.float32), 0, 1) * np.float32(255)).astype(np.uint8) / 255


@pytest.mark.parametrize("noise", [0.003, 0.1, 0.7])
@pytest.mark.parametrize("data_range", [1.0, 2.0])
def test_ssim_equals_scikit_image(noise: float, data_range: float) -> None:
    image, truth = pair(1, noise=noise)
    theirs = structural_similarity(as_stored(truth), as_stored(image), data_range=data_range, channel_axis=-1)
    assert ssim(image, truth, data_range) == pytest.approx(float(theirs), abs=1e-9)


@pytest.mark.parametrize("data_range", [1.0, 2.0])
def test_ssim_under_the_gaussian_window_equals_scikit_image_and_torchmetrics(data_range: float) -> None:
    image, truth = pair(1, noise=0.1)
    found = ssim(image, truth, data_range, window="gaussian")
    skimage = structural_similarity(
        as_stored(truth), as_stored(image), data_range=data_range, channel_axis=-1, gaussian_weights=True,
        use_sample_covariance=False,
    )  # fmt: skip
    assert found == pytest.approx(float(skimage), abs=1e-9)
    x, y = (torch.from_numpy(as_stored(p)).movedim(-1, 0)[None] for p in (image, truth))
    # Its mean takes in windows that hang over the edge, so this is its map without them.
    _, full = structural_similarity_index_measure(x, y, data_range=data_range, return_full_image=True)
    assert found == pytest.approx(full[..., 5:-5, 5:-5].mean().item(), abs=1e-6)


def test_ssim_inside_a_mask_is_the_mean_of_scikit_images_map_there() -> None:
    image, truth = pair(8)
    mask = torch.zeros(40, 33, dtype=torch.bool)
    mask[5:30, 3:17] = True
    _, full = structural_similarity(as_stored(truth), as_stored(image), data_range=1.0, channel_axis=-1, full=True)
    assert ssim(image, truth, inside=mask) == pytest.approx(full[mask.numpy()].mean(), abs=1e-9)
    assert ssim(image, truth, inside=mask) != pytest.approx(ssim(image, truth), abs=1e-4)


@given(st.integers(0, 50))
def test_truncation_is_what_programs_of_the_field_store(seed: int) -> None:
    image, truth = pair(seed, 9, 10)
    stored = [(255 * np.clip(p.numpy(), 0, 1)).astype(np.uint8) for p in (image, truth)]
    assert (to_8bit(image, truncate=True).numpy() == stored[0]).all()
    theirs = peak_signal_noise_ratio(stored[1] / 255, stored[0] / 255, data_range=1.0)
    assert psnr(image, truth, truncate=True) == pytest.approx(theirs, abs=1e-9)
    similar = structural_similarity(stored[1] / 255, stored[0] / 255, data_range=2.0, channel_axis=-1)
    assert ssim(image, truth, 2.0, truncate=True) == pytest.approx(float(similar), abs=1e-9)
    assert (to_8bit(image, truncate=True) <= to_8bit(image)).all()


def test_a_photograph_is_the_same_truncated_and_rounded() -> None:
    every = (np.arange(256).astype(np.float32) / 255).reshape(16, 16)
    assert (to_8bit(torch.from_numpy(every), truncate=True).flatten() == torch.arange(256)).all()


def test_one_pass_over_the_windows_gives_what_each_figure_gives_alone() -> None:
    image, truth = pair(9)
    mask = torch.zeros(40, 33)
    mask[7:31, 5:27] = 1
    ignored = torch.zeros(40, 33, dtype=torch.bool)
    ignored[20:24, 10:12] = True
    for hidden in (None, ignored):
        figures = compare(image, truth, mask, mask, hidden)
        assert figures["ssim"] == pytest.approx(ssim(image, truth, ignored=hidden), abs=1e-12)
        assert figures["ssim_box"] == pytest.approx(ssim_box(image, truth, mask, ignored=hidden), abs=1e-12)
        assert figures["ssim_range_2"] == pytest.approx(ssim(image, truth, 2.0, hidden), abs=1e-12)


def test_ssim_of_flat_images_equals_scikit_image() -> None:
    image, truth = torch.full((9, 7, 3), 0.2), torch.full((9, 7, 3), 0.7)
    theirs = structural_similarity(as_stored(truth), as_stored(image), data_range=1.0, channel_axis=-1)
    assert ssim(image, truth) == pytest.approx(float(theirs), abs=1e-9)


@given(st.integers(0, 100), st.floats(0.01, 1))
def test_psnr_equals_scikit_image(seed: int, noise: float) -> None:
    image, truth = pair(seed, 8, 9, noise)
    theirs = peak_signal_noise_ratio(as_stored(truth), as_stored(image), data_range=1.0)
    assert psnr(image, truth) == pytest.approx(theirs, abs=1e-9)


def test_psnr_of_a_constant_error_is_the_closed_form() -> None:
    truth = torch.full((4, 5, 3), 0.4)  # 102 of 255
    assert psnr(truth + 10 / 255, truth) == pytest.approx(20 * math.log10(25.5), abs=1e-6)


def test_equal_images_stay_finite_and_rounding_comes_before_comparing() -> None:
    truth = torch.full((8, 8, 3), 0.4)
    assert psnr(truth, truth) == PSNR_CEILING
    assert psnr(truth + 0.3 / 255, truth) == PSNR_CEILING
    assert psnr(truth * 5 + 1, torch.ones_like(truth)) == PSNR_CEILING


def test_psnr_looks_only_inside_its_mask() -> None:
    image, truth = pair(2)
    mask = torch.zeros(40, 33, dtype=torch.bool)
    mask[3:9, 4:30] = True
    spoilt = torch.where(mask[..., None], image, 1 - truth)
    assert psnr(spoilt, truth, mask) == pytest.approx(psnr(image[3:9, 4:30], truth[3:9, 4:30]), abs=1e-12)
    assert psnr(spoilt, truth) < psnr(spoilt, truth, mask)


def test_box_bounds_the_mask_and_stays_in_the_image() -> None:
    mask = torch.zeros(20, 30)
    mask[4, 25], mask[9, 7], mask[15, 2] = 0.51, 1.0, 0.5
    assert subject_box(mask) == (slice(4, 10), slice(7, 26))
    assert subject_box(mask, margin=5) == (slice(0, 15), slice(2, 30))
    with pytest.raises(TwofoldError, match="mask is empty"):
        subject_box(torch.zeros(4, 4))


def test_box_figures_are_those_of_the_cut_out() -> None:
    image, truth = pair(3)
    mask = torch.zeros(40, 33)
    mask[10:30, 5:20] = 1
    assert psnr_box(image, truth, mask) == psnr(image[10:30, 5:20], truth[10:30, 5:20])
    assert ssim_box(image, truth, mask, 2) == ssim(image[8:32, 3:22], truth[8:32, 3:22])


def test_silhouette_overlap_by_counting() -> None:
    opacity, mask = torch.zeros(10, 10), torch.zeros(10, 10)
    opacity[:6], mask[3:] = 0.8, 0.9
    assert silhouette_iou(opacity, mask) == pytest.approx(3 / 10)
    assert silhouette_iou(opacity, mask, threshold=0.85) == 0.0
    assert silhouette_iou(mask, opacity, threshold=0.85) == 0.0
    assert silhouette_iou(mask, mask) == 1.0
    assert silhouette_iou(torch.zeros(3, 3), torch.zeros(3, 3)) == 1.0


def test_too_small_an_image_is_one_clear_sentence() -> None:
    image, truth = pair(4, 6, 20)
    with pytest.raises(TwofoldError, match="at least 7x7 pixels, it got 6x20"):
        ssim(image, truth)


def test_nan_is_not_drawn_as_black() -> None:
    with pytest.raises(ValueError, match="NaN"):
        to_8bit(torch.tensor([0.1, math.nan]))


def test_every_figure_has_its_protocol() -> None:
    image, truth = pair(5)
    mask = torch.zeros(40, 33)
    mask[10:30, 5:20] = 1
    figures = compare(image, truth, mask, mask)
    assert figures.keys() == PROTOCOLS.keys()
    assert figures["silhouette_iou"] == 1
    assert figures["psnr_box"] == psnr_box(image, truth, mask)
    assert figures["ssim_range_2"] > figures["ssim"]


def test_ignored_pixels_change_no_figure_and_the_rest_is_measured() -> None:
    image, truth = pair(6)
    mask, opacity = torch.zeros(40, 33), torch.zeros(40, 33)
    mask[5:35, 5:28], opacity[8:36, 5:28] = 1, 1
    ignored = torch.zeros(40, 33, dtype=torch.bool)
    ignored[6:14, 8:20] = True
    figures = compare(image, truth, opacity, mask, ignored)
    spoilt, emptied = torch.where(ignored[..., None], 1 - truth, image), torch.where(ignored, 1 - opacity, opacity)
    assert compare(spoilt, truth, emptied, mask, ignored) == figures
    assert figures["psnr"] == psnr(image, truth, ~ignored)
    assert figures["silhouette_iou"] == silhouette_iou(opacity * ~ignored, mask * ~ignored)
    assert compare(image, truth, opacity, mask, torch.zeros_like(ignored)) == compare(image, truth, opacity, mask)


def test_ssim_counts_the_windows_that_touch_nothing_ignored() -> None:
    image, truth = pair(7)
    ignored = torch.zeros(40, 33, dtype=torch.bool)
    ignored[:, 20:] = True
    assert ssim(image, truth, ignored=ignored) == pytest.approx(ssim(image[:, :20], truth[:, :20]), abs=1e-12)
    with pytest.raises(TwofoldError, match="Every window"):
        ssim(image, truth, ignored=torch.ones(40, 33, dtype=torch.bool))
