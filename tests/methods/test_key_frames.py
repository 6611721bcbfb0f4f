import math
from dataclasses import replace

import pytest
import torch

from twofold.errors import TwofoldError
from twofold.methods.key_frames import BACK, FRONT, chosen_frames, facing_angle, read_key_frames


def turned(frame, angle: float, bend: float = 0.0):
    """The frame's body turned about the vertical so far from facing +z, one elbow bent."""
    pose = torch.zeros(24, 3)
    pose[0, 1], pose[18, 0] = angle, bend
    return replace(frame, pose=pose)


def test_angle_is_pi_for_a_body_that_faces_the_camera(person):
    front = next(f for f in person.train if f.camera_name == "front")
    for angle in (0.0, 0.7, 2.0, math.pi):
        assert facing_angle(turned(front, angle)) == pytest.approx(math.pi - angle, abs=1e-3)


def test_pair_is_the_most_alike_of_those_that_show_front_and_back(person):
    generator = torch.Generator().manual_seed(0)
    front = next(f for f in person.train if f.camera_name == "front")
    angles, bends = (7 * torch.rand(30, generator=generator)).tolist(), torch.rand(30, generator=generator).tolist()
    frames = tuple(turned(front, a, b) for a, b in zip(angles, bends, strict=True))
    best, pair = math.inf, None
    for one in frames:
        for other in frames:
            if facing_angle(one) < FRONT or facing_angle(other) > BACK:
                continue
            distance = float((one.pose[1:] - other.pose[1:]).norm())
            if distance < best:
                best, pair = distance, (one, other)
    assert pair is not None
    found = chosen_frames(frames)
    assert found[0] is pair[0]
    assert found[1] is pair[1]


def test_frames_that_come_closest_stand_in_where_no_back_is_shown(person):
    front = next(f for f in person.train if f.camera_name == "front")
    frames = tuple(turned(front, angle) for angle in (0.1, 0.9, 1.2))
    found = chosen_frames(frames)
    assert found[0] is frames[0]
    assert found[1] is frames[2]
    assert len(chosen_frames(frames[:1])) == 2


def test_images_are_on_black_and_large_enough(person):
    keys = read_key_frames(person, (0, 3))
    assert keys.images.shape == (2, 3, 64, 64)
    frame = next(f for f in person.train if f.frame_index == 3)
    expected = (255 * frame.image() * frame.mask()[..., None]).permute(2, 0, 1)
    assert (keys.images[1, :, :48, :48] - expected).abs().max() <= 0.51
    assert not keys.images[:, :, 48:].any()
    point = torch.tensor([0.1, -0.3, 0.05, 1.0])
    u, v, w = keys.projections[1] @ point
    in_camera = frame.camera.world_to_camera @ point
    ray = frame.camera.intrinsics @ in_camera[:3]
    assert torch.allclose(torch.stack([u, v]) / w, ray[:2] / ray[2])


def test_key_frames_that_do_not_exist_are_one_sentence(person):
    with pytest.raises(TwofoldError, match=r"key_frames names frame 77, which is not among the training frames"):
        read_key_frames(person, (0, 77))
