"""The truth panel says what is not known."""

import numpy as np
import pytest
import torch
from PIL import Image

from twofold.capture.types import Frame
from twofold.geometry.cameras import Camera
from twofold.outputs.gallery import render_run, shown_truth
from twofold.training.run import load


def test_ignored_pixels_are_hatched_and_the_rest_is_the_image_on_the_background(tmp_path):
    image, mask, layer = (np.zeros(shape, np.uint8) for shape in ((20, 24, 3), (20, 24), (20, 24)))
    image[:], mask[5:15], layer[8:18, 4:20] = (255, 0, 0), 255, 255
    for name, pixels in (("image", image), ("mask", mask), ("ignored", layer)):
        Image.fromarray(pixels).save(tmp_path / f"{name}.png")
    files = [tmp_path / f"{name}.png" for name in ("image", "mask", "ignored")]
    frame = Frame(0, "cam", Camera(torch.eye(4), torch.eye(3), 20, 24), torch.zeros(24, 3), torch.zeros(3), *files)
    shown, hidden = shown_truth(frame, torch.tensor([0.0, 0.0, 1.0])), torch.from_numpy(layer > 0)
    assert shown[hidden].unique().tolist() == [0.5, 0.75]
    person = torch.from_numpy(mask > 0)
    assert (shown[person & ~hidden] == torch.tensor([1.0, 0.0, 0.0])).all()
    assert (shown[~person & ~hidden] == torch.tensor([0.0, 0.0, 1.0])).all()


PARTS = {
    "orbit": {"orbit", "orbit.mp4"},
    "views": {"novel_view.png"},
    "poses": {"novel_pose.png", "novel_pose.mp4"},
    "canonical": {"canonical.png"},
}


@pytest.mark.parametrize("what", [*PARTS, "all"])
def test_each_part_is_drawn_into_a_folder_that_is_not_there_yet_and_progress_goes_to_the_end(what, trained, tmp_path):
    told = []
    avatar, _ = load(trained.folder)
    render_run(avatar, trained.capture, tmp_path / "a" / "b", what, 16, None, told.append, views=3)
    made = {path.name for path in (tmp_path / "a" / "b").iterdir()}
    assert made == (set().union(*PARTS.values()) if what == "all" else PARTS[what])
    assert told == sorted(told)
    assert [share == 1 for share in told] == [False] * (len(told) - 1) + [True]
