"""From clips to a capture, with an estimator that knows the truth: what is written and what left out."""

import json
import shutil
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
import torch
from acting import HEIGHT, WIDTH, joints_of
from PIL import Image, ImageDraw
from staged import FPS, PLAIN, SHIRT, Finder, Stage, names

from twofold.capture.folder import read_capture
from twofold.capture.layout import read_contents
from twofold.capture.validate import joint_positions, validate
from twofold.geometry.cameras import project
from twofold.geometry.rotations import axis_angle_to_matrix
from twofold.prepare import pipeline
from twofold.prepare.detect.scan import clean_mask
from twofold.prepare.detections import Track, mirrored_landmarks
from twofold.prepare.fitting.fit import FitConfig, fit
from twofold.prepare.video.clips import PrepareConfig

LENS = (1.1 * HEIGHT, 1.1 * HEIGHT, (WIDTH - 1) / 2, (HEIGHT - 1) / 2)
"""The staged camera's."""


def splits_of(out):
    given = json.loads((out / "capture.json").read_text())["splits"]
    return {split: {e["camera"]: e["times"] for e in entries} for split, entries in given.items()}


def notes_of(out):
    return json.loads((out / "capture.json").read_text())["notes"]


def motion_of(out):
    contents, faults = read_contents(out)
    assert not faults
    return joint_positions(contents), contents


def test_a_clip_becomes_a_capture(tmp_path, monkeypatch):
    monkeypatch.setattr(pipeline, "fit", partial(fit, config=FitConfig(steps=(110, 40))))
    stage, told = Stage(tmp_path / "clips", 14), []
    config = PrepareConfig(credit="me", intrinsics=(220.0, 220.0, (WIDTH - 1) / 2, (HEIGHT - 1) / 2))
    done = stage.prepare(tmp_path / "me", config, progress=lambda share, what: told.append((share, what)))
    assert validate(tmp_path / "me") == []
    assert done.folder == tmp_path / "me"
    assert done.kept == tuple(range(14))
    assert done.mean("iou") > 0.85
    assert done.mean("reprojection") < 2
    assert f"14 of 14 frames, silhouette IoU {done.mean('iou'):.2f}" in done.summary()
    joints, contents = motion_of(tmp_path / "me")
    assert (contents.name, contents.credit, contents.fps) == ("me", "me", FPS)
    # They stand on the floor in the middle of a world with y up, and where they were seen.
    assert joints[..., 1].min() > -0.1
    assert joints[:, 15, 1].min() > 1.1
    assert joints[:, 0, [0, 2]].mean(0).norm() < 0.01
    upright = axis_angle_to_matrix(contents.poses[:, 0])[:, :, 1].mean(0)
    torch.testing.assert_close(upright, torch.tensor([0.0, 1, 0]), atol=1e-3, rtol=0)
    shown = project(contents.cameras["cam0"], joints)[0]
    expected = project(stage.cameras["cam0"], joints_of(stage.body, stage.motion))[0]
    assert (shown - expected).norm(dim=-1).mean() < 2
    shares = [share for share, _ in told]
    assert shares == sorted(shares)
    assert shares[-1] == 1
    assert [what for _, what in told][-1] == "done"
    assert {"looking at the images", "fitting the body", "judging the fit"} <= {what for _, what in told}
    assert all(finder.closed for finder in stage.finders)
    assert names(tmp_path) == ["clips", "me"]


def test_the_world_is_turned_but_no_image_changes(tmp_path, monkeypatch):
    stage = Stage(tmp_path / "clips")
    stage.is_understood(monkeypatch)
    stage.prepare(tmp_path / "me")
    joints, contents = motion_of(tmp_path / "me")
    shown = project(contents.cameras["cam0"], joints)[0]
    expected = project(stage.cameras["cam0"], joints_of(stage.body, stage.motion))[0]
    torch.testing.assert_close(shown, expected, atol=0.02, rtol=0)
    frame = read_capture(tmp_path / "me").train[9]
    assert frame.image_file.suffix == ".jpg"
    with Image.open(stage.clips[0] / f"{frame.frame_index:03d}.png") as image:
        assert np.abs(np.asarray(image) / 255 - frame.image().numpy()).mean() < 0.02
    cleaned = clean_mask(stage.evidence["cam0"].masks[frame.frame_index])
    assert np.array_equal((255 * frame.mask().numpy()).round(), cleaned)


