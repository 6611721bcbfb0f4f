"""Points in space from several views, and cameras turned until their rays meet."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from walker import CALIBRATION, camera, needs_clips, projected, ring, seen, walker

from twofold.errors import TwofoldError
from twofold.prepare.cameras.calibration import distort
from twofold.prepare.cameras.calibration_files import read_calibration
from twofold.prepare.cameras.triangulation import triangulate, turn_cameras
from twofold.prepare.detections import Track

SECONDS = np.arange(6) / 10


@given(st.integers(2, 6), st.floats(-3, 3), st.floats(-3, 3))
def test_points_seen_without_error_are_found_exactly(count, heading, turn):
    cameras, points = ring(count), walker(SECONDS, turn, heading)
    found = triangulate(cameras, [seen(view, points) for view in cameras])
    assert np.abs(found.points - points).max() < 1e-6
    assert found.residual.max() < 1e-4
    assert (found.views == count).all()


@given(st.integers(0, 3), st.floats(0, 6.28), st.floats(60, 600), st.booleans())
def test_one_bad_view_of_four_changes_nothing(bad, angle, distance, together):
    cameras, points = ring(4), walker(SECONDS)
    tracks = [seen(view, points) for view in cameras]
    angles = angle + (0 if together else np.arange(33) * 2.4)
    shift = distance * np.stack(np.broadcast_arrays(np.cos(angles), np.sin(angles)), -1)
    tracks[bad] = replace(tracks[bad], pixels=tracks[bad].pixels + shift)
    found = triangulate(cameras, tracks)
    assert np.abs(found.points - points).max() < 1e-4
    assert (found.views == 3).all()
    assert np.abs(found.errors[bad] - distance).max() < 0.5


def test_noise_is_averaged_and_its_size_told():
    rng = np.random.default_rng(0)
    cameras, points = ring(6), walker(np.arange(40) / 10)
    found = triangulate(cameras, [seen(view, points, 4.0, rng) for view in cameras], noise=4.0)
    # Of twelve coordinates the point takes up three, which leaves 4.9 pixels for two of them.
    assert 4.3 < np.median(found.residual) < 5.1
    # A pixel is 4 mm there; nearly as good as without doubts about any view (9 mm).
    assert np.sqrt(((found.points - points) ** 2).mean()) < 0.0105


def test_world_may_have_any_axes():
    cameras, points = ring(3), walker(SECONDS)
    turn, shift = Rotation.from_rotvec([1.0, -2.0, 0.5]), np.array([3.0, -1.0, 2.0])
    moved = []
    for view in cameras:
        rigid = np.eye(4)
        rigid[:3, :3] = view.world_to_camera[:3, :3] @ turn.inv().as_matrix()
        rigid[:3, 3] = view.world_to_camera[:3, 3] - rigid[:3, :3] @ shift
        moved.append(replace(view, world_to_camera=rigid))
    found = triangulate(moved, [seen(view, points) for view in cameras])
    there = np.stack([turn.apply(p) for p in points]) + shift
    assert np.abs(found.points - there).max() < 1e-6


def test_lens_distortion_is_taken_out():
    cameras, points = ring(3, distortion=(-0.2, 0.1, 0.001, -0.002, 0)), walker(SECONDS)
    tracks = [replace(track, pixels=distort(view, track.pixels)) for view in cameras for track in [seen(view, points)]]
    assert np.abs(triangulate(cameras, tracks).points - points).max() < 1e-5
    straight = [view.without_distortion() for view in cameras]
    assert np.abs(triangulate(straight, tracks).points - points).max() > 1e-3


def test_landmarks_of_fewer_than_two_views_have_no_point():
    cameras, points = ring(3), walker(SECONDS)
    tracks = [seen(view, points) for view in cameras]
    hidden = [np.ones((6, 33)) for _ in cameras]
    hidden[0][2, 5] = hidden[1][2, 5] = 0
    hidden[2][4, 7] = 0
    pixels = [np.where(mask[..., None] > 0, t.pixels, np.nan) for t, mask in zip(tracks, hidden, strict=True)]
    found = triangulate(cameras, [Track(p, h, t.world) for p, h, t in zip(pixels, hidden, tracks, strict=True)])
    assert np.isnan(found.points[2, 5]).all()
    assert np.isnan(found.residual[2, 5])
    assert found.views[2, 5] == 0
    assert found.views[4, 7] == 2
    assert np.isnan(found.errors[2, 4, 7])
    rest = np.ones((6, 33), dtype=bool)
    rest[2, 5] = False
    assert np.abs(found.points - points)[rest].max() < 1e-6


def test_too_few_views_or_frames_are_refused():
    track = seen(camera(), walker(SECONDS))
    with pytest.raises(TwofoldError, match="two views or more, there is 1"):
        triangulate([camera()], [track])
    with pytest.raises(TwofoldError, match=r"different numbers of frames \(cam0 6, cam1 2\)"):
        triangulate(ring(2), [track, seen(camera(), walker(SECONDS[:2]))])


def turned(view, degrees):
    rigid = view.world_to_camera.copy()
    rigid[:3] = Rotation.from_rotvec(np.radians(degrees)).as_matrix() @ rigid[:3]
    return replace(view, world_to_camera=rigid)


@settings(max_examples=8)
@given(st.lists(st.floats(-0.8, 0.8), min_size=12, max_size=12))
def test_cameras_that_were_touched_are_turned_back(degrees):
    points = walker(np.arange(12) / 6, 0.5)
    right = ring(4)
    wrong = [turned(view, turn) for view, turn in zip(right, np.reshape(degrees, (4, 3)), strict=True)]
    tracks = [seen(view, points) for view in right]
    mended = turn_cameras(wrong, tracks)
    before, after = triangulate(wrong, tracks), triangulate(mended, tracks)
    assert np.nanmedian(after.errors) <= np.nanmedian(before.errors)
    if np.abs(degrees).max() > 0.1:
        assert np.nanmedian(after.errors) < 0.2
    for old, new in zip(wrong, mended, strict=True):
        assert np.allclose(old.center, new.center)
        assert np.allclose(old.intrinsics, new.intrinsics)


def test_cameras_that_are_right_do_not_follow_the_landmarks_errors():
    rng = np.random.default_rng(1)
    points, cameras = walker(np.arange(12) / 6, 0.5), ring(4)
    # Each view's landmarks are off in their own way throughout, as estimators' are.
    tracks = [seen(v, points + 0.02 * rng.standard_normal((1, 33, 3)), 2.0, rng) for v in cameras]
    assert turn_cameras(cameras, tracks) == cameras


# Four white squares on the treadmill in the first frames of the clips, as found by eye (column, row).
SQUARES = {
    "cam01": [(317.3, 1334.1), (108.5, 1060.1), (766.5, 1289.8), (517.1, 1063.9)],
    "cam02": [(325.7, 1206.8), (438.9, 1039.3), (757.9, 1267.9), (788.5, 1082.7)],
    "cam03": [None, (873.9, 1234.1), (164.3, 1240.3), (485.3, 1431.5)],
    "cam04": [(889.5, 1069.3), (836.3, 1410.7), None, (385.3, 1396.3)],
}


@needs_clips
def test_qualisys_cameras_see_fixed_points_where_they_are():
    """Other readings of the file (transposed, not mirrored) put these points metres off; what is left is a bump."""
    cameras = read_calibration(CALIBRATION)
    pixels = np.full((4, 1, 33, 2), np.nan)
    for view, squares in enumerate(SQUARES.values()):
        for index, place in enumerate(squares):
            pixels[view, 0, index] = (np.nan, np.nan) if place is None else place
    # The first two clips were shrunk and got black bars of 7 rows after the calibration.
    pixels[:2] = (pixels[:2] + 0.5 - [0, 7]) * 1088 / 1080 - 0.5
    known = np.isfinite(pixels[..., 0])
    tracks = [Track(p, np.where(k, 1.0, 0.0), np.full((1, 33, 3), np.nan)) for p, k in zip(pixels, known, strict=True)]
    found = triangulate(list(cameras.values()), tracks, noise=10.0)
    assert np.nanmax(found.errors) < 40
    squares = found.points[0, :4]
    assert np.abs(squares[:, 2]).max() < 0.05, "they lie on the floor"
    along = squares[[0, 2]] - squares[[1, 3]]
    assert np.abs(along - along.mean(0)).max() < 0.05, "two and two at the same distance along the belt"
    view = cameras["cam02"]
    assert np.linalg.norm(projected(view, squares[2]) - pixels[1, 0, 2]) < 40
