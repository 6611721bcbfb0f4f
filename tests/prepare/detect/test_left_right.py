"""Left and right are put right where they were exchanged, and left alone where they were not."""

from dataclasses import replace
from itertools import product

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from walker import camera, ring, seen, walker

from twofold.prepare.detect.left_right import _most_probable, mirror, repair_swaps, repair_with_views
from twofold.prepare.detections import LANDMARKS, Track, mirrored_landmarks, nobody

FRONT, BACK = camera("front"), camera("back", np.pi)


def walk(view, seconds, turn=0.0, noise=3.0, seed=0):
    rng = np.random.default_rng(seed)
    return seen(view, walker(seconds, turn), noise, rng)


def flips(count, every, seed):
    """Frames that an estimator mirrored: it goes over with probability 1 / `every`; less than half of all."""
    wrong = np.cumsum(np.random.default_rng(seed).random(count) < 1 / every) % 2 == 1
    return wrong if wrong.mean() < 0.5 else ~wrong


@pytest.mark.parametrize("view", [FRONT, BACK, camera("side", 1.4), camera("low", 0.4, height=0.3)])
@pytest.mark.parametrize("fps", [60.0, 15.0, 4.0, 1.0])
@pytest.mark.parametrize("turn", [0.0, 1.5, -4.0])
def test_people_whose_sides_are_right_are_left_alone(view, fps, turn):
    seconds = np.arange(round(max(24, 4 * fps))) / fps
    assert not repair_swaps(walk(view, seconds, turn), seconds).swapped.any()


@given(st.integers(0, 10**6), st.sampled_from([3, 10, 40]), st.floats(-2, 2), st.sampled_from([60.0, 30.0, 15.0]))
def test_mirrored_frames_are_found(seed, every, turn, fps):
    seconds = np.arange(60) / fps
    right = walk(FRONT if seed % 2 else BACK, seconds, turn, seed=seed)
    wrong = flips(60, every, seed)
    repair = repair_swaps(mirror(right, wrong).track, seconds)
    assert np.array_equal(repair.swapped, wrong)
    assert np.array_equal(repair.track.pixels, right.pixels)
    assert np.array_equal(repair.track.world, right.world)


def test_far_apart_in_time_frames_do_not_decide_for_each_other():
    """The person turns round between two looks: at this rate that is no reason to call either mirrored."""
    seconds = np.arange(8) * 0.5
    points = np.concatenate([walker(seconds[:4]), walker(seconds[4:], heading=np.pi)])
    assert not repair_swaps(seen(FRONT, points), seconds).swapped.any()


def test_frames_between_right_and_mirrored_hide_no_change():
    """Estimators that smooth pass through a frame that is neither, and no step there is large."""
    seconds = np.arange(60) / 60
    right = walk(FRONT, seconds)
    wrong = (seconds > 0.3) & (seconds < 0.6)
    track = mirror(right, wrong).track
    between = track.pixels.copy()
    edges = np.flatnonzero(np.diff(wrong.astype(int)))
    for edge in edges:
        between[edge] = (right.pixels[edge] + right.pixels[edge][list(mirrored_landmarks())]) / 2
    found = repair_swaps(replace(track, pixels=between), seconds).swapped
    clear = np.setdiff1d(np.arange(60), edges)
    assert np.array_equal(found[clear], wrong[clear])


def test_more_than_half_mirrored_is_noticed_by_the_toes():
    seconds = np.arange(60) / 30
    wrong = np.arange(60) % 20 < 12
    for view in (FRONT, BACK):
        repair = repair_swaps(mirror(walk(view, seconds), wrong).track, seconds)
        assert np.array_equal(repair.swapped, wrong)


def test_frames_without_anybody_and_without_depth_are_bridged():
    seconds = np.arange(40) / 30
    right, wrong = walk(FRONT, seconds), flips(40, 8, 3)
    track = mirror(right, wrong).track
    gone = np.isin(np.arange(40), [0, 7, 8, 21, 39])
    empty = nobody(4, 4)
    track = Track(
        np.where(gone[:, None, None], empty.pixels, track.pixels),
        np.where(gone[:, None], empty.visibility, track.visibility),
        np.full_like(track.world, np.nan),
    )
    found = repair_swaps(track, seconds).swapped
    assert np.array_equal(found[~gone], wrong[~gone])
    assert not found[gone].any()