@pytest.mark.parametrize("uneven", [False, True])
def test_frames_of_a_varying_rate_keep_their_times(tmp_path, monkeypatch, uneven):
    seconds = np.arange(14) / FPS + 0.3 * uneven * (np.arange(14) >= 6)
    watch = pipeline.watch_clip
    monkeypatch.setattr(
        pipeline, "watch_clip", lambda *g, **n: replace(watch(*g, **n), seconds=tuple(seconds.tolist()))
    )
    stage = Stage(tmp_path / "clips")
    stage.is_understood(monkeypatch)
    stage.prepare(tmp_path / "me")
    capture = read_capture(tmp_path / "me")
    assert (capture.seconds is not None) == uneven
    np.testing.assert_allclose(capture.seconds_of(range(14)), seconds)


@pytest.mark.parametrize(("every", "held_out"), [(10, [5, 15]), (3, [1, 4, 7, 10, 13, 16, 19, 22])])
def test_every_tenth_frame_is_held_out_between_two_that_train(tmp_path, monkeypatch, every, held_out):
    stage = Stage(tmp_path / "clips", 24)
    stage.is_understood(monkeypatch)
    stage.prepare(tmp_path / "me", replace(PLAIN, held_out=every))
    splits = splits_of(tmp_path / "me")
    assert splits["train"] == {"cam0": [t for t in range(24) if t not in held_out]}
    assert splits["novel_pose"] == {"cam0": held_out}
    assert splits["novel_view"] == {}
    assert notes_of(tmp_path / "me")["every_held_out"] == every


@pytest.mark.parametrize("train", [None, "cam1"])
def test_one_camera_trains_and_the_others_test(tmp_path, monkeypatch, train):
    # Somebody who leans tells nothing about where up is; the calibration does.
    stage = Stage(tmp_path / "clips", 14, azimuths=(0.4, 1.9, 3.3), lean=0.25)
    asked = stage.is_understood(monkeypatch)
    done = stage.prepare(tmp_path / "me", replace(PLAIN, train_camera=train))
    assert validate(tmp_path / "me") == []
    splits, first = splits_of(tmp_path / "me"), train or "cam0"
    trained = [t for t in range(14) if t != 5]
    assert splits["train"] == {first: trained}
    assert splits["novel_view"] == {name: trained for name in stage.cameras if name != first}
    assert splits["novel_pose"] == {name: [5] for name in stage.cameras}
    # A calibrated focal length is not fitted; landmarks are triangulated where they really are.
    ((evidence, fps, free, rest),) = asked
    assert (fps, free, len(evidence)) == (FPS, False, 3)
    places = joints_of(stage.body, stage.motion)
    assert np.abs(rest["points_in_space"][:, 13] - places[:, 18].numpy()).max() < 0.01  # left elbow
    assert {q.camera for q in done.qualities} == set(stage.cameras)
    # The calibrated world has y up already: only its middle and its floor move.
    joints, contents = motion_of(tmp_path / "me")
    moved = joints - places
    torch.testing.assert_close(moved, moved[:1, :1].expand_as(moved), atol=1e-3, rtol=0)
    for name, camera in stage.cameras.items():
        torch.testing.assert_close(contents.cameras[name].world_to_camera[:3, :3], camera.world_to_camera[:3, :3])


def test_clips_that_end_a_little_apart_are_cut(tmp_path, monkeypatch):
    stage = Stage(tmp_path / "clips", 15, azimuths=(0.4, 1.9))
    for time in (13, 14):
        (stage.clips[1] / f"{time:03d}.png").unlink()
    stage.motion = stage.motion[:13]
    stage.is_understood(monkeypatch)
    done = stage.prepare(tmp_path / "me")
    assert done.kept == tuple(range(13))
    assert len(motion_of(tmp_path / "me")[0]) == 13
    assert validate(tmp_path / "me") == []


