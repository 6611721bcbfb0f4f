"""Masks of a still camera: a person of known outline before a textured background, and an estimator that is off."""

import numpy as np
import pytest
from PIL import Image, ImageDraw
from scipy import ndimage

from twofold.geometry.silhouettes import overlap
from twofold.prepare.detect.mask_refinement import background_plate, refine_clip, refined_mask

SCALE, COUNT = 3, 10
HEIGHT, WIDTH = 120 * SCALE, 160 * SCALE


def scene() -> np.ndarray:
    noise = np.random.default_rng(0).normal(size=(HEIGHT, WIDTH, 3))
    smooth = np.stack([ndimage.gaussian_filter(noise[..., k], 4.0) for k in range(3)], -1)
    return (110 + 400 * smooth).clip(20, 200)


def outline(number: int) -> np.ndarray:
    """A figure of 300 rows that walks to the right."""
    image = Image.new("L", (160, 120))
    pen, x = ImageDraw.Draw(image), 25 + 11 * number
    pen.ellipse([x - 8, 8, x + 8, 28], fill=255)
    pen.rectangle([x - 14, 28, x + 14, 70], fill=255)
    pen.rectangle([x - 12, 70, x - 3, 108], fill=255)
    pen.rectangle([x + 3, 70, x + 12, 108], fill=255)
    return np.asarray(image.resize((WIDTH, HEIGHT), Image.Resampling.BICUBIC)) > 127


def clip(seed: int = 1) -> tuple[list[np.ndarray], list[np.ndarray], list[np.ndarray]]:
    """Images, masks whose rim is off by some pixels, and true outlines."""
    generator, behind = np.random.default_rng(seed), scene()
    images, masks, truths = [], [], []
    for number in range(COUNT):
        true = outline(number)
        image = np.where(true[..., None], np.array([220.0, 60, 40]), behind) + generator.normal(0, 3, behind.shape)
        distance = ndimage.distance_transform_edt(true) - ndimage.distance_transform_edt(~true)
        wave = ndimage.gaussian_filter(generator.normal(size=true.shape), 12)
        masks.append(np.where(distance + 3 * wave / wave.std() > 0, 255, 0).astype(np.uint8))
        images.append(image.clip(0, 255).astype(np.uint8))
        truths.append(true)
    return images, masks, truths


def mean_overlap(masks, truths) -> float:
    return float(np.mean([overlap(mask > 127, true) for mask, true in zip(masks, truths, strict=True)]))


def test_the_plate_is_the_scene_where_it_is_seen():
    images, masks, _ = clip()
    plate = background_plate(images, masks)
    assert plate.known.mean() > 0.9
    assert np.abs(plate.color - scene())[plate.known].mean() < 4


def test_the_plate_is_the_median_of_the_images_that_show_a_pixel():
    """Literally, pixel by pixel."""
    images, masks, _ = clip()
    plate = background_plate(images, masks)
    near = [ndimage.distance_transform_edt(mask <= 76) < 1.5 for mask in masks]
    for row, column in ((180, 90), (60, 270), (300, 210)):
        seen = [i[row, column].astype(float) for i, hidden in zip(images, near, strict=True) if not hidden[row, column]]
        assert plate.known[row, column] == (len(seen) >= 2)
        if len(seen) >= 2:
            middle = np.median(seen, axis=0)
            np.testing.assert_allclose(plate.color[row, column], middle, atol=1e-4)
            expected = 1.48 * np.median(np.abs(np.array(seen) - middle), axis=0).mean()
            np.testing.assert_allclose(plate.deviation[row, column], expected, rtol=1e-4)


def test_masks_come_closer_to_the_outline():
    images, masks, truths = clip()
    plate = background_plate(images, masks)
    found = [refined_mask(image, mask, plate) for image, mask in zip(images, masks, strict=True)]
    before, after = mean_overlap(masks, truths), mean_overlap(found, truths)
    assert before < 0.93
    assert 1 - after < 0.5 * (1 - before)


def test_where_the_background_is_not_known_the_mask_stays():
    images, masks, _ = clip()
    plate = background_plate(images[:1], masks[:1])
    assert not plate.known.any()
    np.testing.assert_array_equal(refined_mask(images[0], masks[0], plate), masks[0])


def test_a_person_of_the_background_s_colour_keeps_its_mask():
    _, masks, _ = clip()
    generator = np.random.default_rng(3)
    images = [(120 + generator.normal(0, 3, (HEIGHT, WIDTH, 3))).astype(np.uint8) for _ in masks]
    plate = background_plate(images, masks)
    for image, mask in zip(images[:3], masks, strict=False):
        assert overlap(refined_mask(image, mask, plate) > 127, mask > 127) > 0.99


def test_nobody_in_the_image_stays_nobody():
    images, masks, _ = clip()
    plate = background_plate(images, masks)
    empty = np.zeros_like(masks[0])
    np.testing.assert_array_equal(refined_mask(images[0], empty, plate), empty)


@pytest.fixture
def files(tmp_path):
    images, masks, truths = clip()
    names = [(tmp_path / f"{k}.jpg", tmp_path / f"{k}.png") for k in range(COUNT)]
    for (first, second), image, mask in zip(names, images, masks, strict=True):
        Image.fromarray(image).save(first, quality=95, subsampling=0)
        Image.fromarray(mask).save(second)
    return [a for a, _ in names], [b for _, b in names], masks, truths


def test_a_clip_is_refined_in_its_files(files):
    images, masks, before, truths = files
    done: list[float] = []
    changed = refine_clip(images, masks, lambda path, mask: Image.fromarray(mask).save(path), done.append)
    after = [np.asarray(Image.open(path)) for path in masks]
    moved = sum(((a > 127) != (b > 127)).sum() for a, b in zip(after, before, strict=True))
    assert changed == pytest.approx(moved / sum((b > 127).sum() for b in before))
    assert 1 - mean_overlap(after, truths) < 0.5 * (1 - mean_overlap(before, truths))
    assert done == sorted(done)
    assert done[-1] == 1


def test_a_second_pass_begins_at_the_outline_of_the_first(files):
    images, masks, before, truths = files
    overlaps = []
    for passes in (1, 2):
        for path, mask in zip(masks, before, strict=True):
            Image.fromarray(mask).save(path)
        refine_clip(images, masks, lambda path, mask: Image.fromarray(mask).save(path), passes=passes)
        overlaps.append(mean_overlap([np.asarray(Image.open(path)) for path in masks], truths))
    assert overlaps[1] > overlaps[0] + 0.001
