"""A body that acts is found again: in its shape, its motion and its outline, by one camera and by several."""

import threading
import time
from contextlib import nullcontext
from dataclasses import replace

import numpy as np
import pytest
import torch
from acting import (
    acted,
    before_camera,
    evidence_of,
    joints_of,
    landmarks,
    needs_anny,
    overlap,
    random_motion,
    silhouettes,
    standing_camera,
    the_body,
)
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

from twofold.errors import TwofoldError
from twofold.geometry.cameras import project
from twofold.geometry.rotations import axis_angle_to_matrix, matrix_to_axis_angle
from twofold.prepare.detections import Track, nobody, track_of
from twofold.prepare.fitting import fit as fit_module
from twofold.prepare.fitting.body_landmarks import body_points
from twofold.prepare.fitting.fit import FitConfig, _joined, fit
from twofold.prepare.fitting.observations import Evidence
from twofold.prepare.fitting.parameters import place_points, pose_motion
from twofold.prepare.video.clips import longer

HEIGHT, WIDTH, FPS = 500, 400, 10.0
QUICK = FitConfig(steps=(6, 2), rematch=1)
NOISE = 1.5


def cameras(*azimuths):
    return [standing_camera(azimuth, height=HEIGHT, width=WIDTH) for azimuth in azimuths]


def most(errors):
    """Four fifths of the errors are smaller than this: for landmarks, whose noise has no largest value."""
    errors = np.asarray(errors)
    return float(np.quantile(errors[np.isfinite(errors)], 0.8))


def worst(errors):
    """The largest error: no arm stays caught where it never was, at no frame."""
    errors = np.asarray(errors)
    return float(errors[np.isfinite(errors)].max())


def away(body, found, truth):
    """How far each joint is off in each frame, metres."""
    return (joints_of(body, found) - joints_of(body, truth)).norm(dim=-1)


def missed(body, found, camera, track):
    """How far landmarks are off where they are seen, pixels."""
    places = place_points(pose_motion(body, found), body_points(body), found)
    return np.linalg.norm(project(camera, places)[0].numpy() - track.pixels, axis=-1)


# What most landmarks are off by from where they really are.
MAX_NOISE = NOISE * np.sqrt(-2 * np.log(0.2))


def test_two_calibrated_cameras_find_the_body_to_centimetres():
    body = the_body("anny" if needs_anny.args[0] is False else "sausages")
    truth, views, told = acted(body, 6), cameras(0.4, 2.1), []
    evidence = [evidence_of(body, truth, view, noise=NOISE, seed=k) for k, view in enumerate(views)]
    found = fit(body, evidence, FPS, progress=told.append)
    # Better than any one landmark tells: a pixel is 5 mm there, and most are up to 14 mm off.
    assert worst(away(body, found, truth)) < 0.013
    for view, one in zip(views, evidence, strict=True):
        assert np.median(overlap(silhouettes(body, found, view), one.masks)) > 0.94
        assert most(missed(body, found, view, one.track)) < MAX_NOISE
    assert abs(float(found.betas[0] - truth.betas[0])) < 0.15
    # Calibrated cameras leave nothing to guess.
    assert float(found.log_focal) == float(found.log_distance) == 0
    assert found.marks.norm(dim=1).max() < 0.015
    assert told == sorted(told)
    assert told[-1] == pytest.approx(1)


def test_one_camera_finds_what_it_can_see():
    """How far away the person is depends on their unknown size; where they are seen, and how they stand, does not."""
    body = the_body()
    truth, view = before_camera(body, acted(body, 6), cameras(0.4)[0])
    evidence = evidence_of(body, truth, view, noise=NOISE)
    found = fit(body, [evidence], FPS).settled(body)
    assert float(found.log_focal) == 0
    assert np.median(overlap(silhouettes(body, found, view), evidence.masks)) > 0.94
    assert most(missed(body, found, view, evidence.track)) < MAX_NOISE
    # Somebody taken for larger is taken to be farther away: this body's one coefficient is its size.
    hips = [joints_of(body, motion)[:, 0] for motion in (found, truth)]
    scale = float((hips[0].norm(dim=1) / hips[1].norm(dim=1)).median())
    assert scale == pytest.approx(float((1 + 0.1 * found.betas[0]) / (1 + 0.1 * truth.betas[0])), rel=0.02)
    # Nothing but people's usual size speaks for any: what is found is nearer to that than the truth is.
    assert abs(float(found.betas[0])) < float(truth.betas[0])
    off = (joints_of(body, found) / scale - joints_of(body, truth)).norm(dim=-1)
    assert most(off) < 0.05
    assert worst(off) < 0.08
    turns = [axis_angle_to_matrix(motion.full_pose()[:, 0]) for motion in (found, truth)]
    assert worst((turns[0] - turns[1]).norm(dim=(1, 2))) < 0.25