def test_bad_frames_are_left_out_and_listed(tmp_path, monkeypatch):
    stage = Stage(tmp_path / "clips", 24)
    stage.spoil(7, np.roll(stage.evidence["cam0"].masks[7], 60, 1))
    stage.spoil(8, np.roll(stage.evidence["cam0"].masks[8], 60, 1))
    stage.nobody([12])
    stage.is_understood(monkeypatch)
    done = stage.prepare(tmp_path / "me")
    kept = [t for t in range(24) if t not in (7, 8, 12)]
    assert done.kept == tuple(kept)
    assert "3 frames were left out: 7-8 (the body does not cover the mask); 12 (nobody was found)." in done.warnings
    notes, splits = notes_of(tmp_path / "me"), splits_of(tmp_path / "me")
    assert notes["left_out"] == [7, 8, 12]
    assert notes["warnings"] == list(done.warnings)
    # Every tenth of those that are left.
    assert splits["novel_pose"]["cam0"] == [kept[5], kept[15]]
    assert splits["train"]["cam0"] == [t for t in kept if t not in (kept[5], kept[15])]
    rows = notes["quality"]
    assert [row["frame_index"] for row in rows] == list(range(24))
    assert [row["frame_index"] for row in rows if row["fault"]] == [7, 8, 12]
    assert rows[12]["reprojection"] is None
    assert rows[12]["fault"] == "nobody was found"
    assert "does not cover the mask" in rows[7]["fault"]
    stored = [int(path.stem) for path in sorted((tmp_path / "me" / "images" / "cam0").iterdir())]
    assert stored == kept
    assert validate(tmp_path / "me") == []


def test_exchanged_sides_are_put_right_and_noted(tmp_path, monkeypatch):
    stage = Stage(tmp_path / "clips", 24)
    track = stage.evidence["cam0"].track
    right = Track(**{name: value.copy() for name, value in vars(track).items()})
    for name in ("pixels", "world", "visibility"):
        values = getattr(track, name)
        values[9:14] = values[9:14][:, list(mirrored_landmarks())]
    asked = stage.is_understood(monkeypatch)
    stage.prepare(tmp_path / "me")
    assert notes_of(tmp_path / "me")["sides_exchanged"] == {"cam0": [9, 10, 11, 12, 13]}
    np.testing.assert_allclose(asked[0][0][0].track.pixels, right.pixels, atol=1e-4)


def test_objects_leave_the_mask_and_are_stored_as_ignored(tmp_path, monkeypatch):
    stage = Stage(tmp_path / "clips", 14)
    for time, down in ((5, -20), (6, -8), (7, 4)):
        column, row = stage.evidence["cam0"].track.pixels[6, 15].round().astype(int).tolist()
        box = (column - 2, row - 4 + down, column + 26, row + 24 + down)
        mask = Image.fromarray(stage.evidence["cam0"].masks[time])
        ImageDraw.Draw(mask).ellipse(box, fill=255)
        stage.spoil(time, np.asarray(mask))
        path = stage.clips[0] / f"{time:03d}.png"
        with Image.open(path) as original:
            image = original.convert("RGB")
        ImageDraw.Draw(image).ellipse(box, fill=(20, 240, 30))
        image.save(path)
    stage.is_understood(monkeypatch)
    done = stage.prepare(tmp_path / "me", PrepareConfig(held_objects="remove"))
    assert notes_of(tmp_path / "me")["objects_ignored"] == {"cam0": [5, 6, 7]}
    assert names(tmp_path / "me" / "ignored" / "cam0") == ["000005.png", "000006.png", "000007.png"]
    assert "Held objects were taken out in 3 of 14 images, at most" in done.summary()
    assert validate(tmp_path / "me") == []


def test_a_full_turn_and_a_moving_camera_are_noticed(tmp_path, monkeypatch):
    stage = Stage(tmp_path / "clips", 24, turn=8.0, step=2)
    stage.is_understood(monkeypatch)
    done = stage.prepare(tmp_path / "me")
    notes = notes_of(tmp_path / "me")
    assert notes["yaw_degrees"] > 300
    assert 20 < notes["background_moves_pixels"] < 60
    # Both feet are in the air and swing.
    warning, feet = done.warnings
    assert "the camera does not stand still" in warning
    assert feet.startswith("Feet slide: ")
    assert f"{done.standing.sliding:.2f} m/s" in done.standing.sentence()
    assert notes["standing"]["sliding"] == done.standing.sliding


def test_somebody_who_hardly_turns_is_warned(tmp_path, monkeypatch):
    stage = Stage(tmp_path / "clips", 14, turn=1.0)
    stage.is_understood(monkeypatch)
    warning, feet = stage.prepare(tmp_path / "me").warnings
    assert "turns through only" in warning
    assert feet.startswith("Feet slide: ")
    assert notes_of(tmp_path / "me")["yaw_degrees"] == pytest.approx(np.degrees(13 / FPS), abs=5)  # And walks


