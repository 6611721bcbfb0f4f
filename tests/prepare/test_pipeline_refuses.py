"""Clips that cannot work, places that cannot be written, Ctrl-C: one sentence, and nothing is left behind."""

from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from acting import HEIGHT
from PIL import Image
from staged import PLAIN, Stage, names

from twofold.capture.layout import read_contents
from twofold.errors import TwofoldError
from twofold.prepare import pipeline
from twofold.prepare.detect.people import People
from twofold.prepare.pipeline import prepare


def too_short(stage):
    for path in sorted(stage.clips[0].iterdir())[5:]:
        path.unlink()


def half_bad(stage):
    for time in range(2, 8):
        stage.spoil(time, np.roll(stage.evidence["cam0"].masks[time], 60, 1))


def cut_off(stage):
    stage.evidence["cam0"].track.pixels[:, [27, 28]] = [50, HEIGHT + 20]


def damaged(stage):
    (stage.clips[0] / "009.png").write_bytes(b"no image")


FAILURES = [
    (too_short, {}, "has 5 images, expected at least 12"),
    (lambda stage: stage.nobody(range(14)), {}, "shows nobody; film one whole person"),
    (lambda stage: stage.nobody(range(5)), {}, "shows a person in only 64 % of the images"),
    (half_bad, {}, "6 of 14 images of cam0 could not be understood (frames 2-7); at 2, for one, the body does not"),
    (cut_off, {}, "of cam0 head, hands or feet are beyond the image's edge"),
    (damaged, {}, "009.png is"),
    (lambda stage: None, {"train_camera": "side"}, "--train-camera side is none of the clips; they are cam0."),
    (lambda stage: None, {"drop": (3, 14)}, "--drop names frame 14, and cam0 has 14, counted from 0"),
    (lambda stage: None, {"person": "masks"}, "give them with --masks, too"),
    (lambda stage: None, {"person": 0}, "--person counts people from the left, from 1; it is 0"),
    (lambda stage: None, {"held_out": 1}, "One frame of 1 cannot be held out"),
    (lambda stage: stage.clips.append(stage.clips[0]), {}, "2 videos were given, which need --calibration"),
    (lambda stage: stage.clips.clear(), {}, "none was given"),
    (lambda stage: stage.clips.__setitem__(0, stage.folder / "gone.mp4"), {}, "gone.mp4 does not exist"),
]


@pytest.mark.parametrize(("spoil", "changes", "words"), FAILURES)
def test_clips_that_cannot_work_are_refused_and_leave_nothing(tmp_path, monkeypatch, spoil, changes, words):
    stage = Stage(tmp_path / "clips", 14)
    spoil(stage)
    stage.is_understood(monkeypatch)
    with pytest.raises(TwofoldError) as error:
        stage.prepare(tmp_path / "new" / "me", replace(PLAIN, **changes))
    assert words in str(error.value)
    assert "\n" not in str(error.value)
    assert names(tmp_path) == ["clips"]
    assert all(finder.closed for finder in stage.finders)


def masks_of_nobody_there(stage, folder):
    folder.mkdir()
    for time in range(14):
        Image.fromarray(np.roll(stage.evidence["cam0"].masks[time], 60, 1)).save(folder / f"{time:03d}.png")
    return {"masks": folder}


def poses_at_the_origin(stage, folder):
    folder.mkdir()
    np.savez(folder / "poses.npz", poses=np.zeros((14, 24, 3)), translations=np.zeros((14, 3)))
    return {"poses": folder / "poses.npz"}


def landmarks_anywhere(stage, folder):
    folder.mkdir()
    values = np.random.default_rng(0).uniform(20, HEIGHT - 20, (14, 33, 3))
    values[..., 2] = 1
    np.savez(folder / "landmarks.npz", landmarks=values)
    return {"landmarks": folder / "landmarks.npz"}


def landmarks_of_half_the_clip(stage, folder):
    given = landmarks_anywhere(stage, folder)
    with np.load(given["landmarks"]) as stored:
        values = stored["landmarks"]
    values[7:] = 0
    np.savez(given["landmarks"], landmarks=values)
    return given


@pytest.mark.parametrize(
    "spoil", [masks_of_nobody_there, poses_at_the_origin, landmarks_anywhere, landmarks_of_half_the_clip]
)
def test_what_the_user_gave_is_blamed_before_the_film(tmp_path, monkeypatch, spoil):
    stage = Stage(tmp_path / "clips", 14)
    stage.is_understood(monkeypatch)
    given = spoil(stage, tmp_path / "own")
    ((piece, path),) = given.items()
    with pytest.raises(TwofoldError) as error:
        stage.prepare(tmp_path / "me", replace(PLAIN, **given))
    assert f"the likeliest cause is --{piece} {path} (" in str(error.value)
    assert "film" not in str(error.value)
    assert names(tmp_path) == ["clips", "own"]


