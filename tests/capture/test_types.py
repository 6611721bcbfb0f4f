"""Frames read their images when asked."""

import itertools
from dataclasses import replace

import numpy as np
import pytest
import torch
from PIL import Image

from twofold.capture.folder import read_capture
from twofold.capture.types import spread, steady_video


def test_a_frame_reads_colours_and_mask_as_shares_of_one(tiny):
    frame = read_capture(tiny).train[2]
    image, mask = frame.image(), frame.mask()
    assert image.shape == (40, 48, 3)
    assert mask.shape == (40, 48)
    torch.testing.assert_close(image[mask == 1], torch.tensor([200, 100, 50]).expand(int(mask.sum()), 3) / 255)
    torch.testing.assert_close(image[mask == 0], torch.full((int((mask == 0).sum()), 3), 32 / 255))


def test_a_grey_image_and_a_bilevel_mask_are_read_as_well(tiny):
    frame = read_capture(tiny).train[0]
    Image.fromarray(np.full((40, 48), 51, np.uint8)).save(frame.image_file)
    with Image.open(frame.mask_file) as image:
        before = frame.mask()
        bilevel = image.convert("1")
    bilevel.save(frame.mask_file)
    assert frame.image().unique().tolist() == [torch.tensor(0.2).item()]
    torch.testing.assert_close(frame.mask(), before)


def test_images_are_read_anew_each_time(tiny):
    """A long capture costs no memory: nothing is kept."""
    frame = read_capture(tiny).train[0]
    first = frame.image()
    Image.fromarray(np.zeros((40, 48, 3), np.uint8)).save(frame.image_file)
    assert first.max() > 0
    assert frame.image().max() == 0


def test_train_is_the_train_split(tiny):
    capture = read_capture(tiny)
    assert capture.train is capture.splits["train"]
    assert [frame.frame_index for frame in capture.train] == [0, 1, 2, 3]


def test_ignored_pixels_are_read_and_none_are_where_there_is_no_file(tiny):
    assert not read_capture(tiny).train[1].ignored().any()
    layer = np.zeros((40, 48), np.uint8)
    layer[3:9, 5:7] = 255
    (tiny / "ignored/front").mkdir(parents=True)
    Image.fromarray(layer).save(tiny / "ignored/front/000001.png")
    frames = read_capture(tiny).train
    assert torch.equal(frames[1].ignored(), torch.from_numpy(layer > 0))
    assert not frames[2].ignored().any()


@pytest.mark.parametrize(
    ("count", "most"), [(0, 3), (1, 3), (5, 2), (7, 3), (7, 7), (7, 99), (7, 1), (7, 0), (7, None)]
)
def test_items_are_spread_evenly_from_the_first_to_the_last(count, most):
    chosen = spread(range(count), most)
    assert len(chosen) == min(count, count if most is None else most)
    if len(chosen) > 1:
        gaps = [b - a for a, b in itertools.pairwise(chosen)]
        assert (chosen[0], chosen[-1]) == (0, count - 1)
        assert max(gaps) - min(gaps) <= 1


def test_a_video_is_the_longest_run_of_one_camera_without_gaps(tiny):
    capture = read_capture(tiny)
    frame = capture.splits["train"][0]
    moved = replace(frame.camera, world_to_camera=torch.eye(4) + 0.1)
    frames = [replace(frame, frame_index=t, camera_name="a") for t in (0, 2, 4, 9, 11, 13, 15)]
    frames += [
        replace(frame, frame_index=t, camera_name="b", camera=moved if t > 4 else frame.camera) for t in range(8)
    ]
    splits = {**capture.splits, "novel_pose": tuple(frames[::-1])}
    chosen = steady_video(replace(capture, splits=splits))
    assert {f.camera_name for f in chosen} == {"b"}
    assert [f.frame_index for f in chosen] == [0, 1, 2, 3, 4]
    assert len(steady_video(replace(capture, splits=splits), 3)) == 3
    alone = {"train": (frame,), "novel_view": (), "novel_pose": (frame,)}
    assert steady_video(replace(capture, splits=alone)) == []
