"""What cameras saw as tensors: nothing unknown gets in, and the first guess of a motion stands where it is seen."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from acting import acted, before_camera, evidence_of, joints_of, landmarks, standing_camera, the_body

from twofold.geometry.cameras import project
from twofold.geometry.rotations import axis_angle_to_matrix
from twofold.prepare.detections import Track, nobody, track_of
from twofold.prepare.fitting.body_landmarks import body_points
from twofold.prepare.fitting.observations import Evidence, begin, gather
from twofold.prepare.fitting.outlines import trace_outlines
from twofold.prepare.fitting.parameters import place_points, pose_motion


@pytest.fixture(scope="module")
def scene():
    """A body, its motion, and two cameras at right angles."""
    body = the_body()
    return body, acted(body, 5), [standing_camera(0.3), standing_camera(0.3 + np.pi / 2)]


def blank(track, times=slice(None), **what):
    """The track with some of its arrays unknown in some frames."""
    parts = {name: value.copy() for name, value in vars(track).items()}
    for name, value in what.items():
        parts[name][times] = value
    return Track(**parts)


def test_directions_in_space_are_the_worlds(scene):
    body, motion, cameras = scene
    evidence = [Evidence(camera, landmarks(body, motion, camera)) for camera in cameras]
    seen = gather(evidence, [None, None], None)
    places = place_points(pose_motion(body, motion), body_points(body), motion)
    hips = places[:, [23, 24]].mean(1, keepdim=True)
    for space in seen.space:
        torch.testing.assert_close(space, places - hips, atol=1e-5, rtol=0)
    given = places.numpy() + 1
    given[2, 5] = np.nan
    seen = gather(evidence, [None, None], given)
    assert seen.space.shape[0] == 1
    assert seen.space_weight[0].sum() == 5 * 33 - 1
    assert seen.space_weight[0, 2, 5] == 0
    assert seen.space.isfinite().all()


def test_unknown_landmarks_weigh_nothing_and_hidden_ones_little(scene):
    body, motion, cameras = scene
    track = landmarks(body, motion, cameras[0])
    track.visibility[:, 3] = 0.0
    track.visibility[:, 4] = 0.5
    track.pixels[:, 6] = np.nan
    seen = gather([Evidence(cameras[0], track)], [None], None)
    assert (seen.weight[0, :, 6] == 0).all()
    assert (seen.weight[0, :, 4] == 0.25).all()
    assert (seen.weight[0, :, 3] > 0).all()
    assert (seen.weight[0, :, 3] < 1e-3).all()
    assert seen.pixels.isfinite().all()


def test_sizes_come_from_masks_where_there_are_some(scene):
    body, motion, cameras = scene
    evidence = evidence_of(body, motion, cameras[0])
    traced = trace_outlines(evidence.masks)
    by_mask, by_points = (float(gather([evidence], [o], None).size[0]) for o in (traced, None))
    assert by_mask == traced.size
    assert by_points == pytest.approx(by_mask, rel=0.25)


def test_a_camera_that_never_sees_anybody_gives_no_nan(scene):
    body, motion, cameras = scene
    empty = track_of([nobody(4, 4)] * 5)
    evidence = [Evidence(cameras[0], landmarks(body, motion, cameras[0])), Evidence(cameras[1], empty)]
    seen = gather(evidence, [None, None], None)
    for value in (v for v in vars(seen).values() if v is not None):
        assert value.isfinite().all()
    started = begin(body, body_points(body), seen)
    torch.testing.assert_close(
        axis_angle_to_matrix(started.full_pose()[:, 0]), axis_angle_to_matrix(motion.full_pose()[:, 0]),
        atol=1e-3, rtol=0,
    )  # fmt: skip


def test_parts_of_the_evidence(scene):
    body, motion, cameras = scene
    evidence = evidence_of(body, motion, cameras[0])
    part = evidence[1:3]
    assert len(part.track) == len(part.masks) == 2
    assert np.array_equal(part.track.pixels, evidence.track.pixels[1:3])
    assert part.masks[0] is evidence.masks[1]
    assert replace(evidence, masks=None)[1:3].masks is None
    timed = replace(evidence, seconds=np.linspace(0, 1, len(evidence.track)) ** 2)
    assert np.array_equal(timed[1:3].seconds, timed.seconds[1:3])
    assert gather([timed], [None], None).seconds.tolist() == timed.seconds.tolist()


def mean_body(motion):
    return replace(motion, betas=torch.zeros_like(motion.betas))


@pytest.mark.parametrize("count", [1, 2])
def test_the_first_guess_is_near_where_the_person_is(scene, count):
    body, motion, cameras = scene
    motion = mean_body(motion)
    if count == 1:
        motion, camera = before_camera(body, motion, cameras[0])
        cameras = [camera]
    evidence = [Evidence(camera, landmarks(body, motion, camera)) for camera in cameras]
    started = begin(body, body_points(body), gather(evidence, [None] * count, None))
    # The trunk and the limbs' directions are exact; collars and wrists are not guessed.
    assert (joints_of(body, started) - joints_of(body, motion)).norm(dim=-1).max() < 0.03
    shown = project(cameras[0], joints_of(body, started))[0] - project(cameras[0], joints_of(body, motion))[0]
    assert shown.norm(dim=-1).max() < 3


def test_of_several_guesses_the_one_that_knows_something_is_taken(scene):
    """The camera that sees most has no landmarks in space in some frames, the other one has."""
    body, motion, cameras = scene
    motion = mean_body(motion)
    tracks = [landmarks(body, motion, camera) for camera in cameras]
    first = blank(tracks[0], slice(2, 5), world=np.nan)
    second = blank(tracks[1], visibility=0.6)
    evidence = [Evidence(camera, track) for camera, track in zip(cameras, (first, second), strict=True)]
    started = begin(body, body_points(body), gather(evidence, [None, None], None))
    turns = [axis_angle_to_matrix(m.full_pose()[:, 0]) for m in (started, motion)]
    torch.testing.assert_close(turns[0], turns[1], atol=1e-3, rtol=0)


def test_frames_at_which_nobody_is_found_stand_where_the_nearest_others_do(scene):
    body, motion, cameras = scene
    track = blank(landmarks(body, motion, cameras[0]), slice(0, 2), pixels=np.nan, visibility=0.0, world=np.nan)
    started = begin(body, body_points(body), gather([Evidence(cameras[0], track)], [None], None))
    torch.testing.assert_close(started.translation[:2], started.translation[[2, 2]])
    torch.testing.assert_close(started.guess[:2], started.guess[[2, 2]])
    assert started.translation.isfinite().all()
