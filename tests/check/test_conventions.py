"""Every usual way to write a capture wrongly is recognised by its silhouettes, and a right one is left alone."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from filmed import MOMENTS, motion

from twofold.check.conventions import best_shift, diagnose, poses_elsewhere, sample_of
from twofold.check.frame_measures import mirrored_pose, posed_points, turned_round
from twofold.geometry.rotations import axis_angle_to_matrix, matrix_to_axis_angle, rigid_inverse

FLIP = torch.diag(torch.tensor([1.0, -1.0, -1.0]))
Z_UP = torch.tensor([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])


@pytest.fixture(scope="module")
def samples(turner_read, turner_points):
    frames = [*turner_read.train[::4], *turner_read.splits["novel_view"][1:4]]
    return [sample_of(frame, turner_points) for frame in frames]


def spoilt(samples, change):
    """Samples whose capture says something else, the images being the same."""
    placed = [replace(s.placed, **change(s.placed)) for s in samples]
    return [
        replace(s, placed=replace(p, points=posed_points(p.shaped, p.pose, p.translation)))
        for s, p in zip(samples, placed, strict=True)
    ]


def turned_world(rotation):
    def change(p):
        root = matrix_to_axis_angle(rotation @ axis_angle_to_matrix(p.pose[:1]))
        pelvis = p.shaped.joints[0]
        return {
            "pose": torch.cat([root, p.pose[1:]]),
            "translation": rotation @ (pelvis + p.translation) - pelvis,
        }

    return change


def raw_exchange(p):
    pose = mirrored_pose(p.pose) * torch.tensor([1.0, -1, -1])
    return {"pose": torch.cat([p.pose[:1], pose[1:]])}


def scaled_column(p, factor):
    matrix = p.world_to_camera.clone()
    matrix[:3, 3] *= factor
    return {"world_to_camera": matrix}


def zoomed(p, factor):
    return {"intrinsics": torch.diag(torch.tensor([factor, factor, 1.0])) @ p.intrinsics}


def longer(p, factor):
    intrinsics = p.intrinsics.clone()
    intrinsics[:2, :2] *= factor
    return {"intrinsics": intrinsics}


def off_center(p):
    intrinsics = p.intrinsics.clone()
    intrinsics[:2, 2] = 12.0
    return {"intrinsics": intrinsics}


def center_column(p):
    matrix = p.world_to_camera.clone()
    matrix[:3, 3] = rigid_inverse(matrix)[:3, 3]
    return {"world_to_camera": matrix}


SPOILT = {
    "OpenGL camera": lambda p: {"world_to_camera": torch.diag(torch.tensor([1.0, -1, -1, 1])) @ p.world_to_camera},
    "camera to world": lambda p: {"world_to_camera": rigid_inverse(p.world_to_camera)},
    "camera centre": center_column,
    "world turned over": turned_world(FLIP),
    "y up": turned_world(Z_UP),
    "left/right swap": lambda p: {"pose": mirrored_pose(p.pose)},
    "left/right order swapped": raw_exchange,
    "turned round": lambda p: {"pose": turned_round(p.pose)},
    "translation of the pelvis": lambda p: {"translation": p.translation + p.shaped.joints[0]},
    "turning about the origin": lambda p: {
        "translation": p.translation + p.shaped.joints[0] - axis_angle_to_matrix(p.pose[0]) @ p.shaped.joints[0]
    },
    "translation in millimetres": lambda p: {"translation": 1000 * p.translation},
    "camera in millimetres": lambda p: scaled_column(p, 1000.0),
    "camera in centimetres": lambda p: scaled_column(p, 100.0),
    "focal length x 0.5": lambda p: longer(p, 2.0),
    "intrinsics x 0.5": lambda p: zoomed(p, 2.0),
    "intrinsics x 2": lambda p: zoomed(p, 0.5),
    "principal point off the middle": off_center,
}


@pytest.mark.parametrize("name", SPOILT)
def test_each_convention_is_recognised(samples, name):
    found = diagnose(spoilt(samples, SPOILT[name]))
    assert [c.name for c in found.conventions] == [name]
    assert found.iou > 0.85 > 0.8 > found.given


def test_a_measured_size_is_tried(samples):
    found = diagnose(spoilt(samples, lambda p: longer(p, 1.4)), 1 / 1.4)
    assert [c.name for c in found.conventions] == ["focal length x 0.714"]


@pytest.mark.parametrize("side", [1, -1])
def test_mirrored_and_turned_images_are_recognised(samples, side):
    mirrored = [replace(s, mask=s.mask[:, ::-1], known=s.known[:, ::-1], to_window=_mirrored(s)) for s in samples]
    assert [c.name for c in diagnose(mirrored).conventions] == ["images mirrored"]
    turned = [replace(s, mask=np.rot90(s.mask, side), known=np.rot90(s.known, side), to_window=_turned(s, side))
              for s in samples]  # fmt: skip
    name = "images turned left" if side == 1 else "images turned right"
    assert [c.name for c in diagnose(turned).conventions] == [name]


def _mirrored(sample):
    """From pixels of a mirrored image to pixels of a mirrored window."""
    image = torch.tensor([[-1.0, 0, sample.placed.width - 1], [0, 1, 0], [0, 0, 1]])
    window = torch.tensor([[-1.0, 0, sample.mask.shape[1] - 1], [0, 1, 0], [0, 0, 1]])
    return window @ sample.to_window @ image


def _turned(sample, side):
    (height, width), size = sample.mask.shape, sample.placed.width
    left = torch.tensor([[0.0, 1, 0], [-1, 0, width - 1], [0, 0, 1]])
    right = torch.tensor([[0.0, -1, height - 1], [1, 0, 0], [0, 0, 1]])
    back_left = torch.tensor([[0.0, -1, size - 1], [1, 0, 0], [0, 0, 1]])
    back_right = torch.tensor([[0.0, 1, 0], [-1, 0, size - 1], [0, 0, 1]])
    return (left if side == 1 else right) @ sample.to_window @ (back_left if side == 1 else back_right)


def test_two_at_once_are_recognised(samples):
    def both(p):
        return SPOILT["OpenGL camera"](p) | {"translation": 1000 * p.translation}

    found = diagnose(spoilt(samples, both))
    assert {c.name for c in found.conventions} == {"OpenGL camera", "translation in millimetres"}
    assert found.iou > 0.85


def test_a_right_capture_and_a_hopeless_one_are_left_alone(samples, generator):
    right = diagnose(samples)
    assert right.conventions == ()
    assert right.given == right.iou > 0.85
    wild = diagnose(spoilt(samples, lambda p: {"pose": 2.5 * torch.randn(24, 3, generator=generator)}))
    assert wild.conventions == ()


@pytest.mark.parametrize("late", [-2, 0, 3])
def test_a_motion_that_is_early_or_late_is_found(turner_read, turner_points, late):
    poses, translations = motion()
    moved = [t.roll(late, 0) for t in (poses, translations)]
    frames = [replace(f, pose=moved[0][f.frame_index], translation=moved[1][f.frame_index]) for f in turner_read.train]
    found, gain, share = best_shift([sample_of(f, turner_points) for f in frames], *moved)
    assert found == late
    assert (gain > 0.1, share > 0.9) == (late != 0, late != 0)


def test_exchanged_images_are_found_and_right_ones_left(turner_read, turner_points):
    poses, translations = motion()
    frames = list(turner_read.train[2:5])
    other = turner_read.train[14]
    frames[1] = replace(frames[1], image_file=other.image_file, mask_file=other.mask_file)
    samples = [sample_of(f, turner_points) for f in frames]
    assert poses_elsewhere(samples, range(MOMENTS), poses, translations) == [None, 14, None]
    assert poses_elsewhere(samples[1:2], [2, 3, 4], poses, translations) == [None]
    assert poses_elsewhere(samples[1:2], [], poses, translations) == [None]
