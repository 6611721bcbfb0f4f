"""Bodies over their images, from the side and from above: what is where, and in which colour."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from PIL import Image

from twofold.capture.types import Frame
from twofold.check.body_pictures import CELL, FIT_PICTURE, FLOOR, beside, overlay, unfilmed_view, write_fit_picture
from twofold.check.frame_measures import side_of_faces
from twofold.geometry.cameras import Camera, project

SMALL = (90, 120)


def test_overlays_tint_left_limbs_orange_and_right_ones_blue(turner_read, turner_shaped, tmp_path):
    Image.new("RGB", (96, 96)).save(tmp_path / "black.png")
    frame = replace(turner_read.train[0], image_file=tmp_path / "black.png")
    image = overlay(frame, turner_shaped, side_of_faces(turner_shaped), SMALL).astype(int)
    assert image.shape == (120, 90, 3)
    red, blue = (image[..., k] - image[..., 2 - k] for k in (0, 2))
    # It faces the camera, so its left is at the right.
    assert np.nonzero(red > 60)[1].mean() > np.nonzero(blue > 60)[1].mean() + 15
    assert ((image[..., :2].min(-1) > 170) & (image[..., 2] < 150)).sum() > 50


def filmed_from(frame: Frame, center) -> Frame:
    """The frame as a camera at another place would have it; only the place matters here."""
    view = torch.eye(4)
    view[:3, 3] = -torch.tensor(center)
    return replace(frame, camera=Camera(view, frame.camera.intrinsics, frame.camera.height, frame.camera.width))


def test_the_filming_camera_stands_at_the_left_and_from_above_at_the_bottom(turner_read):
    frame, pelvis = filmed_from(turner_read.train[0], [3.0, 1.0, 2.0]), torch.tensor([0.1, 0.9, 0.0])
    side, above = (beside(frame, pelvis, 1.7, look, SMALL) for look in (False, True))
    toward = pelvis + 0.2 * (frame.camera.center - pelvis)
    head = pelvis + torch.tensor([0.0, 0.7, 0.0])
    pixels = project(side, torch.stack([pelvis, toward, head]))[0]
    assert pixels[1, 0] < pixels[0, 0] - 5
    assert pixels[2, 1] < pixels[0, 1] - 5
    assert abs(float(pixels[2, 0] - pixels[0, 0])) < 1e-3
    pixels = project(above, torch.stack([pelvis, toward]))[0]
    assert pixels[1, 1] > pixels[0, 1] + 5
    for camera in (side, above):
        rotation = camera.world_to_camera[:3, :3]
        torch.testing.assert_close(rotation @ rotation.T, torch.eye(3), atol=1e-6, rtol=0)
        assert float(torch.linalg.det(rotation)) == pytest.approx(1)


@pytest.mark.parametrize("above", [False, True])
def test_a_person_seen_from_in_front_shows_the_left_side_beside(turner_read, turner_shaped, above):
    """Filmed along +z the person's left is at +x; the camera beside stands at -x or +x, never in front."""
    frame = turner_read.train[0]
    still = replace(frame, pose=torch.zeros(24, 3), translation=torch.zeros(3))
    picture = unfilmed_view(
        filmed_from(still, [0.0, 1.0, 4.0]), turner_shaped, side_of_faces(turner_shaped), above, 0.0, SMALL
    )
    red = (picture[..., 0].astype(int) - picture[..., 2] > 60).sum()
    blue = (picture[..., 2].astype(int) - picture[..., 0] > 60).sum()
    if above:
        columns = [
            np.nonzero(m)[1].mean()
            for m in (
                picture[..., 0].astype(int) - picture[..., 2] > 60,
                picture[..., 2].astype(int) - picture[..., 0] > 60,
            )
        ]
        # Looking down with the filming camera at the bottom, the person's left is at the right, as that camera has it.
        assert columns[0] > columns[1] + 10
        assert abs(red - blue) < 0.5 * max(red, blue)
    else:
        # One of the two sides hides the other.
        assert max(red, blue) > 3 * min(red, blue)


def test_the_floor_is_a_line_below_the_feet_and_floating_shows(turner_read, turner_shaped):
    frame = filmed_from(
        replace(turner_read.train[0], pose=torch.zeros(24, 3), translation=torch.zeros(3)), [0.0, 1.0, 4.0]
    )
    sides = side_of_faces(turner_shaped)
    usual = float(turner_shaped.joints[[7, 8, 10, 11], 1].mean())

    def gap(lifted: float) -> int:
        moved = replace(frame, translation=torch.tensor([0.0, lifted, 0.0]))
        picture = unfilmed_view(moved, turner_shaped, sides, False, usual, SMALL).astype(int)
        (row,) = np.flatnonzero((picture[:, 0] == FLOOR).all(-1))
        body = (np.abs(picture - picture[0, 0]) > 30).any(-1) & ~(picture == FLOOR).all(-1)
        return int(row - np.flatnonzero(body.any(1)).max())

    assert -1 <= gap(0.0) <= 2
    assert gap(0.1) >= gap(0.0) + 3


def test_the_picture_of_a_fit_has_four_frames_from_three_sides(turner_read, tmp_path):
    path = write_fit_picture(turner_read, tmp_path, 0.0)
    assert path == tmp_path / FIT_PICTURE
    with Image.open(path) as picture:
        assert picture.size == (6 * CELL[0], 2 * CELL[1])
