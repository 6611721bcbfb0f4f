"""What mask values mean is decided for a whole folder: one odd file does not change what its values stand for."""

import numpy as np
import pytest
from PIL import Image

from twofold.errors import TwofoldError
from twofold.prepare.detect.mask_values import mask_values, read_mask

PERSON = np.zeros((40, 50), bool)
PERSON[10:30, 15:35] = True


def written(folder, images):
    files = [folder / f"{number}.png" for number in range(len(images))]
    for path, image in zip(files, images, strict=True):
        image.save(path)
    return files


def read_all(files):
    values = mask_values(files)
    return [read_mask(path, values) for path in files]


def grey(values, kind=np.uint8):
    return Image.fromarray(np.asarray(values).astype(kind))


def paletted(indices, colors):
    image = Image.fromarray(np.asarray(indices, np.uint8)).convert("P")
    image.putpalette(colors)
    return image


def test_an_empty_mask_with_noise_stays_empty(tmp_path):
    noise = np.random.default_rng(0).integers(0, 2, PERSON.shape)
    masks = read_all(written(tmp_path, [grey(PERSON * 255), grey(noise), grey(PERSON * 0)]))
    assert np.array_equal(masks[0] > 127, PERSON)
    assert masks[1].max() <= 1
    assert not masks[2].any()


def test_a_dark_file_of_16_bits_is_as_dark_as_its_folder_says(tmp_path):
    masks = read_all(written(tmp_path, [grey(PERSON * 65535, np.uint16), grey(PERSON * 0 + 255, np.uint16)]))
    assert np.array_equal(masks[0], PERSON * np.uint8(255))
    assert masks[1].max() <= 1


@pytest.mark.parametrize("white", [255, 1023, 4095, 65535])
def test_white_of_16_bits_is_the_folders_largest_value(tmp_path, white):
    ramp = np.linspace(0, white, PERSON.size).reshape(PERSON.shape)
    masks = read_all(written(tmp_path, [grey(PERSON * white, np.uint16), grey(ramp / 2, np.uint16)]))
    assert np.array_equal(masks[0], PERSON * np.uint8(255))
    assert np.abs(masks[1] - ramp / white * 127.5).max() <= 1


def test_one_transparent_pixel_makes_no_cut_out(tmp_path):
    opacity = np.full(PERSON.shape, 255)
    opacity[0, 0] = 254
    images = [Image.fromarray(np.dstack([PERSON * 255] * 3 + [alpha]).astype(np.uint8)) for alpha in (opacity, opacity)]
    for mask in read_all(written(tmp_path, images)):
        assert np.array_equal(mask > 127, PERSON)


def test_a_cut_out_whose_person_fills_one_file_is_still_a_cut_out(tmp_path):
    color = np.random.default_rng(0).integers(0, 255, (*PERSON.shape, 3))
    images = [Image.fromarray(np.dstack([color, alpha]).astype(np.uint8)) for alpha in (PERSON * 255, PERSON * 0 + 255)]
    first, second = read_all(written(tmp_path, images))
    assert np.array_equal(first > 127, PERSON)
    assert (second == 255).all()


def test_zeros_and_ones_in_all_files_are_the_person(tmp_path):
    masks = read_all(written(tmp_path, [grey(PERSON), grey(PERSON * 0), grey(PERSON * 1, np.uint16)]))
    assert np.array_equal(masks[0], PERSON * np.uint8(255))
    assert not masks[1].any()
    assert np.array_equal(masks[2], PERSON * np.uint8(255))


def test_labels_of_several_objects_are_asked_about(tmp_path):
    two = PERSON.astype(np.uint8)
    two[12:20, 20:25] = 2
    with pytest.raises(TwofoldError, match="reach only 2: are they labels of several objects or body parts"):
        mask_values(written(tmp_path, [grey(PERSON), grey(two)]))


@pytest.mark.parametrize("white_first", [True, False])
def test_grey_palettes_are_brightness_whichever_index_comes_first(tmp_path, white_first):
    image = paletted(white_first != PERSON, [255, 255, 255, 0, 0, 0] if white_first else [0, 0, 0, 255, 255, 255])
    (mask,) = read_all(written(tmp_path, [image]))
    assert np.array_equal(mask, PERSON * np.uint8(255))


def test_black_is_outside_in_palettes_of_colours(tmp_path):
    files = written(tmp_path, [paletted(~PERSON, [128, 0, 0, 0, 0, 0]), paletted(PERSON, [0, 0, 0, 128, 0, 0])])
    for mask in read_all(files):
        assert np.array_equal(mask, PERSON * np.uint8(255))


def test_objects_that_differ_between_files_are_several(tmp_path):
    colors = [0, 0, 0, 128, 0, 0, 0, 128, 0]
    files = written(tmp_path, [paletted(PERSON * 1, colors), paletted(PERSON * 2, colors)])
    with pytest.raises(TwofoldError, match="marks 2 objects"):
        mask_values(files)
