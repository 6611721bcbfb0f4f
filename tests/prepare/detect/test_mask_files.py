import dataclasses

import numpy as np
import pytest
from made_clips import corners, grey, write_clip
from PIL import Image

from twofold.errors import TwofoldError
from twofold.prepare.detect.mask_files import masks_from_folder
from twofold.prepare.detect.mask_values import read_mask
from twofold.prepare.video.frames import ClipInfo, Frames, describe
from twofold.prepare.video.numbering import files_by_picture

CLIP = ClipInfo(64, 48, 25.0, 10, 0.4, 64, 48, 10)


def write_masks(folder, names, height=48, width=64):
    """Masks of which the n-th has n + 1 white rows."""
    folder.mkdir(exist_ok=True)
    for number, name in enumerate(names):
        mask = np.zeros((height, width), np.uint8)
        mask[: number + 1] = 255
        Image.fromarray(mask).save(folder / name)
    return folder


def rows(mask) -> int:
    return int((mask[:, 0] > 127).sum())


@pytest.mark.parametrize(
    "names",
    [
        [f"{i:05d}.png" for i in range(10)],
        [f"{i}.png" for i in range(1, 11)],
        [f"cam2_{i:04d}.jpg" for i in range(1001, 1011)],
        [f"{i:02d}_cam1.png" for i in range(10)],
        [f"{letter}.png" for letter in "abcdefghij"],
    ],
    ids=["from 0", "from 1", "from 1001", "same number in all", "no numbers"],
)
def test_masks_find_their_images(tmp_path, names):
    masks = masks_from_folder(write_masks(tmp_path, names), CLIP)
    assert [rows(masks(i)) for i in range(10)] == list(range(1, 11))
    assert masks(10) is None


@pytest.mark.parametrize(
    ("level", "sentence"),
    [
        (0, r"All masks in .* are black, so nobody is in them"),
        (2, r"reach only 2: are they labels of several objects"),
        (100, r"reach only 100, so nobody is in them; make the person 255"),
    ],
)
def test_masks_without_anybody_are_named_at_once(tmp_path, level, sentence):
    for number in range(10):
        Image.new("L", (64, 48), level).save(tmp_path / f"{number}.png")
    with pytest.raises(TwofoldError, match=sentence):
        masks_from_folder(tmp_path, CLIP)
    Image.new("L", (64, 48), 255).save(tmp_path / "9.png")
    assert rows(masks_from_folder(tmp_path, CLIP)(9)) == 48


@pytest.mark.parametrize("first", [0, 1, 3])
def test_numbers_may_have_gaps(tmp_path, first):
    numbers = [0, 1, 2, 4, 6, 9] if first < 2 else [0, 1, 2, 3, 4, 5]
    masks = masks_from_folder(write_masks(tmp_path, [f"{i + first}.png" for i in numbers]), CLIP)
    shift = 0 if first < 2 else 3  # Beginning with 3, they are taken as counted from 0
    seen = {n + shift: k + 1 for k, n in enumerate(numbers)}
    assert {i: rows(masks(i)) for i in range(10) if masks(i) is not None} == seen


def test_names_of_a_folder_of_images_count(tmp_path):
    write_masks(tmp_path / "pictures", ["DSC7.png", "DSC12.png", "DSC30.png"])
    masks = masks_from_folder(
        write_masks(tmp_path / "masks", ["DSC30.png", "DSC7.png"]), describe(tmp_path / "pictures")
    )
    assert (rows(masks(0)), masks(1), rows(masks(2))) == (2, None, 1)


def test_masks_follow_images_that_are_left_out_and_shrunk(tmp_path):
    clip = write_clip(tmp_path / "clip.mp4", [grey(5 * i, 96, 128) for i in range(20)], fps=20)
    frames = Frames(clip, fps=5, max_size=64)
    masks = masks_from_folder(write_masks(tmp_path / "masks", [f"{i}.png" for i in range(20)], 96, 128), frames.info)
    found = [masks(image.source) for image in frames]
    assert {mask.shape for mask in found} == {(48, 64)}
    assert [mask[:, 0].astype(float).sum() / 255 for mask in found] == pytest.approx([0.5, 2.5, 4.5, 6.5, 8.5], abs=0.1)


