"""Parts of images that are kept: the same batches as from whole images, whatever the memory."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from tiny_capture import HEIGHT, WIDTH, write_tiny

from twofold.capture.folder import read_capture
from twofold.recipe import PixelConfig
from twofold.training import pixels
from twofold.training.pixels import PixelSource
from twofold.training.regions import INSIDE, KNOWN, REACHABLE, SUBJECT, RegionStore, cut_out

LAYER = np.zeros((HEIGHT, WIDTH), np.uint8)
LAYER[10:14, 14:30] = 255
WAYS = {
    "single": PixelConfig(rays=200, patches=0, surroundings=2),
    "patches": PixelConfig(rays=60, patches=4, patch_size=14),
    "between": PixelConfig(rays=200, patches=0, between=True, subject="any"),
    "whole": PixelConfig(rays=60, patches=2, patch_size=9, reachable="image"),
}


@pytest.fixture(scope="module")
def capture(tmp_path_factory):
    return read_capture(write_tiny(tmp_path_factory.mktemp("regions") / "tiny", ignored={("front", 1): LAYER}))


def drawn(capture, config):
    source = PixelSource(capture.train, capture.body, capture.betas, config, margin=0.02)
    found = []
    for seed in range(6):
        batch = source.draw(seed % 3, torch.Generator().manual_seed(seed))
        found.append([value for value in (*vars(batch.rays).values(), *vars(batch).values()) if torch.is_tensor(value)])
    return found, source


@pytest.mark.parametrize("config", WAYS.values(), ids=WAYS.keys())
def test_batches_are_those_from_whole_images_with_any_memory(capture, config, monkeypatch):
    small, source = drawn(capture, config)
    in_file, without = drawn(capture, replace(config, memory_gb=0.0))
    monkeypatch.setattr(pixels, "cut_out", lambda *images: cut_out(*images[:-1], border=10**6))
    whole, all_of_it = drawn(capture, config)
    for found in (in_file, whole):
        for first, second in zip(small, found, strict=True):
            assert all(torch.equal(a, b) for a, b in zip(first, second, strict=True))
    assert (source._images.in_file, without._images.in_file) == (0, 3)
    assert all_of_it.image(0).image.shape[:2] == (HEIGHT, WIDTH)
    if not config.patches:
        assert source.image(0).image.size < all_of_it.image(0).image.size


def test_flags_of_pixels_are_found_by_their_place_in_the_whole_image():
    generator = torch.Generator().manual_seed(1)
    image, mask = torch.rand(9, 12, 3, generator=generator), torch.rand(9, 12, generator=generator)
    subject, reachable, inside, known = (torch.rand(4, 9, 12, generator=generator) > 0.5).unbind()
    reachable[:2], reachable[:, 9:], inside[:2], inside[:, 9:] = False, False, False, False
    region = cut_out(image, mask, subject & reachable, reachable, inside, known, border=1)
    assert region.corner == (1, 0)
    assert region.image.shape == (8, 10, 3)
    everywhere = torch.arange(9 * 12)
    for flag, pixels_of in ((SUBJECT, subject & reachable), (REACHABLE, reachable), (INSIDE, inside)):
        assert torch.equal(region.having(flag), pixels_of.flatten().nonzero()[:, 0])
        assert torch.equal(region.has(flag, everywhere), pixels_of.flatten())
    assert torch.equal(region.having(REACHABLE, without=INSIDE), (reachable & ~inside).flatten().nonzero()[:, 0])
    assert torch.equal(region.has(KNOWN, everywhere).view(9, 12)[1:, :10], known[1:, :10])
    some = region.having(REACHABLE)
    assert torch.equal(region.colors(some), (image * 255).round().flatten(0, 1)[some] / 255)
    assert torch.equal(region.coverage(some), (mask * 255).round().flatten()[some] / 255)


def test_beyond_the_budget_regions_lie_in_a_file_and_come_back_whole():
    pixels_of = torch.ones(5, 7, dtype=torch.bool)
    generator = torch.Generator().manual_seed(2)
    regions = [
        cut_out(torch.rand(5, 7, 3, generator=generator), torch.rand(5, 7), *[pixels_of] * 4, border=0)
        for _ in range(4)
    ]
    store = RegionStore(2.5 * 5 * 5 * 7)
    for number, region in enumerate(regions):
        assert store.get(number) is None
        store.put(number, region)
    assert store.in_file == 2
    for number in (3, 0, 2, 1):
        found = store.get(number)
        assert found is not None
        for name in ("image", "mask", "flags"):
            np.testing.assert_array_equal(getattr(found, name), getattr(regions[number], name))
