"""One pair of images under many settings, each measured by hand."""

import numpy as np
import pytest
import torch
from skimage.metrics import peak_signal_noise_ratio, structural_similarity
from torch import Tensor

from twofold.errors import TwofoldError
from twofold.metrics import detail, distribution
from twofold.metrics.inception import FILE, InceptionFeatures, inception_input
from twofold.metrics.perceptual import ALEX_FILE, LPIPS
from twofold.metrics.protocols import (
    METRICS,
    SETTINGS,
    UNVERIFIED,
    WHITE,
    Networks,
    ProtocolMeans,
    load_networks,
    measure_setting,
    on_background,
)

GREY = (0.2, 0.3, 0.4)


def scene(seed: int = 0) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """Person, opacity and true person, mask, ..., of 48 x 44 pixels; colours without any background."""
    generator = torch.Generator().manual_seed(seed)
    mask = torch.zeros(48, 44)
    mask[5:45, 4:40] = 1
    mask[5, 4:40] = 0.6
    opacity = mask * 0.9
    truth = torch.rand(48, 44, 3, generator=generator)
    person = (truth + 0.1 * torch.randn(truth.shape, generator=generator)).clamp(0, 1)
    return person, opacity, truth, mask, truth


def over(person: Tensor, alpha: Tensor, background: tuple[float, float, float]) -> Tensor:
    return person * alpha[..., None] + torch.tensor(background) * (1 - alpha[..., None])


@pytest.mark.parametrize("background", [WHITE, (0.0, 0.0, 0.0), GREY])
def test_a_rendering_moves_to_another_background(background) -> None:
    person, opacity, *_ = scene()
    moved = on_background(over(person, opacity, GREY), opacity, GREY, background)
    torch.testing.assert_close(moved, over(person, opacity, background), atol=1e-6, rtol=0)


@pytest.mark.parametrize("name", SETTINGS)
def test_each_setting_is_what_its_sentence_says(name: str) -> None:
    setting = SETTINGS[name]
    person, opacity, true_person, mask, _ = scene()
    background = setting.background or GREY
    image, truth = over(person, opacity, background), over(true_person, mask, background)
    found = measure_setting(setting, image, truth, mask)
    x, y = (np.clip(p.numpy(), 0, 1) * np.float32(255) for p in (image, truth))
    x, y = ((p if setting.truncate else p.round()).astype(np.uint8) / 255 for p in (x, y))
    regions = {"whole": np.ones((48, 44), bool), "mask": mask.numpy() > 0.5}
    regions["box"] = np.zeros((48, 44), bool)
    regions["box"][5:45, 4:40] = True
    chosen = regions[setting.psnr_region]
    expected = peak_signal_noise_ratio(y[chosen], x[chosen], data_range=1.0)
    assert found["psnr"] == pytest.approx(expected, abs=1e-6)
    if setting.ssim_region == "box":
        x, y = x[5:45, 4:40], y[5:45, 4:40]
    gaussian = {"gaussian_weights": True, "use_sample_covariance": False} if setting.window == "gaussian" else {}
    mean, full = structural_similarity(y, x, data_range=setting.data_range, channel_axis=-1, full=True, **gaussian)
    if setting.ssim_region == "mask":
        mean = full[regions["mask"]].mean()
    assert found["ssim"] == pytest.approx(mean, abs=1e-6)
    for metric in METRICS:
        words = setting.sentence(metric)
        assert ("truncated" in words) == setting.truncate
        assert (f"data range {setting.data_range:g}" in words) == (metric == "ssim")


def networks() -> Networks:
    """With random weights: of LPIPS, and instead of Inception the mean of every colour."""
    torch.manual_seed(0)
    lpips = {"vgg": LPIPS(((4,), (4,), (4,), (4,), (4,))), "alex": LPIPS(alex=True)}
    for model in lpips.values():
        for weight in model.linear:
            weight.fill_(0.5)
    inception = InceptionFeatures()
    inception.forward = lambda images: images.mean((2, 3)) / 255
    return Networks(lpips, inception)


def add(means: ProtocolMeans, seed: int) -> None:
    person, opacity, true_person, mask, _ = scene(seed)
    means.add(over(person, opacity, GREY), opacity, mask, GREY, lambda background: over(true_person, mask, background))


def test_means_are_those_of_the_images_and_the_sets() -> None:
    nets = networks()
    means, rows, features = ProtocolMeans(nets), [], []
    for seed in range(3):
        add(means, seed)
        person, opacity, true_person, mask, _ = scene(seed)
        white = [over(person, opacity, WHITE), over(true_person, mask, WHITE)]
        rows.append(measure_setting(SETTINGS["instantavatar"], *white, mask, nets.lpips["alex"])["lpips_x1000"])
        pair = over(person, opacity, GREY), over(true_person, mask, GREY)
        features.append(torch.stack([inception_input(p).mean((1, 2)) / 255 for p in pair]))
    found = means.figures()
    assert found["instantavatar_lpips_x1000"] == pytest.approx(np.mean(rows), rel=1e-4)
    ours, theirs = torch.stack(features, 1)
    assert found["kid_x1000"] == pytest.approx(1000 * distribution.polynomial_mmd(ours, theirs), abs=1e-6)
    assert found["fid"] == pytest.approx(distribution.fid(ours, theirs), abs=1e-6)
    assert found["range_2_ssim"] > found["twofold_ssim"]
    assert found["twofold_mask_psnr"] < found["twofold_psnr"]
    assert means.protocols().keys() == found.keys() >= detail.PROTOCOLS.keys()
    marked = {name for name, text in means.protocols().items() if text.endswith(UNVERIFIED)}
    assert marked == {name for name in found if "lpips" in name} | {"kid_x1000", "fid"}


def test_lpips_fed_wrongly_is_lpips_of_that() -> None:
    model = networks().lpips["alex"]
    person, _, truth, mask, _ = scene()
    stored = [((255 * p).round() / 255).movedim(-1, 0)[None] for p in (person, truth)]
    # Fed x where it maps 0..1 to -1..1 itself: 2 x' - 1 = x.
    expected = 1000 * model(*((p + 1) / 2 for p in stored)).item()
    found = measure_setting(SETTINGS["instantavatar"], person, truth, mask, model)["lpips_x1000"]
    assert found == pytest.approx(expected, rel=1e-5)
    with pytest.raises(TwofoldError, match="LPIPS needs 31 x 31 pixels, it got 30 x 44"):
        measure_setting(SETTINGS["instantavatar"], person[:30], truth[:30], mask[:30], model)


def test_without_weights_a_cell_says_what_to_put_where_and_is_no_number(tmp_path) -> None:
    means = ProtocolMeans(load_networks(tmp_path))
    assert means.figures() == {}
    add(means, 0)
    add(means, 1)
    found = means.figures()
    assert found["kid_x1000"] == found["fid"] == f"n/a (put {FILE.name} in {tmp_path})"
    assert ALEX_FILE in found["instantavatar_lpips_x1000"]
    assert isinstance(found["twofold_psnr"], float)
    assert isinstance(found["gradient_error"], float)
