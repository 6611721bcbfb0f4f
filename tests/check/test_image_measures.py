"""Backgrounds that move or change, and faces where none should be."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from filmed import wall
from PIL import Image
from skimage import data

from twofold.body.skeleton import JOINT_NAMES, joint_transforms
from twofold.check.frame_measures import turned_round
from twofold.check.image_measures import background_of, sees_a_face, shows_its_back
from twofold.geometry.cameras import project


def filmed(turner_read, tmp_path, change):
    """The first training frames with images changed by a function of their bytes and number."""
    frames = []
    for number, frame in enumerate(turner_read.train[:4]):
        with Image.open(frame.image_file) as original:
            image = change(np.array(original), number)
        Image.fromarray(image).save(tmp_path / f"{number}.png")
        frames.append(replace(frame, image_file=tmp_path / f"{number}.png"))
    return frames


def test_a_wall_that_stands_still_does(turner_read):
    found = background_of(turner_read.train[:6])
    assert found.shift == 0
    assert found.times == (1, 2, 3, 4, 5)
    assert all(abs(b - 1) < 0.02 for b in found.brightness)


def test_a_wall_that_moves_does_by_so_much(turner_read, tmp_path):
    still, moved = (255 * wall()).numpy().astype(np.uint8), (255 * wall()).roll((0, 6), (0, 1)).numpy().astype(np.uint8)
    frames = filmed(turner_read, tmp_path, lambda image, number: moved if number == 2 else still)
    assert background_of(frames).shift == pytest.approx(6 / 96, abs=0.011)


def test_a_person_who_moves_alone_moves_no_wall(turner_read):
    assert background_of(turner_read.train).shift == 0


def test_brightness_is_told_against_the_first(turner_read, tmp_path):
    frames = filmed(turner_read, tmp_path, lambda image, number: (image * (1 - 0.2 * number)).astype(np.uint8))
    assert background_of(frames).brightness == pytest.approx((0.8, 0.6, 0.4), abs=0.02)


def test_a_plain_background_tells_nothing(turner_read, tmp_path):
    frames = filmed(turner_read, tmp_path, lambda image, number: np.full_like(image, 40 * number))
    assert background_of(frames).shift is None
    assert background_of(frames).brightness == ()
    assert background_of(frames[:1]).shift is None


def test_who_faces_away_shows_the_back(turner_read, turner_shaped):
    front, back = turner_read.train[0], turner_read.train[12]
    assert not shows_its_back(front, turner_shaped)
    assert shows_its_back(back, turner_shaped)
    assert shows_its_back(replace(front, pose=turned_round(front.pose)), turner_shaped)


@pytest.mark.parametrize("lean", [0.0, 0.7])
def test_a_face_is_seen_where_the_head_is_and_only_there(turner_read, turner_shaped, tmp_path, lean):
    frame = turner_read.train[0]
    pose = frame.pose.clone()
    pose[0] = torch.tensor([0.0, 0.0, lean])
    camera = replace(
        frame.camera, height=768, width=768, intrinsics=torch.diag(torch.tensor([8.0, 8, 1])) @ frame.camera.intrinsics
    )
    frame = replace(frame, camera=camera, pose=pose, image_file=tmp_path / "image.png")
    joints = turner_shaped.joints
    transforms = joint_transforms(joints, pose, frame.translation)
    head = JOINT_NAMES.index("head")
    place, depth = project(camera, transforms[head, :3, :3] @ joints[head] + transforms[head, :3, 3])
    # The photograph that scikit-image brings: a face 100 pixels wide in the middle of this part.
    face = Image.fromarray(data.astronaut()[20:220, 120:320])
    size = round(0.4 * float(camera.intrinsics[0, 0]) / float(depth))
    image = Image.new("RGB", (768, 768), (90, 120, 100))
    turned = face.resize((size, size)).rotate(-57.3 * -lean, fillcolor=(90, 120, 100))
    image.paste(turned, (round(float(place[0])) - size // 2, round(float(place[1])) - size // 2))
    image.save(tmp_path / "image.png")
    assert sees_a_face(frame, turner_shaped)
    Image.new("RGB", (768, 768), (90, 120, 100)).save(tmp_path / "image.png")
    assert not sees_a_face(frame, turner_shaped)