@pytest.mark.parametrize("guess", [0.7, 1.4])
def test_an_unknown_focal_length_goes_towards_the_truth(guess):
    """Somebody close by shows some perspective: too short a guess grows, too long a one shrinks.

    Distance and focal length together change the image little, so that not even thousands of steps get there, and
    what is usually believed of the guess holds it at once. Believed less, it goes a good part of the way.
    """
    body = the_body()
    near = standing_camera(0.4, distance=2.0, height=HEIGHT, width=WIDTH, focal=0.75)
    truth, view = before_camera(body, acted(body, 5, turn=2.0), near)
    track, wrong = landmarks(body, truth, view), longer(view, guess)
    patient = FitConfig(steps=(600, 0), prior=replace(FitConfig().prior, focal=1.0))
    found = fit(body, [Evidence(wrong, track)], FPS, True, patient)
    assert 0.2 < float(found.log_focal) / -np.log(guess) < 1
    factor = float(found.log_focal.exp())
    assert worst(missed(body, found.settled(body), longer(wrong, factor), track)) < 1


@pytest.mark.parametrize("guess", [0.7, 1.4])
def test_a_focal_length_that_is_known_stays(guess):
    body = the_body()
    near = standing_camera(0.4, distance=2.0, height=HEIGHT, width=WIDTH, focal=0.75)
    truth, view = before_camera(body, acted(body, 5, turn=2.0), near)
    evidence = [Evidence(longer(view, guess), landmarks(body, truth, view))]
    assert float(fit(body, evidence, FPS, False, QUICK).log_focal) == 0
    assert float(fit(body, evidence, FPS, True, QUICK).log_focal) != 0


@pytest.mark.parametrize("found", [True, False])
def test_the_number_of_threads_is_as_before(found):
    """Whether the fit comes to its end or not."""
    body, (view,) = the_body(), cameras(0.4)
    evidence = evidence_of(body, acted(body, 3), view)
    if not found:
        evidence = replace(evidence, track=track_of([nobody(4, 4)] * 3))
    threads, during = torch.get_num_threads(), []
    torch.set_num_threads(2)
    try:
        with nullcontext() if found else pytest.raises(TwofoldError):
            fit(body, [evidence], FPS, config=QUICK, progress=lambda done: during.append(torch.get_num_threads()))
        assert torch.get_num_threads() == 2
    finally:
        torch.set_num_threads(threads)
    assert set(during) == ({1} if found else set())


def test_nobody_in_any_image_is_said_in_one_sentence():
    body, (view,) = the_body(), cameras(0.0)
    empty = track_of([nobody(4, 4)] * 5)
    with pytest.raises(TwofoldError, match=r"^Nobody was found in any image; film one whole person"):
        fit(body, [Evidence(view, empty), Evidence(view, empty)], FPS)


def unknown(track, times):
    """Nobody found in some frames."""
    parts = {name: value.copy() for name, value in vars(track).items()}
    parts["visibility"][times] = 0
    for name in ("pixels", "world"):
        parts[name][times] = np.nan
    return Track(**parts)


def test_frames_that_show_nobody_are_bridged():
    body = the_body()
    truth, views = acted(body, 7), cameras(0.4, 2.1)
    evidence = []
    for view in views:
        masks = silhouettes(body, truth, view)
        masks[3] = np.zeros_like(masks[3])
        evidence.append(Evidence(view, unknown(landmarks(body, truth, view), [3]), masks))
    found = fit(body, evidence, FPS)
    errors = away(body, found, truth)
    assert errors.isfinite().all()
    # The motion goes on as it went: nearer to the truth than a straight line between the neighbours, 24 mm.
    assert worst(errors[3]) < 0.02
    assert worst(errors) < 0.015


