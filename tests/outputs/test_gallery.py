"""The truth panel says what is not known."""

import numpy as np
import torch
from PIL import Image

from twofold.capture.types import Frame
from twofold.geometry.cameras import Camera
from twofold.outputs.gallery import shown_truth


def test_ignored_pixels_are_hatched_and_the_rest_is_the_picture_on_the_background(tmp_path):
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
