"""Real clips through the real estimator: the sides end up right, and the cameras where they are."""

import numpy as np
import pytest
from walker import CALIBRATION, CLIPS, needs_clips

from twofold.prepare.cameras.calibration import undistorter
from twofold.prepare.cameras.triangulation import triangulate, turn_cameras
from twofold.prepare.detect.blazepose import mediapipe_estimator
from twofold.prepare.detect.left_right import mirror, repair_swaps, repair_with_views
from twofold.prepare.detections import Track, mirrored_landmarks, track_of
from twofold.prepare.video.clips import PrepareConfig, open_clips
from twofold.prepare.video.frames import Frames

pytestmark = [pytest.mark.slow, needs_clips]

CAMERAS = ("cam01", "cam02", "cam03", "cam04")
MIRROR = list(mirrored_landmarks())


def look(frames, lens=None):
    undistort = None if lens is None else undistorter(lens, frames.info.height, frames.info.width)
    estimator = mediapipe_estimator(masks=False)
    try:
        return track_of([estimator(p.image if undistort is None else undistort(p.image), p.seconds) for p in frames])
    finally:
        estimator.close()


@pytest.fixture(scope="module")
def rig():
    """Cameras, tracks as found, and which frames are really mirrored, as the other three views tell."""
    pytest.importorskip("mediapipe", reason="needs the extra `prepare`")
    clips = open_clips([CLIPS / "pose2sim" / f"{name}.mp4" for name in CAMERAS], PrepareConfig(calibration=CALIBRATION))
    cameras = [clip.calibrated for clip in clips]
    tracks = [look(clip.frames, clip.lens) for clip in clips]
    repairs = repair_with_views(tracks, cameras, np.arange(len(tracks[0])) / 60)
    cameras = turn_cameras(cameras, [repair.track for repair in repairs])
    truth = []
    for view, track in enumerate(tracks):
        # Blind the view itself: it may not judge its own case.
        judges = [repair.track for repair in repairs]
        judges[view] = Track(track.pixels, np.zeros_like(track.visibility), track.world)
        points = triangulate(cameras, judges).points
        truth.append(nearer_mirrored(cameras[view], track, points))
    return cameras, tracks, np.array(truth)


def nearer_mirrored(camera, track, points):
    """1 where the track is clearly nearer to the points when mirrored, 0 where as it is.

    0.5 where it is half of both: the estimator smooths, and passes through such frames between right and mirrored.
    """
    in_camera = points @ camera.world_to_camera[:3, :3].T + camera.world_to_camera[:3, 3]
    there = in_camera @ camera.intrinsics.T
    there = there[..., :2] / there[..., 2:]
    limbs = np.arange(11, 33)
    errors = [
        np.nanmean(np.linalg.norm(pixels - there, axis=-1)[:, limbs], axis=1)
        for pixels in (track.pixels, track.pixels[:, MIRROR])
    ]
    clear = np.minimum(*errors) < 0.3 * np.maximum(*errors)
    return np.where(clear, errors[1] < errors[0], 0.5)


def every(track, stride, start):
    return Track(track.pixels[start::stride], track.visibility[start::stride], track.world[start::stride])


def test_one_view_is_really_mirrored_at_times(rig):
    _, tracks, truth = rig
    mirrored = [np.flatnonzero(view == 1) for view in truth]
    assert [len(frames) for frames in mirrored][::2] == [0, 0]
    assert len(mirrored[3]) == 0
    assert 25 <= len(mirrored[1]) <= 45
    assert (truth == 0.5).sum() <= 20
    assert all(track.found.all() for track in tracks)


@pytest.mark.parametrize("stride", [1, 2, 3, 4, 8])
def test_sides_are_right_after_repair_of_each_view_alone(rig, stride):
    _, tracks, truth = rig
    for view, track in enumerate(tracks):
        for start in range(min(stride, 4)):
            some, really = every(track, stride, start), truth[view, start::stride]
            found = repair_swaps(some, np.arange(len(some)) * stride / 60).swapped
            assert (np.abs(found - really) < 1).all(), (CAMERAS[view], stride, start, np.flatnonzero(found != really))


@pytest.mark.parametrize("stride", [1, 4])
def test_sides_are_right_after_repair_of_all_views(rig, stride):
    cameras, tracks, truth = rig
    some = [every(track, stride, 0) for track in tracks]
    repairs = repair_with_views(some, cameras, np.arange(len(some[0])) * stride / 60)
    for view, repair in enumerate(repairs):
        assert (np.abs(repair.swapped - truth[view, ::stride]) < 1).all(), CAMERAS[view]


def test_sides_exchanged_by_us_are_put_right_as_well(rig):
    _, tracks, truth = rig
    rng = np.random.default_rng(0)
    for view, track in enumerate(tracks):
        wrong = np.cumsum(rng.random(len(track)) < 0.1) % 2 == 1
        wrong = wrong if (wrong ^ (truth[view] == 1)).mean() < 0.5 else ~wrong
        found = repair_swaps(mirror(track, wrong).track, np.arange(len(track)) / 60).swapped
        assert (np.abs((found ^ wrong) - truth[view]) < 1).all(), CAMERAS[view]


def test_fixed_points_meet_once_the_cameras_are_turned(rig):
    """Squares on the floor are no landmarks: they tell on their own that the turn is right."""
    from test_triangulate import SQUARES

    cameras, _, _ = rig
    before = [c.calibrated for c in open_clips(
        [CLIPS / "pose2sim" / f"{name}.mp4" for name in CAMERAS], PrepareConfig(calibration=CALIBRATION)
    )]  # fmt: skip
    pixels = np.full((4, 1, 33, 2), np.nan)
    for view, squares in enumerate(SQUARES.values()):
        pixels[view, 0, :4] = [(np.nan, np.nan) if place is None else place for place in squares]
    pixels = (pixels + 0.5) / 2 - 0.5
    known = np.isfinite(pixels[..., 0]).astype(float)
    tracks = [Track(p, k, np.full((1, 33, 3), np.nan)) for p, k in zip(pixels, known, strict=True)]
    errors = [np.sqrt(np.nanmean(triangulate(c, tracks, noise=10.0).errors ** 2)) for c in (before, cameras)]
    assert errors[0] > 4
    assert errors[1] < 2


def test_juggler_is_left_alone():
    pytest.importorskip("mediapipe", reason="needs the extra `prepare`")
    track = look(Frames(CLIPS / "sam2_juggle" / "juggle.mp4", None, 960))
    for stride in (1, 2, 4, 8):
        for start in range(stride):
            some = every(track, stride, start)
            assert not repair_swaps(some, np.arange(len(some)) * stride / 24).swapped.any(), (stride, start)