def test_landmarks_in_space_without_masks_are_enough():
    """Neither camera knows by itself how they lie in space, and one of them is unknown for a frame."""
    body = the_body()
    # Turned well away from where a body without any guess would face.
    truth, views = acted(body, 4, heading=2.5), cameras(0.4, 2.1)
    tracks = [landmarks(body, truth, view) for view in views]
    evidence = [
        Evidence(v, replace(t, world=np.full_like(t.world, np.nan))) for v, t in zip(views, tracks, strict=True)
    ]
    space = place_points(pose_motion(body, truth), body_points(body), truth).numpy()
    space[1, 13] = np.nan
    found = fit(body, evidence, FPS, points_in_space=space)
    assert worst(away(body, found, truth)) < 0.02
    for view, one in zip(views, evidence, strict=True):
        # 8 mm there: without masks the fit ends while it is wide.
        assert worst(missed(body, found, view, one.track)) < 1.5


def test_the_same_evidence_gives_the_same_motion():
    body, (view,) = the_body(), cameras(0.4)
    evidence = evidence_of(body, acted(body, 3), view, noise=NOISE)
    first, second = (fit(body, [evidence], FPS, config=QUICK) for _ in range(2))
    for name, value in vars(first).items():
        assert torch.equal(value, getattr(second, name)), name


def test_windows_fitted_side_by_side_give_the_same_motion_as_one_after_the_other(monkeypatch):
    monkeypatch.setattr(fit_module, "WINDOW", 8)
    monkeypatch.setattr(fit_module, "OVERLAP", 3)
    body, (view,) = the_body(), cameras(0.4)
    evidence = evidence_of(body, acted(body, 26), view, noise=NOISE)
    found = []
    for threads in (1, 3):
        monkeypatch.setattr(torch, "get_num_threads", lambda threads=threads: threads)
        told = []
        found.append(fit(body, [evidence], FPS, config=FitConfig(steps=(12, 4)), progress=told.append))
        assert told == pytest.approx([1 / 3, 2 / 3, 1])
    for name, value in vars(found[0]).items():
        assert torch.equal(value, getattr(found[1], name)), name


def test_other_windows_end_soon_after_one_has_failed(monkeypatch):
    """Else a user who stops would wait for threads that go on."""
    monkeypatch.setattr(fit_module, "WINDOW", 8)
    monkeypatch.setattr(fit_module, "OVERLAP", 3)
    monkeypatch.setattr(torch, "get_num_threads", lambda: 2)
    body, (view,) = the_body(), cameras(0.4)
    evidence = evidence_of(body, acted(body, 26), view, noise=NOISE)
    both, ended = threading.Barrier(2, timeout=20), threading.Event()
    real, calls = fit_module._fit_window, []

    def window(*given):
        calls.append(given)
        if len(calls) == 1:
            return real(*given)
        first = given[1][0].track.pixels[0, 0, 0] == evidence.track.pixels[8, 0, 0]
        both.wait()
        if first:
            raise KeyboardInterrupt
        try:
            while True:
                given[-1](0.5)
                time.sleep(0.01)
        finally:
            ended.set()

    monkeypatch.setattr(fit_module, "_fit_window", window)
    with pytest.raises(KeyboardInterrupt):
        fit(body, [evidence], FPS, config=FitConfig(steps=(12, 4)))
    assert ended.wait(timeout=20)


@pytest.fixture
def short_windows(monkeypatch):
    """Windows of eight frames that share three, one after the other, and a note of how much each traced and of what."""
    monkeypatch.setattr(torch, "get_num_threads", lambda: 1)
    monkeypatch.setattr(fit_module, "WINDOW", 8)
    monkeypatch.setattr(fit_module, "OVERLAP", 3)
    traced = []
    trace = fit_module.trace_outlines
    monkeypatch.setattr(fit_module, "trace_outlines", lambda masks: traced.append(list(masks)) or trace(masks))
    return traced


def test_long_clips_are_fitted_window_by_window(short_windows, tmp_path):
    """By one camera, whose distance from the person each window could tell otherwise."""
    body, told = the_body(), []
    truth, view = before_camera(body, acted(body, 24, fps=20.0), cameras(0.4)[0])
    files = [tmp_path / f"{time}.png" for time in range(24)]
    for file, mask in zip(files, silhouettes(body, truth, view), strict=True):
        Image.fromarray(mask).save(file)
    track = landmarks(body, truth, view)
    track.visibility[8:16] = 1.0  # Most is seen in the second window, so that it tells the shape.
    found = fit(body, [Evidence(view, track, files)], 20.0, progress=told.append)
    assert len(found) == 24
    # Masks lie as files until their window comes: three windows, one of them first of all.
    windows = [tuple(int(path.stem) for path in masks) for masks in short_windows]
    assert windows == [tuple(range(8, 19)), tuple(range(11)), tuple(range(16, 24))]
    assert told == pytest.approx([1 / 3, 2 / 3, 1])
    settled = found.settled(body)
    joints, expected = joints_of(body, settled), joints_of(body, truth)
    assert worst(missed(body, settled, view, track)) < 1
    # Where windows meet nobody jumps: steps, up to 12 cm long, are as long as they really are.
    steps, real = (places.diff(dim=0).norm(dim=-1) for places in (joints, expected))
    assert max(worst(step) for step in (steps - real).abs()) < 0.02
    depth = joints[:, 0].norm(dim=1) / expected[:, 0].norm(dim=1)
    assert depth.std() < 0.005


