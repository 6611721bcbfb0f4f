"""Objects are what is foreign, seen again and moves apart from the body; a subject's own body never is."""

from dataclasses import replace

import numpy as np
import pytest

from twofold.body.skeleton import pose_body, shape_body
from twofold.capture.folder import read_capture
from twofold.geometry.cameras import project
from twofold.images import read_grey, read_rgb
from twofold.prepare.output.held_objects import see_body, usual_colors
from twofold.prepare.output.object_tracks import Patch, Sighting, foreign_patches, moving_objects, without
from twofold.studio.generate import StudioConfig, make_studio

SCALE = 100.0


def patch(column, row, foreign=0.9, color=(0.9, 0.9, 0.9), area=0.04):
    disc = np.hypot(*(np.mgrid[:21, :21] - 10)) <= 10
    corner = int(row) - 10, int(column) - 10
    center = np.array([column, row], np.float32)
    return Patch(corner, disc, disc & False, center, np.array(color, np.float32), area, foreign)


def sightings(places, body=lambda t: 0.0, **options):
    """One patch at each place (None for none), before a body whose parts move by `body(t)` columns."""
    anchors = np.stack(np.meshgrid(np.arange(50, 150, 10.0), np.arange(20, 180, 10.0)), -1).reshape(-1, 2)
    return [
        Sighting(
            () if place is None else (patch(*place, **options),),
            (anchors + np.array([body(t), 0.0])).astype(np.float32), SCALE,
        )
        for t, place in enumerate(places)
    ]  # fmt: skip


def objects(found, fps=10.0):
    return [len(patches) for patches in moving_objects(found, [t / fps for t in range(len(found))])]


def test_what_falls_past_a_body_is_an_object():
    assert objects(sightings([None, (100, 40), (100, 60), (100, 90), None])) == [0, 1, 1, 1, 0]


def test_what_moves_with_the_body_is_its_own():
    """Trousers where a shirt is expected go where the hips go."""
    places = [(100 + 15 * t, 80) for t in range(5)]
    assert objects(sightings(places, body=lambda t: 15 * t)) == [0] * 5
    assert objects(sightings(places)) == [1] * 5


def test_what_has_the_persons_own_colours_is_their_own():
    """A forearm moves before the chest, and is fitted elsewhere."""
    assert objects(sightings([(100, 40), (100, 60), (100, 90)], foreign=0.2)) == [0, 0, 0]


def test_what_is_seen_once_or_twice_is_none():
    assert objects(sightings([None, (100, 40), (100, 90), None])) == [0, 0, 0, 0]


def test_patches_of_other_colours_or_sizes_are_not_followed():
    found = sightings([(100, 40), (100, 60), (100, 90)])
    other = replace(found[1].patches[0], color=np.array([0.1, 0.1, 0.5], np.float32))
    assert objects([found[0], replace(found[1], patches=(other,)), found[2]]) == [0, 0, 0]
    small = replace(found[1].patches[0], area=0.002)
    assert objects([found[0], replace(found[1], patches=(small,)), found[2]]) == [0, 0, 0]


def test_objects_leave_the_mask_where_they_stick_out():
    one = patch(30, 30)
    beside = one.hidden.copy()
    beside[:, :10] = False
    mask = np.full((60, 60), 255, np.uint8)
    cleaned, hidden, share = without(mask, [replace(one, beside=beside)])
    assert hidden.sum() == one.hidden.sum()
    assert share == pytest.approx(one.hidden.sum() / mask.size)
    assert (cleaned == 0).sum() == beside.sum()


@pytest.mark.slow
@pytest.mark.parametrize("mask_noise", [0.0, 0.6])
@pytest.mark.parametrize("off", [0.0, 0.06])
def test_nothing_of_a_synthetic_subject_is_an_object(tmp_path, mask_noise, off):
    """Also where the body is fitted 6 cm off: below 0.5 % of the person."""
    make_studio(StudioConfig(2, 256, 30, 1, 0.0, mask_noise, "textured"), tmp_path / "me")
    capture = read_capture(tmp_path / "me")
    shaped = shape_body(capture.body, capture.betas)
    seen, colors, visible = [], [], []
    frames = sorted(
        {f.frame_index: f for frames in capture.splits.values() for f in frames}.values(), key=lambda f: f.frame_index
    )
    for frame in frames:
        posed = pose_body(shaped, frame.pose, frame.translation + off)
        pixels, depth = project(frame.camera, posed.vertices)
        focal = float(frame.camera.intrinsics[0, 0])
        size = frame.camera.height, frame.camera.width
        seen.append(see_body(pixels.numpy(), depth.numpy(), posed.faces.numpy(), focal, *size))
        column, row = np.where(seen[-1].visible[:, None], seen[-1].pixels, 0).T
        colors.append(read_rgb(frame.image_file)[row, column])
        visible.append(seen[-1].visible & (read_grey(frame.mask_file)[row, column] > 127))
    usual = usual_colors(np.stack(colors), np.stack(visible))
    masks = [read_grey(frame.mask_file) for frame in frames]
    images = [read_rgb(frame.image_file) for frame in frames]
    found = [foreign_patches(m, i, s, *usual) for m, i, s in zip(masks, images, seen, strict=True)]
    taken = moving_objects(found, [frame.frame_index / capture.fps for frame in frames])
    shares = [without(mask, patches)[2] for mask, patches in zip(masks, taken, strict=True)]
    assert np.mean(shares) < 0.005