def test_a_calibration_whose_names_go_with_other_cameras_is_blamed(tmp_path, monkeypatch):
    stage = Stage(tmp_path / "clips", 14, azimuths=(0.4, 1.9))
    stage.is_understood(monkeypatch)
    first, second = stage.cameras.values()
    stage.cameras = {"cam0": second, "cam1": first}
    with pytest.raises(TwofoldError, match=r"the likeliest cause is --calibration .*cameras\.json \(do its cameras'"):
        stage.prepare(tmp_path / "me")
    assert names(tmp_path) == ["clips"]


@pytest.mark.parametrize("refuse", ["refuse", "ignore"])
def test_several_people_are_refused_unless_told_otherwise(tmp_path, monkeypatch, refuse):
    stage, shown = Stage(tmp_path / "clips", 14), []
    stage.is_understood(monkeypatch)

    def crowd(images):
        shown.extend(images)
        return People((2,) * len(images))

    config = replace(PLAIN, several_people=refuse)
    if refuse == "ignore":
        stage.prepare(tmp_path / "me", config, people=crowd)
        assert not shown
        return
    with pytest.raises(TwofoldError, match="shows several people of about the same size in 100 % of its images"):
        stage.prepare(tmp_path / "me", config, people=crowd)
    assert len(shown) >= 12
    assert names(tmp_path) == ["clips"]


@pytest.mark.parametrize("where", ["looking", "fitting", "judging"])
def test_ctrl_c_leaves_nothing(tmp_path, monkeypatch, where):
    stage = Stage(tmp_path / "clips", 14)
    stage.is_understood(monkeypatch)

    def stop(*given, **named):
        raise KeyboardInterrupt

    if where == "looking":
        stage.interrupt = KeyboardInterrupt()
    elif where == "fitting":
        monkeypatch.setattr(pipeline, "fit", stop)
    else:
        monkeypatch.setattr(pipeline, "compare_with_pictures", stop)
    with pytest.raises(KeyboardInterrupt):
        stage.prepare(tmp_path / "new" / "me")
    assert names(tmp_path) == ["clips"]
    assert all(finder.closed for finder in stage.finders)


def content(folder):
    return {path.relative_to(folder): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def test_what_lies_there_is_overwritten_only_if_asked_and_if_all_goes_well(tmp_path, monkeypatch):
    stage = Stage(tmp_path / "clips", 14)
    stage.is_understood(monkeypatch)
    out = tmp_path / "me"
    stage.prepare(out)
    before = content(out)
    again = partial(prepare, stage.clips, out, stage.body)
    calls = []
    with pytest.raises(TwofoldError, match="already holds a capture; choose another name or remove that one first"):
        again(lambda: calls.append(1), PLAIN)
    assert not calls  # known before any work
    stage.finders.clear()
    stage.interrupt = TwofoldError("The estimator is tired.")
    with pytest.raises(TwofoldError, match="tired"):
        again(stage.estimator, PLAIN, overwrite=True)
    assert content(out) == before
    stage.interrupt = None
    stage.finders.clear()
    again(stage.estimator, replace(PLAIN, credit="somebody"), overwrite=True)
    assert read_contents(out)[0].credit == "somebody"
    after = content(out)
    assert {path for path in after if after[path] != before[path]} == {
        path for path in before if path.name == "capture.json"
    }
    (out / "mine.txt").write_text("do not lose this")
    with pytest.raises(TwofoldError, match=r"holds mine.txt, which is no part of a capture"):
        again(stage.estimator, PLAIN, overwrite=True)
    assert (out / "mine.txt").exists()
    assert names(tmp_path) == ["clips", "me"]


def test_a_place_that_cannot_be_written_is_known_before_any_work(tmp_path, monkeypatch):
    stage = Stage(tmp_path / "clips", 12)
    stage.is_understood(monkeypatch)
    (tmp_path / "file").write_text("x")
    with pytest.raises(TwofoldError, match="Cannot write"):
        stage.prepare(tmp_path / "file" / "me")
    assert not stage.finders


@pytest.mark.parametrize("piece", ["masks", "landmarks", "poses", "train_camera"])
def test_what_the_user_names_is_checked_before_any_image_is_looked_at(tmp_path, piece):
    stage = Stage(tmp_path / "clips", 14)
    value = "side" if piece == "train_camera" else tmp_path / "none.npz"
    with pytest.raises(TwofoldError, match="is none of the clips" if piece == "train_camera" else "none.npz"):
        stage.prepare(tmp_path / "me", replace(PLAIN, **{piece: value}))
    assert not stage.finders