def test_windows_tell_the_distance_in_the_same_way(short_windows, monkeypatch):
    """The first of them by a factor, the others by their translations: together by translations."""
    body = the_body()
    motion = replace(random_motion(body, 24, 0, size=0.2), log_distance=torch.zeros(()))

    def window(body, evidence, fps, free_focal, config, space, known, progress):
        times = evidence[0].track.world[:, 0, 0].astype(int)
        part = motion[slice(times[0], times[-1] + 1)]
        if known is not None:
            return part
        root = body.joints[0] + body.joint_basis[0] @ part.betas
        nearer = (root + part.translation) * np.exp(-0.2) - root
        return replace(part, translation=nearer, log_distance=torch.tensor(0.2))

    monkeypatch.setattr(fit_module, "_fit_window", window)
    world = np.broadcast_to(np.arange(24)[:, None, None], (24, 33, 3))
    (view,) = cameras(0.4)
    for best in (0, 8):
        visibility = np.full((24, 33), 0.5)
        visibility[best : best + 8] = 1
        found = fit(body, [Evidence(view, Track(np.zeros((24, 33, 2)), visibility, world.astype(float)))], 20.0)
        torch.testing.assert_close(found.settled(body).translation, motion.translation, atol=1e-5, rtol=0)


@given(
    seed=st.integers(0, 10**6), window=st.integers(4, 12), overlap_=st.integers(1, 4), moments=st.integers(6, 40),
)  # fmt: skip
def test_windows_that_agree_are_joined_to_the_same_motion(seed, window, overlap_, moments):
    """However each tells the root's turn: on top of its own guess."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(fit_module, "OVERLAP", overlap_)
        body = the_body()
        motion = random_motion(body, moments, seed, size=0.2, dtype=torch.float64)
        motion = replace(motion, log_distance=torch.zeros((), dtype=torch.float64))
        parts = []
        for k, start in enumerate(range(0, max(1, moments - overlap_), window)):
            part = motion[start : start + window + overlap_]
            offset = axis_angle_to_matrix(torch.tensor([[0.1 * k, 0.2, -0.1 * k]], dtype=torch.float64))
            turn = axis_angle_to_matrix(part.root) @ offset.transpose(1, 2)
            parts.append(replace(part, guess=offset @ part.guess, root=matrix_to_axis_angle(turn)))
        whole = _joined(parts)
        assert len(whole) == moments
        torch.testing.assert_close(
            axis_angle_to_matrix(whole.full_pose()[:, 0]), axis_angle_to_matrix(motion.full_pose()[:, 0]),
            atol=1e-6, rtol=0,
        )  # fmt: skip
        torch.testing.assert_close(whole.pose, motion.pose)
        torch.testing.assert_close(whole.translation, motion.translation)


def test_windows_that_disagree_fade_into_each_other():
    body = the_body()
    motion = random_motion(body, 40, 0, size=0.0)
    still = replace(motion, translation=torch.zeros(40, 3), guess=torch.eye(3).expand(40, 3, 3))
    other = replace(still, translation=still.translation + 1, pose=still.pose + 0.2, root=still.root + 0.1)
    shared = fit_module.OVERLAP
    whole = _joined([still[:30], other[30 - shared :]])
    assert len(whole) == 40
    for values, end in ((whole.translation[:, 0], 1.0), (whole.pose[:, 3, 1], 0.2), (whole.root[:, 1], 0.1)):
        assert (values[: 30 - shared] == 0).all()
        torch.testing.assert_close(values[30:], torch.full((10,), end))
        steps = values.diff()[29 - shared : 30]
        torch.testing.assert_close(steps, torch.full_like(steps, end / (shared + 1)))
