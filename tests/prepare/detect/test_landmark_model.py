"""Landmark models of the user's own: what is taken, what is refused, and that it is the one which runs."""

import importlib.util
import zipfile
from pathlib import Path

import numpy as np
import pytest
from made_clips import real_clip

from twofold.errors import TwofoldError
from twofold.prepare.detect import landmark_model
from twofold.prepare.detect.blazepose import mediapipe_estimator
from twofold.prepare.detect.landmark_model import read_landmark_model
from twofold.prepare.video.frames import Frames

MODEL = b"\x20\x00\x00\x00TFL3 ld_3d world_3d"

needs_mediapipe = pytest.mark.skipif(importlib.util.find_spec("mediapipe") is None, reason="MediaPipe is not installed")


def shipped() -> Path:
    spec = importlib.util.find_spec("mediapipe")
    return Path(spec.origin).parent / "modules/pose_landmark/pose_landmark_full.tflite"


def test_a_tflite_and_the_one_in_a_task_are_taken(tmp_path, monkeypatch):
    tried = []
    monkeypatch.setattr(landmark_model, "_runs", lambda model: tried.append(model) is None)
    plain, task = tmp_path / "heavy.tflite", tmp_path / "heavy.task"
    plain.write_bytes(MODEL)
    with zipfile.ZipFile(task, "w") as bundle:
        bundle.writestr("pose_detector.tflite", b"another")
        bundle.writestr("pose_landmarks_detector.tflite", MODEL)
    assert read_landmark_model(plain) == read_landmark_model(task) == MODEL
    assert tried == [MODEL, MODEL]


@pytest.mark.parametrize("content", [b"", b"TFL3", MODEL.replace(b"world_3d", b"hand"), b"PK\x03\x04 cut off"])
def test_other_files_are_refused_in_one_sentence(tmp_path, content):
    (tmp_path / "x.tflite").write_bytes(content)
    with pytest.raises(TwofoldError, match=r"x\.tflite is no landmark model of BlazePose.*npm pack @mediapipe/pose"):
        read_landmark_model(tmp_path / "x.tflite")


def test_a_bundle_of_another_task_is_refused(tmp_path):
    with zipfile.ZipFile(tmp_path / "hands.task", "w") as bundle:
        bundle.writestr("hand_detector.tflite", MODEL)
    with pytest.raises(TwofoldError, match="no landmark model"):
        read_landmark_model(tmp_path / "hands.task")


def test_a_missing_file_and_a_folder_are_named(tmp_path):
    with pytest.raises(TwofoldError, match="does not exist"):
        read_landmark_model(tmp_path / "none.tflite")
    with pytest.raises(TwofoldError):
        read_landmark_model(tmp_path)


@needs_mediapipe
def test_the_model_that_is_given_is_the_one_that_runs(tmp_path):
    """The shipped one under another name finds the same; one that is cut off is refused before it is run here."""
    frame = next(iter(Frames(real_clip("pose2sim/cam01.mp4"), max_size=480)))

    def found(model):
        estimator = mediapipe_estimator(masks=False, model=model)
        try:
            return estimator(frame.image, 0.0).pixels
        finally:
            estimator.close()

    usual = found(None)
    assert np.isfinite(usual).all()
    np.testing.assert_array_equal(found(read_landmark_model(shipped())), usual)
    half = tmp_path / "half.tflite"
    half.write_bytes(shipped().read_bytes()[:100_000] + b"ld_3d world_3d")
    with pytest.raises(TwofoldError, match="cannot run the landmark model"):
        read_landmark_model(half)
    np.testing.assert_array_equal(found(None), usual)