@pytest.mark.parametrize("frames", [0, 1, 5])
def test_clips_without_anybody_stay_as_they_are(frames):
    track = Track(np.full((frames, 33, 2), np.nan), np.zeros((frames, 33)), np.full((frames, 33, 3), np.nan))
    assert not repair_swaps(track, np.arange(frames) / 30).swapped.any()
    assert not repair_swaps(walk(FRONT, np.zeros(1)), np.zeros(1)).swapped.any()


def test_mirroring_exchanges_the_names_and_nothing_else():
    track = walk(FRONT, np.arange(4) / 10)
    some = np.array([False, True, True, False])
    once = mirror(track, some).track
    left, right = LANDMARKS.index("left_wrist"), LANDMARKS.index("right_wrist")
    assert np.array_equal(once.pixels[1, left], track.pixels[1, right])
    assert np.array_equal(once.world[2, right], track.world[2, left])
    assert np.array_equal(once.pixels[:, 0], track.pixels[:, 0])
    assert np.array_equal(once.pixels[0], track.pixels[0])
    twice = mirror(once, some).track
    assert np.array_equal(twice.pixels, track.pixels)


@settings(max_examples=15)
@given(st.integers(0, 10**6), st.integers(1, 9))
def test_path_is_the_most_probable_of_all(seed, count):
    """Slow reference: try every answer."""
    rng = np.random.default_rng(seed)
    like, alone = 3 * rng.standard_normal((4, count)), rng.standard_normal(count)

    def cost(answers):
        total = float(alone @ answers)
        for frame in range(count):
            for back in range(1, min(4, frame) + 1):
                if answers[frame] != answers[frame - back]:
                    total += like[back - 1, frame]
        return total

    best = min(product((0, 1), repeat=count), key=lambda answers: cost(np.array(answers)))
    assert np.array_equal(_most_probable(like, alone), np.array(best, dtype=bool))


@settings(max_examples=6)
@given(st.integers(0, 10**6), st.sampled_from([(2, 30.0), (3, 30.0), (4, 5.0), (4, 1.0)]))
def test_views_that_must_meet_in_space_agree_on_the_sides(seed, rig):
    count, fps = rig
    seconds, cameras = np.arange(16) / fps, ring(count)
    right = [walk(view, seconds, 1.0, seed=seed + i) for i, view in enumerate(cameras)]
    wrong = [flips(16, 6, seed + i) for i in range(count)]
    if count > 2:  # the others know better than one that is nearly always wrong
        wrong[0] = ~wrong[0]
        wrong[1:] = [np.zeros(16, dtype=bool)] * (count - 1) if fps < 30 else wrong[1:]
    found = [mirror(track, swapped).track for track, swapped in zip(right, wrong, strict=True)]
    repairs = repair_with_views(found, cameras, seconds)
    assert [r.swapped.tolist() for r in repairs] == [w.tolist() for w in wrong]


def test_one_view_is_repaired_alone():
    seconds = np.arange(30) / 30
    wrong = flips(30, 6, 1)
    track = mirror(walk(FRONT, seconds), wrong).track
    assert np.array_equal(repair_with_views([track], [FRONT], seconds)[0].swapped, wrong)


def test_views_without_anybody_disturb_nothing():
    seconds, cameras = np.arange(24) / 30, ring(3)
    tracks = [walk(view, seconds) for view in cameras]
    tracks[1] = Track(np.full((24, 33, 2), np.nan), np.zeros((24, 33)), np.full((24, 33, 3), np.nan))
    wrong = flips(24, 6, 2)
    tracks[2] = mirror(tracks[2], wrong).track
    found = [repair.swapped for repair in repair_with_views(tracks, cameras, seconds)]
    assert not found[0].any()
    assert not found[1].any()
    assert np.array_equal(found[2], wrong)
