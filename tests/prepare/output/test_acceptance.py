"""Which images are bad, which clips cannot work, and what a user is told."""

import json
import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from acting import standing_camera
from hypothesis import assume, given
from hypothesis import strategies as st

from twofold.errors import TwofoldError
from twofold.geometry.cameras import Camera
from twofold.geometry.rotations import axis_angle_to_matrix, matrix_to_axis_angle
from twofold.prepare.detections import LANDMARKS, Track
from twofold.prepare.output.acceptance import (
    MAX_REPROJECTION,
    MIN_IMAGES,
    MIN_IOU,
    MIN_VISIBILITY,
    ImageQuality,
    image_quality,
    kept_times,
    require_length,
    require_person,
    require_whole,
    warnings_about,
)
from twofold.prepare.turning import arc, camera_directions

CAMERA = standing_camera()
GOOD = ImageQuality("cam", 0, 0.9, 1.0, 1.0, 0.9, False)


def judged(iou=0.9, error=1.0, visibility=0.9, height=150.0, alone=True, **changes):
    """The record of an image whose landmarks are all `error` pixels off."""
    shown = np.random.default_rng(0).uniform(20, 140, (33, 2))
    arrays = {"pixels": shown + np.array([0.6, 0.8]) * error, "visibility": np.full(33, visibility)} | changes
    return image_quality("cam", CAMERA, 7, iou, shown, height=height, alone=alone, **arrays)


def test_a_good_image_has_no_fault():
    quality = judged(error=3.0)
    assert quality == replace(quality, camera="cam", frame_index=7, fault="", cropped=False)
    assert quality.reprojection == pytest.approx(3)
    assert quality.reprojection_percent == pytest.approx(2)
    assert quality.visibility == pytest.approx(0.9)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"iou": MIN_IOU - 0.01}, "does not cover the mask (IoU 0.69, at least 0.7)"),
        ({"error": 1.01 * MAX_REPROJECTION * 1.5}, "misses the landmarks (4.0 % of its height, at most 4 %)"),
        ({"visibility": MIN_VISIBILITY - 0.01}, "too little of the person is seen (visibility 0.49, at least 0.5)"),
        ({"pixels": np.full((33, 2), np.nan)}, "nobody was found"),
    ],
)
def test_bad_images_say_why(changes, words):
    assert words in judged(**changes).fault


def test_at_the_thresholds_images_stay():
    assert not judged(iou=MIN_IOU).fault
    assert not judged(error=0.99 * MAX_REPROJECTION * 1.5).fault
    assert not judged(visibility=MIN_VISIBILITY + 0.01).fault


def test_where_other_cameras_see_the_person_landmarks_may_be_missed():
    assert not judged(error=50.0, alone=False).fault
    assert "mask" in judged(error=50.0, iou=0.5, alone=False).fault


def test_only_landmarks_that_are_seen_are_measured():
    shown = np.zeros((33, 2)) + 50
    pixels, visibility = shown + np.array([3.0, 4.0]), np.full(33, 0.9)
    visibility[:5], pixels[:5] = 0.4, 1000
    pixels[5:9] = np.nan
    quality = image_quality("cam", CAMERA, 0, 0.9, shown, pixels, visibility, 100.0)
    assert quality.reprojection == pytest.approx(5)


@pytest.mark.parametrize("pixels", [np.full((33, 2), np.nan), np.full((33, 2), 50.0)])
def test_rows_can_be_stored_whatever_was_seen(pixels):
    quality = judged(pixels=pixels, visibility=np.full(33, 0.1))
    assert math.isinf(quality.reprojection)
    row = json.loads(json.dumps(quality.row(), allow_nan=False))
    assert row["reprojection"] is None
    assert row["fault"] == quality.fault
    assert judged(iou=0.87654).row()["iou"] == 0.877


@pytest.mark.parametrize("name", ["nose", "left_ankle", "right_wrist"])
@pytest.mark.parametrize(("place", "cropped"), [((-3, 50), True), ((50, 203), True), ((-0.5, 199.5), False)])
def test_ends_beyond_the_edge_make_an_image_cropped(name, place, cropped):
    pixels = np.full((33, 2), 50.0)
    pixels[LANDMARKS.index(name)] = place
    assert judged(pixels=pixels).cropped is cropped
    pixels[:] = 50
    pixels[LANDMARKS.index("left_hip")] = place
    assert not judged(pixels=pixels).cropped


def test_short_clips_are_refused():
    require_length(MIN_IMAGES, "a.mp4")
    with pytest.raises(TwofoldError, match=r"a.mp4 has 3 images, expected at least 12"):
        require_length(3, "a.mp4")


def track(found):
    visibility = np.repeat(np.array(found, dtype=float)[:, None], 33, 1)
    return Track(np.zeros((len(found), 33, 2)), visibility, np.zeros((len(found), 33, 3)))


def test_clips_without_a_person_are_refused():
    require_person(track([1] * 7 + [0] * 3), "a.mp4")
    with pytest.raises(TwofoldError, match=r"a.mp4 shows a person in only 60 % of the images"):
        require_person(track([1] * 6 + [0] * 4), "a.mp4")
    with pytest.raises(TwofoldError, match=r"a.mp4 shows nobody; film one whole person"):
        require_person(track([0] * 5), "a.mp4")


def test_clips_that_cut_the_person_off_are_refused():
    half = [replace(GOOD, cropped=k % 2 == 0) for k in range(10)]
    require_whole(half, "a.mp4")
    with pytest.raises(TwofoldError, match=r"In 55 % of the images of a.mp4 head, hands or feet"):
        require_whole([*half, replace(GOOD, cropped=True)], "a.mp4")