def test_own_masks_and_poses_take_the_place_of_what_is_found(tmp_path, monkeypatch):
    stage = Stage(tmp_path / "clips", 14)
    asked = stage.is_understood(monkeypatch)
    own = tmp_path / "masks"
    own.mkdir()
    for time, mask in enumerate(stage.evidence["cam0"].masks):
        Image.fromarray(mask).save(own / f"{time:03d}.png")
        stage.spoil(time)  # the estimator finds none
    poses, motion = tmp_path / "poses.npz", stage.motion
    np.savez(
        poses, poses=motion.full_pose().numpy(), translations=motion.translation.numpy(), betas=motion.betas.numpy()
    )
    done = stage.prepare(tmp_path / "me", replace(PLAIN, masks=own, poses=poses, intrinsics=LENS))
    assert not asked
    assert done.mean("iou") > 0.99
    assert validate(tmp_path / "me") == []
    mask = read_capture(tmp_path / "me").train[3].mask().numpy()
    with Image.open(own / "003.png") as image:
        assert np.array_equal((255 * mask).round(), np.asarray(image))


def test_own_landmarks_take_the_place_of_those_found(tmp_path, monkeypatch):
    stage = Stage(tmp_path / "clips", 14)
    asked = stage.is_understood(monkeypatch)
    track = stage.evidence["cam0"].track
    own = track.pixels + np.float32(1.5)
    np.savez(tmp_path / "own.npz", landmarks=np.concatenate([own, track.visibility[..., None]], -1))
    stage.prepare(tmp_path / "me", replace(PLAIN, landmarks=tmp_path / "own.npz"))
    used = asked[0][0][0].track
    np.testing.assert_allclose(used.pixels, own, atol=1e-4)
    np.testing.assert_allclose(used.world, track.world, atol=1e-5)


def masks_in(folder, masks, first=0):
    folder.mkdir()
    for time, mask in enumerate(masks):
        Image.fromarray(mask).save(folder / f"mask{time + first:03d}.png")
    return folder


def test_masks_that_fit_two_countings_are_compared_with_the_images(tmp_path, monkeypatch):
    """Files 1 to 12 of 14 images: counted from 0 they begin with the second image."""
    stage = Stage(tmp_path / "clips", 14)
    stage.is_understood(monkeypatch)
    own = masks_in(tmp_path / "masks", stage.evidence["cam0"].masks[1:13], first=1)
    done = stage.prepare(tmp_path / "me", replace(PLAIN, masks=own))
    (sentence,) = [warning for warning in done.warnings if "fit the clip in 2 ways" in warning]
    assert "taken as counted from 0" in sentence
    mask = read_capture(tmp_path / "me").train[3].mask().numpy()
    with Image.open(own / "mask003.png") as image:
        assert np.array_equal((255 * mask).round(), np.asarray(image))


def test_the_estimator_sees_the_person_of_the_own_masks_alone(tmp_path, monkeypatch):
    stage = Stage(tmp_path / "clips", 14)
    stage.is_understood(monkeypatch)
    own = masks_in(tmp_path / "masks", stage.evidence["cam0"].masks)
    shown = []
    see = Finder.__call__
    monkeypatch.setattr(Finder, "__call__", lambda self, image, t: shown.append(image) or see(self, image, t))
    counted = []
    stage.prepare(tmp_path / "me", replace(PLAIN, masks=own), people=counted.append)
    assert not counted, "who is meant is known"
    for image, mask in zip(shown, stage.evidence["cam0"].masks, strict=True):
        assert (image[mask > 0] == SHIRT).all(-1).mean() > 0.99
        assert (image[:, :4] == 127).all()


def test_dropped_frames_are_in_no_split_and_listed_with_the_reason(tmp_path, monkeypatch):
    stage = Stage(tmp_path / "clips", 14)
    stage.is_understood(monkeypatch)
    done = stage.prepare(tmp_path / "me", replace(PLAIN, drop=(2, 7)))
    assert {2, 7}.isdisjoint(done.kept)
    assert len(done.kept) == 12
    assert "2 frames were left out: 2, 7 (asked for with --drop)." in done.warnings
    assert notes_of(tmp_path / "me")["left_out_because"] == {"2": "asked for with --drop", "7": "asked for with --drop"}


def test_images_that_repeat_are_left_out(tmp_path, monkeypatch):
    """As in a video that was stretched: no image serves two frames."""
    stage = Stage(tmp_path / "clips", 14)
    stage.is_understood(monkeypatch)
    stage.motion = stage.motion[slice(0, 13)]
    shutil.copy(stage.clips[0] / "012.png", stage.clips[0] / "013.png")
    done = stage.prepare(tmp_path / "me")
    assert done.kept == tuple(range(13))
    assert "cam0: 1 images equal the one before them and are left out." in done.warnings
