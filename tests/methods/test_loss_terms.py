"""Loss terms from what was rendered: which points, which patches, which weights."""

from dataclasses import replace

import pytest
import torch

from twofold import losses
from twofold.geometry.cameras import Rays
from twofold.losses import LossConfig
from twofold.methods.base import Batch, Rendering
from twofold.methods.factorized_recipes import released
from twofold.methods.loss_terms import loss_terms, patch_pair, points_near
from twofold.metrics.perceptual import LPIPS

CONFIG = released().method.losses
VERTICES = torch.rand(700, 3, generator=torch.Generator().manual_seed(0))
BACKGROUND = torch.tensor([0.2, 0.4, 0.6])


def seeded(seed=0):
    return torch.Generator().manual_seed(seed)


def a_batch(singles=30, size=16):
    """Single pixels, and one patch whose last rows no ray meets."""
    pixels = torch.full((1, size, size), -1)
    pixels[0, :10] = singles + torch.arange(10 * size).view(10, size)
    count = singles + 10 * size
    zeros = torch.zeros(count)
    return Batch(
        rays=Rays(torch.zeros(count, 3), torch.ones(count, 3), zeros, zeros),
        image=torch.rand(count, 3, generator=seeded(1)),
        mask=torch.rand(count, generator=seeded(2)).round(decimals=1),
        singles=singles,
        patch_pixels=pixels,
        patch_image=torch.rand(1, size, size, 3, generator=seeded(3)),
        patch_mask=torch.rand(1, size, size, generator=seeded(8)),
        frame_index=0,
        background=BACKGROUND,
    )


def a_rendering(batch):
    color, count = torch.rand(batch.color.shape, generator=seeded(4)), len(batch.mask)
    opacity = torch.rand(count, generator=seeded(5))
    base = Rendering(color.flip(0), opacity, opacity, color)
    return Rendering(color, opacity, opacity, color, base)


def test_eikonal_points_are_different_vertices_moved_by_a_centimetre():
    source = seeded(7)
    order, moved = torch.randperm(700, generator=source).tolist(), torch.randn(512, 3, generator=source)
    expected = torch.stack([VERTICES[order[i]] + 0.01 * moved[i] for i in range(512)])
    torch.testing.assert_close(points_near(VERTICES, CONFIG, seeded(7)), expected)
    assert len(set(order[:512])) == 512


def test_a_body_of_few_vertices_gives_each_of_them_equally_often():
    config = replace(CONFIG, eikonal_spread=0.0, eikonal_points=20)
    found = points_near(VERTICES[:10], config, seeded())
    assert [int((found == vertex).all(1).sum()) for vertex in VERTICES[:10]] == [2] * 10


def test_points_drawn_with_replacement_repeat():
    config = replace(CONFIG, eikonal_spread=0.0, eikonal_replacement=True)
    assert len(points_near(VERTICES, config, seeded()).unique(dim=0)) < 512


def test_patches_of_the_release_show_background_and_image_where_no_ray_goes():
    batch = a_batch()
    color = a_rendering(batch).color
    rendered, true = patch_pair(CONFIG, color, batch)
    for row in range(16):
        for column in range(16):
            ray = int(batch.patch_pixels[0, row, column])
            expected = BACKGROUND if ray < 0 else color[ray]
            assert torch.equal(rendered[0, :, row, column], expected)
            assert torch.equal(true[0, :, row, column], batch.patch_color[0, row, column])
    dark, darker = patch_pair(replace(CONFIG, lpips_off_box="black"), color, batch)
    assert not dark[0, :, 10:].any()
    assert not darker[0, :, 10:].any()


def test_released_terms_are_their_definitions_times_their_weights():
    batch = a_batch()
    rendering = a_rendering(batch)
    network = LPIPS(((4,), (4,), (4,), (4,), (4,)))
    for parameter in [*network.blocks.parameters(), *network.linear.parameters()]:
        parameter.copy_(torch.rand(parameter.shape, generator=seeded(6)))
    given = (CONFIG, rendering, batch, VERTICES, lambda x: 2 * x, network)
    found = loss_terms(*given, 20_001, seeded(9))
    source = seeded(9)
    points = points_near(VERTICES, CONFIG, source)
    eikonal = sum((2 * float(x.norm()) - 1) ** 2 for x in points) / 512
    s3im = losses.s3im(rendering.color[:30], batch.color[:30], source, 2.0)
    lpips = network(*patch_pair(CONFIG, rendering.color, batch), 0.5, source).mean()
    expected = {
        "reconstruction": float((rendering.color - batch.color).abs().mean()),
        "common": 0.5 * float((rendering.base.color - batch.color).abs().mean()),
        "eikonal": 0.1 * eikonal,
        "mask": 0.1 * float(losses.hard_mask(rendering.opacity, batch.mask, 30)),
        "s3im": 0.1 * float(s3im),
        "lpips": float(lpips),
    }
    assert {name: float(term) for name, term in found.items()} == pytest.approx(expected, rel=1e-5)
    assert "lpips" not in loss_terms(*given, 20_000, seeded(9)), "its first step is the one after 20,000"


@pytest.mark.parametrize("form", ["sides", "mean"])
def test_other_mask_forms_keep_soft_edges(form):
    batch, config = a_batch(), LossConfig(mask_form=form, mask=1.0, eikonal=0.0, s3im=0.0, lpips=0.0)
    rendering = a_rendering(batch)
    found = loss_terms(config, rendering, batch, VERTICES, lambda x: x, None, 0, seeded())["mask"]
    assert float(found) == pytest.approx(float(losses.mask(rendering.opacity, batch.mask, form)))