@pytest.mark.parametrize("form", ["L", "1", "zero or one", "P", "RGB", "RGBA", "cut out", "LA", "I;16", "jpg"])
def test_usual_forms_of_masks_mean_the_same(tmp_path, form):
    person = np.zeros((48, 64), bool)
    person[10:30, 20:40] = True
    white = (person * 255).astype(np.uint8)
    image = {
        "1": lambda: Image.fromarray(person),
        "zero or one": lambda: Image.fromarray(person.astype(np.uint8)),
        "P": lambda: palette(person),
        "RGB": lambda: Image.fromarray(white).convert("RGB"),
        "RGBA": lambda: Image.fromarray(white).convert("RGBA"),
        "cut out": lambda: Image.fromarray(np.dstack([corners(), white])),
        "LA": lambda: Image.fromarray(white).convert("LA"),
        "I;16": lambda: Image.fromarray(white.astype(np.uint16) * 257),
    }.get(form, lambda: Image.fromarray(white))()
    path = tmp_path / ("mask.jpg" if form == "jpg" else "mask.png")
    image.save(path)
    mask = read_mask(path)
    assert np.array_equal(mask > 127, person)
    if form != "jpg":
        assert set(np.unique(mask)) == {0, 255}


def palette(person):
    image = Image.fromarray(person.astype(np.uint8) * 3)
    image = image.convert("P")
    image.putpalette([0, 0, 0, 1, 1, 1, 2, 2, 2, 128, 0, 0])
    return image


def test_soft_edges_stay_soft(tmp_path):
    Image.fromarray(np.arange(256, dtype=np.uint8).reshape(16, 16)).save(tmp_path / "soft.png")
    assert np.array_equal(read_mask(tmp_path / "soft.png").ravel(), np.arange(256))
    Image.fromarray(256 * np.arange(256, dtype=np.uint16).reshape(16, 16)).save(tmp_path / "deep.png")
    assert np.array_equal(read_mask(tmp_path / "deep.png").ravel(), np.round(256 * np.arange(256) / 257))


@pytest.mark.parametrize(
    ("make", "sentence"),
    [
        (lambda p: p / "no", "does not exist"),
        (lambda p: p, "holds no images"),
        (lambda p: write_masks(p, ["a.png"]) / "a.png", "is a file, expected a folder of masks"),
        (
            lambda p: write_masks(p, [f"{i}.png" for i in range(30)]),
            "30 masks, numbered from 0 to 29, and the clip has 10",
        ),
        (lambda p: write_masks(p, ["a.png", "b.png"]), "2 masks, and the clip has 10"),
        (lambda p: write_masks(p, ["0.png", "3.png"]), "at least half"),
        (lambda p: write_masks(p, [f"{i}.png" for i in range(10)], 48, 65), "0.png has 65 x 48 pixels.*64 x 48"),
        (lambda p: write_masks(p, [f"{i}.png" for i in range(10)], 64, 48), "upright"),
    ],
)
def test_what_cannot_be_used_is_said_in_one_sentence(tmp_path, make, sentence):
    with pytest.raises(TwofoldError, match=sentence) as caught:
        masks_from_folder(make(tmp_path), CLIP)
    assert str(caught.value).endswith(".")


@pytest.mark.parametrize(
    ("pixels", "sentence"),
    [(corners(), "is a coloured image"), ("two objects", "marks 2 objects"), ("half", "is damaged")],
)
def test_images_that_are_no_masks_are_named(tmp_path, pixels, sentence):
    path = tmp_path / "3.png"
    if isinstance(pixels, str):
        marks = Image.fromarray(np.random.default_rng(0).integers(0, 3, (48, 64), np.uint8)).convert("P")
        marks.putpalette([0, 0, 0, 128, 0, 0, 0, 128, 0])
        marks.save(path)
        if pixels == "half":
            path.write_bytes(path.read_bytes()[:300])
    else:
        Image.fromarray(pixels).save(path)
    with pytest.raises(TwofoldError, match=f"3.png {sentence}"):
        read_mask(path)


def test_sizes_before_and_after_shrinking_are_both_taken(tmp_path):
    info = dataclasses.replace(CLIP, full_width=128, full_height=96)
    for height in (48, 96):
        folder = write_masks(tmp_path / str(height), [f"{i}.png" for i in range(10)], height, height * 4 // 3)
        assert masks_from_folder(folder, info)(3).shape == (48, 64)


def test_a_clip_may_be_a_little_longer_than_it_says(tmp_path):
    files = [tmp_path / f"{i}.png" for i in range(11)]
    assert list(files_by_picture(files, CLIP, "masks")) == list(range(11))