def records(faults, moments=20, cameras=("a", "b")):
    """Records of all images, with faults by (camera, time)."""
    return [
        replace(GOOD, camera=camera, frame_index=time, fault=faults.get((camera, time), ""))
        for camera in cameras
        for time in range(moments)
    ]


def test_frames_that_any_camera_shows_badly_are_left_out():
    faults = {("a", 3): "x", ("b", 3): "y", ("b", 7): "z"}
    assert kept_times(records(faults), "clip")[0] == [t for t in range(20) if t not in (3, 7)]


@given(bad=st.integers(0, 20))
def test_more_than_three_in_ten_bad_frames_are_too_many(bad):
    faults = {("a", 19 - k): f"reason {19 - k}" for k in range(bad)}
    if bad <= 6:
        kept, left_out = kept_times(records(faults), "clip")
        assert len(kept) == 20 - bad
        assert left_out == {time: reason for (_, time), reason in faults.items()}
        return
    with pytest.raises(TwofoldError) as error:
        kept_times(records(faults), "clip")
    span = f"{20 - bad}-19"
    assert f"{bad} of 20 images of clip could not be understood (frames {span})" in str(error.value)
    assert f"at {20 - bad}, for one, reason {20 - bad}; film one person" in str(error.value)


def test_dropped_frames_are_left_out_and_are_no_reason_to_refuse():
    kept, left_out = kept_times(records({("a", 3): "reason 3"}), "clip", drop=range(5, 15))
    assert kept == [0, 1, 2, 4, *range(15, 20)]
    assert left_out == {3: "reason 3"} | dict.fromkeys(range(5, 15), "asked for with --drop")
    with pytest.raises(TwofoldError, match="--drop leaves 2 images of clip"):
        kept_times(records({}), "clip", drop=range(2, 20))


def yaw_range(pose, camera):
    roots = axis_angle_to_matrix(pose[:, 0])
    return arc(camera_directions(roots, torch.zeros(len(roots), 3), camera.center.expand(len(roots), 3))[0])


def facing(angles, tilt=(0.0, 0.0, 0.0), camera=CAMERA):
    """Poses that face these angles (radians) about the upright axis, and the camera, in a world that is tilted."""
    root = torch.zeros(len(angles), 3, dtype=torch.float64)
    root[:, 1] = torch.as_tensor(angles)
    world = axis_angle_to_matrix(torch.tensor(tilt, dtype=torch.float64))
    pose = torch.zeros(len(angles), 24, 3)
    pose[:, 0] = matrix_to_axis_angle(world @ axis_angle_to_matrix(root)).float()
    view = camera.world_to_camera.clone()
    view[:3, :3] = view[:3, :3] @ world.T.float()
    return pose, Camera(view, camera.intrinsics, camera.height, camera.width)


@given(
    start=st.floats(-10, 10), span=st.floats(0, 6.0), count=st.integers(20, 60),
    tilt=st.tuples(*[st.floats(-3, 3)] * 3), azimuth=st.floats(-3, 3),
)  # fmt: skip
def test_yaw_is_the_arc_that_the_body_turns_through(start, span, count, tilt, azimuth):
    """Wherever the arc begins, however the world is turned, and in whichever order."""
    step = span / (count - 1)
    assume(2 * math.pi - span > step)
    angles = np.random.default_rng(count).permutation(start + np.linspace(0, span, count))
    found = yaw_range(*facing(angles, tilt, standing_camera(azimuth)))
    assert found == pytest.approx(math.degrees(span), abs=0.1)


def test_yaw_of_a_full_turn_is_a_full_circle_but_for_one_step():
    assert yaw_range(*facing(np.arange(36) * 2 * np.pi / 36)) == pytest.approx(350, abs=0.1)
    assert yaw_range(*facing(np.arange(72) * 2 * np.pi / 36)) == pytest.approx(350, abs=0.1)


def test_yaw_of_somebody_who_stands_still_is_nothing():
    assert yaw_range(*facing([1.0] * 5)) == pytest.approx(0, abs=0.1)
    assert yaw_range(*facing([0.3])) == pytest.approx(0, abs=0.1)


def test_leaning_is_no_turning():
    pose, camera = facing([0.0] * 9)
    pose[:, 0, 0] = torch.linspace(-0.5, 0.5, 9)
    assert yaw_range(pose, camera) < 1


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({}, []),
        ({"yaw": 90.0}, ["only 90 degrees"]),
        ({"moved": 8.0}, ["background moves by up to 8 pixels"]),
        ({"moved": 8.0, "several": True}, ["--set method.rates.pose=1e-4"]),
        ({"moved": 6.0}, []),
        ({"moved": None}, []),
        (
            {"left_out": {3: "nobody was found", 4: "nobody was found", 9: "too dark (0.1)"}},
            ["3 frames were left out: 3-4 (nobody was found); 9 (too dark)."],
        ),
        ({"yaw": 10.0, "moved": 30.0, "left_out": {0: "x"}}, ["only 10 degrees", "moves by up to 30", "1 frames"]),
    ],
)
def test_warnings_say_what_to_know(changes, words):
    given = {"yaw": 350.0, "moved": 0.0, "width": 640, "left_out": {}, "several": False} | changes
    found = warnings_about(**given)
    assert len(found) == len(words)
    assert all(word in sentence for word, sentence in zip(words, found, strict=True))
