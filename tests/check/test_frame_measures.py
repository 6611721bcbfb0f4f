"""Bodies in images: points on the skin, twins, windows, silhouettes, and what an image tells."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from little_body import JOINTS
from PIL import Image
from scipy import ndimage

from twofold.body.skeleton import JOINT_NAMES, joint_transforms
from twofold.check.frame_measures import (
    frame_facts,
    look_at,
    mirrored_pose,
    posed_points,
    read_mask,
    side_of_faces,
    splat,
    stature,
    surface_points,
    turned_round,
    window_of,
)
from twofold.geometry.cameras import project
from twofold.geometry.raster import rasterize
from twofold.geometry.silhouettes import overlap

OTHER = [JOINT_NAMES.index(n.replace("left", "x").replace("right", "left").replace("x", "right")) for n in JOINT_NAMES]


def joints_of(pose):
    joints = torch.tensor(JOINTS)
    transforms = joint_transforms(joints, pose, torch.zeros(3))
    return (transforms[:, :3, :3] @ joints[:, :, None])[..., 0] + transforms[:, :3, 3]


@pytest.fixture
def pose(generator):
    pose = 0.5 * torch.randn(24, 3, generator=generator)
    pose[0] = 0
    return pose


def test_the_mirrored_pose_puts_each_joint_where_the_other_side_had_it(pose):
    pelvis = torch.tensor(JOINTS[0])
    mirrored = (joints_of(pose)[OTHER] - pelvis) * torch.tensor([-1.0, 1, 1]) + pelvis
    torch.testing.assert_close(joints_of(mirrored_pose(pose)), mirrored, atol=1e-5, rtol=0)
    torch.testing.assert_close(mirrored_pose(mirrored_pose(pose)), pose)


def test_who_is_turned_round_keeps_the_limbs_where_they_were_as_seen_from_the_front(pose):
    pelvis = torch.tensor(JOINTS[0])
    reversed_ = (joints_of(pose)[OTHER] - pelvis) * torch.tensor([1.0, 1, -1]) + pelvis
    torch.testing.assert_close(joints_of(turned_round(pose)), reversed_, atol=1e-5, rtol=0)


def test_points_lie_on_the_skin_and_each_face_has_its_share(turner_shaped):
    count = 20000
    points = surface_points(turner_shaped, count)
    a, b, c = (turner_shaped.vertices[turner_shaped.faces[:, k]] for k in range(3))
    normal = torch.linalg.cross(b - a, c - a)
    area = normal.norm(dim=-1).double()
    # The face of each point is the one in whose plane and triangle it lies; in order, because the steps are.
    face = torch.searchsorted(area.cumsum(0), (torch.arange(count).double() + 0.5) * area.sum() / count)
    off_plane = ((points.vertices - a[face]) * torch.nn.functional.normalize(normal, dim=-1)[face]).sum(-1)
    assert off_plane.abs().max() < 1e-5
    shares = torch.bincount(face, minlength=len(area)) / count
    assert (shares - area / area.sum()).abs().max() < 1.01 / count
    torch.testing.assert_close(points.weights.sum(-1), torch.ones(count))
    assert (points.weights >= 0).all()


def test_points_cover_the_pixels_that_the_faces_cover(turner_read, turner_shaped):
    frame = turner_read.train[3]
    camera = frame.camera
    hits = rasterize(camera, posed_points(turner_shaped, frame.pose, frame.translation), turner_shaped.faces)
    exact = np.zeros(camera.height * camera.width, bool)
    exact[hits.pixel] = True
    cloud = project(camera, posed_points(surface_points(turner_shaped), frame.pose, frame.translation))
    rough = splat(*cloud, camera.height, camera.width)
    exact = exact.reshape(rough.shape)
    # A point covers the pixel that it falls into, a face only pixels whose middle it covers.
    assert (exact & ~rough).sum() < 0.01 * exact.sum()
    around = ndimage.binary_closing(ndimage.binary_dilation(np.pad(exact, 3), np.ones((3, 3))), np.ones((3, 3)))
    assert not (rough & ~around[3:-3, 3:-3]).any()
    assert overlap(exact, rough) > 0.8


def test_a_splat_is_the_closing_of_its_points(generator):
    pixels = 30 * torch.rand(60, 2, generator=generator) - 2
    depth = torch.rand(60, generator=generator) - 0.2
    slow = np.zeros((24, 20), bool)
    for (x, y), z in zip(pixels.round().long().tolist(), depth.tolist(), strict=True):
        if z > 0 and 0 <= x < 20 and 0 <= y < 24:
            slow[y, x] = True
    closed = ndimage.binary_closing(np.pad(slow, 5), np.ones((3, 3)))[5:-5, 5:-5]
    assert np.array_equal(splat(pixels, depth, 24, 20), closed)


def test_a_window_shows_the_same_points_as_the_image(turner_read):
    frame = turner_read.train[0]
    mask = read_mask(frame)
    window = window_of(frame.camera, mask, torch.empty(0, 2), 40)
    assert max(window.camera.height, window.camera.width) == 40
    left, top, right, bottom = window.box
    rows, columns = np.nonzero(mask > 127)
    assert left <= columns.min()
    assert columns.max() < right
    assert top <= rows.min()
    assert rows.max() < bottom
    point = torch.tensor([0.1, 0.2, 0.1])
    there, here = project(frame.camera, point)[0], project(window.camera, point)[0]
    scale = torch.tensor([window.camera.width / (right - left), window.camera.height / (bottom - top)])
    torch.testing.assert_close(here + 0.5, (there + 0.5 - torch.tensor([left, top])) * scale)


def test_a_window_takes_the_shape_asked_for_as_far_as_the_image_reaches(turner_read):
    frame = turner_read.train[0]
    mask = np.zeros((96, 96), np.uint8)
    mask[30:50, 40:44] = 255
    left, top, right, bottom = window_of(frame.camera, mask, torch.empty(0, 2), 300, aspect=0.75).box
    assert abs((right - left) / (bottom - top) - 0.75) < 0.1
    mask[:, 40:44] = 255
    assert window_of(frame.camera, mask, torch.empty(0, 2), 300, aspect=2.0).box == (0, 0, 96, 96)


def test_the_body_agrees_with_the_mask_it_made(turner_read, turner_shaped, turner_points):
    facts = frame_facts(turner_read.train[2], "train", turner_shaped, turner_points)
    assert facts.iou > 0.97
    assert abs(facts.size_ratio - 1) < 0.02
    assert max(map(abs, facts.offset)) < 0.01
    assert facts.body_outside == 0
    assert facts.twins.given > facts.twins.sides + 0.1
    assert facts.twins.given > facts.twins.facing + 0.1
    tall = 96 * stature(turner_shaped) / 2.5
    assert abs(facts.body_height / tall - 1) < 0.15


def test_where_something_is_ignored_nothing_counts(turner_read, turner_shaped, turner_points, tmp_path):
    frame = turner_read.train[2]
    mask = read_mask(frame).copy()
    hidden = np.zeros_like(mask)
    hidden[30:60, 30:60] = 255
    mask[hidden > 0] = 0
    Image.fromarray(mask).save(tmp_path / "mask.png")
    Image.fromarray(hidden).save(tmp_path / "ignored.png")
    cut = replace(frame, mask_file=tmp_path / "mask.png")
    assert frame_facts(cut, "train", turner_shaped, turner_points).iou < 0.8
    known = replace(cut, ignored_file=tmp_path / "ignored.png")
    assert frame_facts(known, "train", turner_shaped, turner_points).iou > 0.95


def test_a_mask_twice_as_large_and_to_the_right_is_told(turner_read, turner_shaped, turner_points, tmp_path):
    frame = turner_read.train[2]
    body = look_at(frame, turner_shaped, read_mask(frame)).body.sum()
    mask = np.zeros((96, 96), np.uint8)
    side = round(2 * math.sqrt(body))
    mask[-side - 2 : -2, -side:] = 255
    Image.fromarray(mask).save(tmp_path / "mask.png")
    facts = frame_facts(replace(frame, mask_file=tmp_path / "mask.png"), "train", turner_shaped, turner_points)
    assert facts.size_ratio == pytest.approx(side / math.sqrt(body), rel=0.1)
    assert facts.offset[0] > 0.1
    assert facts.mask.borders == ("right",)


def test_blur_takes_the_details(turner_read, turner_shaped, turner_points, tmp_path):
    noise = np.random.default_rng(0).integers(0, 255, (96, 96, 3), dtype=np.uint8)
    found = []
    for name, image in (("sharp", noise), ("soft", ndimage.gaussian_filter(noise, (2, 2, 0)))):
        Image.fromarray(image).save(tmp_path / f"{name}.png")
        frame = replace(turner_read.train[2], image_file=tmp_path / f"{name}.png")
        found.append(frame_facts(frame, "train", turner_shaped, turner_points).sharpness)
    assert found[1] < 0.2 * found[0]


def test_faces_belong_to_the_side_of_their_limb(turner_shaped):
    sides = side_of_faces(turner_shaped)
    middle = turner_shaped.vertices[turner_shaped.faces].mean(1)
    assert (middle[sides == 1, 0] > 0.03).all()
    assert (middle[sides == 2, 0] < 0.03).all()
    assert (sides == 0).sum() > 100
    assert (sides == 1).sum() > 100
