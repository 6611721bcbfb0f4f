"""Batches leave out what nothing is known of."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from tiny_capture import HEIGHT, WIDTH, write_tiny

from twofold.capture.folder import read_capture
from twofold.capture.pixels import Batch, PixelConfig, PixelSource
from twofold.errors import TwofoldError
from twofold.geometry.cameras import project

HIDDEN = (slice(10, 24), slice(14, 30))


@pytest.fixture(scope="module")
def hidden(tmp_path_factory):
    """The tiny capture with a rectangle ignored at time 1."""
    layer = np.zeros((HEIGHT, WIDTH), np.uint8)
    layer[HIDDEN] = 255
    return read_capture(write_tiny(tmp_path_factory.mktemp("hidden") / "tiny", ignored={("front", 1): layer}))


def pixels_of(capture, batch: Batch) -> tuple[torch.Tensor, torch.Tensor]:
    """Rows and columns that a batch looks at."""
    rays = batch.rays
    columns, rows = project(capture.train[1].camera, rays.origins + 3 * rays.directions)[0].round().long().unbind(-1)
    return rows, columns


@pytest.mark.parametrize("surroundings", [None, 4])
def test_ignored_pixels_are_never_drawn(hidden, surroundings):
    config = PixelConfig(rays=500, surroundings=surroundings, patches=3, patch_size=12)
    source = PixelSource(hidden.train, hidden.body, hidden.betas, config, hidden.background)
    generator = torch.Generator().manual_seed(0)
    left_out = 0
    for _ in range(5):
        batch = source.draw(1, generator)
        rows, columns = pixels_of(hidden, batch)
        assert not hidden.train[1].ignored()[rows, columns].any()
        left_out += int((batch.patch_pixels < 0).sum())
        drawn = batch.patch_pixels[batch.patch_pixels >= 0]
        assert drawn.sort().values.tolist() == list(range(500, len(batch.mask)))
    assert left_out > 0
    rows, columns = pixels_of(hidden, source.draw(0, generator))
    seen = torch.zeros(HEIGHT, WIDTH, dtype=torch.bool)
    seen[rows, columns] = True
    assert seen[HIDDEN].any()


def test_a_picture_that_ignores_all_of_the_person_is_one_sentence(hidden, tmp_path):
    layer = np.full((HEIGHT, WIDTH), 255, np.uint8)
    capture = read_capture(write_tiny(tmp_path / "tiny", ignored={("front", 0): layer}))
    source = PixelSource(capture.train, capture.body, capture.betas, PixelConfig(), capture.background)
    with pytest.raises(TwofoldError, match="ignores all of the person"):
        source.picture(0)


def test_nothing_ignored_draws_as_if_there_were_no_layer(hidden):
    plain = tuple(replace(frame, ignored_file=None) for frame in hidden.train)
    empty = PixelSource(hidden.train, hidden.body, hidden.betas, PixelConfig(), hidden.background)
    without = PixelSource(plain, hidden.body, hidden.betas, PixelConfig(), hidden.background)
    first, second = (s.draw(2, torch.Generator().manual_seed(3)) for s in (empty, without))
    torch.testing.assert_close(first.color, second.color, rtol=0, atol=0)
    torch.testing.assert_close(first.rays.directions, second.rays.directions, rtol=0, atol=0)
