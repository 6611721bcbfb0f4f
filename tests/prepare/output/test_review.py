"""The fitted body held against images: how much it covers, how far landmarks are off, and what is no person."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from acting import HEIGHT, WIDTH, acted, landmarks, overlap, silhouettes, standing_camera, the_body
from disk import files_end_at
from PIL import Image, ImageDraw

from twofold.errors import TwofoldError
from twofold.prepare.detect.scan import Watched
from twofold.prepare.output.review import compare_with_pictures

MOMENTS = 8
CAMERA = standing_camera(0.4)
SHIRT, WALL, BALL = (180, 60, 60), (90, 110, 130), (20, 230, 40)


def filmed(folder, motion=None, balls=()):
    """Images of somebody in one colour; in some frames a ball (column, row, radius) covers a part of them."""
    body = the_body()
    motion = motion or acted(body, MOMENTS)
    images, masks = [], []
    folder.mkdir(exist_ok=True)
    for time, mask in enumerate(silhouettes(body, motion, CAMERA)):
        image = np.where(mask[..., None] > 0, np.uint8(SHIRT), np.uint8(WALL)).astype(np.uint8)
        original, outline = Image.fromarray(image), Image.fromarray(mask)
        for when, (column, row, radius) in balls:
            if when == time:
                box = (column - radius, row - radius, column + radius, row + radius)
                ImageDraw.Draw(original).ellipse(box, fill=BALL)
                ImageDraw.Draw(outline).ellipse(box, fill=255)
        images.append(folder / f"{time}.jpg")
        masks.append(folder / f"{time}.png")
        original.save(images[-1], quality=95, subsampling=0)
        outline.save(masks[-1])
    track = landmarks(body, motion, CAMERA)
    times = tuple(range(MOMENTS))
    return Watched(tuple(images), tuple(masks), track, times, tuple(t / 10 for t in times), times, 0.0, ())


def compared(watched, motion=None, held="remove", alone=True, size=150.0, progress=lambda done: None):
    body = the_body()
    return compare_with_pictures(
        "cam", CAMERA, watched, body, motion or acted(body, MOMENTS), size, held, alone, progress
    )  # fmt: skip


def read(path):
    with Image.open(path) as image:
        return np.asarray(image)


def test_the_truth_agrees(tmp_path):
    told = []
    agreement = compared(filmed(tmp_path / "a"), progress=told.append)
    assert [quality.frame_index for quality in agreement.qualities] == list(range(MOMENTS))
    for quality in agreement.qualities:
        assert quality.camera == "cam"
        assert quality.iou > 0.999
        assert quality.reprojection < 0.01
        assert quality.visibility == pytest.approx(0.95)
        assert not quality.fault
    assert agreement.ignored == {}
    assert told == sorted(told)
    assert told[-1] == pytest.approx(1)


def test_overlap_is_that_of_silhouette_and_mask(tmp_path):
    body, motion = the_body(), acted(the_body(), MOMENTS)
    watched = filmed(tmp_path / "a")
    aside = replace(motion, translation=motion.translation + torch.tensor([0.15, 0.1, 0.0]))
    agreement = compared(watched, aside, held="keep")
    expected = overlap(silhouettes(body, aside, CAMERA), [read(path) for path in watched.masks])
    np.testing.assert_allclose([q.iou for q in agreement.qualities], expected, atol=1e-3)
    shift = landmarks(body, aside, CAMERA).pixels - watched.track.pixels
    error = np.linalg.norm(shift, axis=-1).mean(1)
    np.testing.assert_allclose([q.reprojection for q in agreement.qualities], error, rtol=1e-4)
    np.testing.assert_allclose([q.reprojection_percent for q in agreement.qualities], error / 1.5, rtol=1e-4)


def test_bad_frames_are_found_and_only_these(tmp_path):
    motion = acted(the_body(), MOMENTS)
    wrong = motion.translation.clone()
    wrong[3] += torch.tensor([0.5, 0.0, 0.0])
    agreement = compared(filmed(tmp_path / "a"), replace(motion, translation=wrong))
    assert [bool(quality.fault) for quality in agreement.qualities] == [k == 3 for k in range(MOMENTS)]


def test_a_body_behind_the_camera_covers_nothing(tmp_path):
    motion = acted(the_body(), MOMENTS)
    behind = motion.translation.clone()
    behind[2] += 2 * CAMERA.center
    agreement = compared(filmed(tmp_path / "a"), replace(motion, translation=behind))
    assert agreement.qualities[2].iou == 0
    assert agreement.qualities[2].fault
    assert agreement.qualities[1].iou > 0.95


def test_an_empty_mask_agrees_with_nothing(tmp_path):
    watched = filmed(tmp_path / "a")
    Image.fromarray(np.zeros((HEIGHT, WIDTH), np.uint8)).save(watched.masks[5])
    agreement = compared(watched)
    assert agreement.qualities[5].iou == 0
    assert "mask" in agreement.qualities[5].fault
    assert agreement.ignored == {}


def hand(time, side="left"):
    """Where a wrist is, (column, row)."""
    index = 15 if side == "left" else 16
    return landmarks(the_body(), acted(the_body(), MOMENTS), CAMERA).pixels[time, index].round().astype(int).tolist()


def test_a_ball_leaves_the_mask_and_is_ignored(tmp_path):
    column, row = hand(4)
    passing = [(3, (column + 12, row - 10, 13)), (4, (column + 12, row + 8, 13)), (5, (column + 12, row + 26, 13))]
    watched = filmed(tmp_path / "a", balls=passing)
    before = [read(path) for path in watched.masks]
    agreement = compared(watched)
    assert sorted(agreement.ignored) == sorted(agreement.removed) == [3, 4, 5]
    ball = np.hypot(*np.meshgrid(np.arange(WIDTH) - column - 12, np.arange(HEIGHT) - row - 8)) < 12
    beside = ball & (silhouettes(the_body(), acted(the_body(), MOMENTS), CAMERA)[4] == 0)
    mask, ignored = read(watched.masks[4]), read(agreement.ignored[4])
    assert set(np.unique(ignored)) == {0, 255}
    assert (ignored[ball] == 255).mean() > 0.9
    assert (mask[beside] > 127).mean() < 0.1
    # What is ignored counts neither for nor against the fit.
    assert agreement.qualities[4].iou > 0.95
    for time in set(range(MOMENTS)) - {3, 4, 5}:
        assert np.array_equal(read(watched.masks[time]), before[time])


def test_held_objects_may_be_kept(tmp_path):
    column, row = hand(4)
    watched = filmed(tmp_path / "a", balls=[(4, (column + 12, row + 8, 13))])
    before = read(watched.masks[4])
    agreement = compared(watched, held="keep")
    assert agreement.ignored == {}
    assert np.array_equal(read(watched.masks[4]), before)
    assert sorted(path.suffix for path in (tmp_path / "a").iterdir()) == [".jpg"] * MOMENTS + [".png"] * MOMENTS


def test_what_is_seen_once_or_keeps_to_the_body_stays(tmp_path):
    """A patch of another colour on the shirt in every image, and a ball in one."""
    column, row = hand(4)
    watched = filmed(tmp_path / "once", balls=[(4, (column + 12, row + 8, 13))])
    assert compared(watched).ignored == {}
    watched = filmed(tmp_path / "held", balls=[(t, (hand(t)[0] + 4, hand(t)[1] + 4, 13)) for t in range(3, 8)])
    assert compared(watched).ignored == {}


def test_a_full_disk_is_said_in_one_sentence(tmp_path):
    column, row = hand(4)
    passing = [(3, (column + 12, row - 10, 13)), (4, (column + 12, row + 8, 13)), (5, (column + 12, row + 26, 13))]
    watched = filmed(tmp_path / "a", balls=passing)
    with files_end_at(100), pytest.raises(TwofoldError, match=r"^Cannot write .*: .*\.$"):
        compared(watched)
