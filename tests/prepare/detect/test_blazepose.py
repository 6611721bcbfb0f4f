import os
from types import ModuleType, SimpleNamespace

import numpy as np
import pytest
from made_clips import real_clip

from twofold.prepare.detect import blazepose as landmarks
from twofold.prepare.detect.blazepose import blazepose_offsets, mediapipe_estimator
from twofold.prepare.detections import LANDMARKS, mirrored_landmarks, track_of
from twofold.prepare.video.frames import Frames


class Pretended:
    """Stands for MediaPipe's graph: finds what it is told to."""

    def __init__(self, **options):
        self.options, self.clock, self.times, self.closed = options, 0, [], 0
        self._simulated_timestamp = 0
        self.found = True

    def process(self, image):
        self._simulated_timestamp += 33_333
        self.times.append(self._simulated_timestamp)
        assert image.flags.c_contiguous
        os.write(2, b"found" if self.found else b"sought")
        if not self.found:
            return SimpleNamespace(pose_landmarks=None, pose_world_landmarks=None, segmentation_mask=None)
        points = [SimpleNamespace(x=i / 33, y=1 - i / 33, z=0.0, visibility=i / 32) for i in range(33)]
        world = [SimpleNamespace(x=0.1 * i, y=0.2, z=-0.3) for i in range(33)]
        mask = np.full(image.shape[:2], 0.5, np.float32) if self.options["enable_segmentation"] else None
        return SimpleNamespace(
            pose_landmarks=SimpleNamespace(landmark=points), pose_world_landmarks=SimpleNamespace(landmark=world),
            segmentation_mask=mask,
        )  # fmt: skip

    def close(self):
        self.closed += 1


@pytest.fixture
def pretended(monkeypatch):
    made = []

    def pose(**options):
        made.append(Pretended(**options))
        return made[-1]

    module = ModuleType("mediapipe")
    module.solutions = SimpleNamespace(pose=SimpleNamespace(Pose=pose))
    monkeypatch.setattr(landmarks, "load_mediapipe", lambda: module)
    return made


def image(height=20, width=66):
    return np.zeros((height, width, 3), np.uint8)


def test_shares_of_the_image_become_pixels(pretended):
    found = mediapipe_estimator()(image(), 0.0)
    # The middle of an image of 66 columns is between columns 32 and 33.
    assert np.allclose(found.pixels[:, 0], np.arange(33) / 33 * 66 - 0.5, atol=1e-4)
    assert np.allclose(found.pixels[:, 1], (1 - np.arange(33) / 33) * 20 - 0.5, atol=1e-4)
    assert np.allclose(found.visibility, np.arange(33) / 32, atol=1e-5)
    assert np.all(found.visibility > 0)
    assert np.allclose(found.world[3], [0.3, 0.2, -0.3])
    assert found.mask.shape == (20, 66)
    assert np.all((found.mask == 127) | (found.mask == 128))


def test_nobody(pretended):
    estimator = mediapipe_estimator()
    estimator(image(), 0.0)
    pretended[0].found = False
    found = estimator(image(), 0.1)
    assert np.isnan(found.pixels).all()
    assert np.isnan(found.world).all()
    assert not found.visibility.any()
    assert found.mask.shape == (20, 66)
    assert not found.mask.any()
    assert not track_of([found]).found.any()


def test_it_is_silenced_until_somebody_was_found(pretended, capfd):
    estimator = mediapipe_estimator()
    estimator(image(), 0.0)
    pretended[0].found = False
    assert capfd.readouterr().err == ""
    estimator(image(), 0.1)
    assert capfd.readouterr().err == "sought"


def test_its_clock_follows_the_clip(pretended):
    estimator = mediapipe_estimator()
    for seconds in (0.0, 0.5, 0.5, 0.4, 2.0):
        estimator(image()[:, ::-1], seconds)
    times = np.array(pretended[0].times)
    assert np.all(np.diff(times) > 0)
    assert times[1] - times[0] == 500_000
    assert times[-1] - times[0] == 2_000_000


def test_masks_are_left_out_on_demand(pretended):
    estimator = mediapipe_estimator(masks=False)
    assert not estimator(image(), 0.0).mask.any()
    assert pretended[0].options["enable_segmentation"] is False
    estimator.close()
    estimator.close()
    assert pretended[0].closed == 1


def test_nobody_in_a_blank_image_and_not_a_word(capfd):
    pytest.importorskip("mediapipe")
    estimator = mediapipe_estimator()
    found = [estimator(np.full((120, 160, 3), 128, np.uint8), 0.1 * i) for i in range(2)]
    estimator.close()
    assert not track_of(found).found.any()
    assert capfd.readouterr().err == ""


def test_a_real_person(capfd):
    pytest.importorskip("mediapipe")
    estimator = mediapipe_estimator()
    seen = [estimator(p.image, p.seconds) for p in Frames(real_clip("pose2sim/cam01.mp4"), fps=6, max_size=640)]
    estimator.close()
    track = track_of(seen)
    assert track.found.all()
    assert capfd.readouterr().err == ""

    def at(name):
        return track.pixels[:, LANDMARKS.index(name)]

    # He faces the camera, upright at first: his left is on the image's right.
    assert at("left_shoulder")[0, 0] > at("right_shoulder")[0, 0] + 20
    assert at("nose")[0, 1] < at("left_shoulder")[0, 1] < at("left_hip")[0, 1] < at("left_ankle")[0, 1]
    world = track.world[0]
    assert world[LANDMARKS.index("left_shoulder"), 0] > world[LANDMARKS.index("right_shoulder"), 0]
    assert world[LANDMARKS.index("left_ankle"), 1] > 0.5
    assert world[LANDMARKS.index("nose"), 2] < 0, "the face is nearer than the hips"
    for view, joints in zip(seen, track.pixels, strict=True):
        covered = view.mask > 127
        assert 0.03 < covered.mean() < 0.3
        column, row = joints[[11, 12, 23, 24]].mean(0).round().astype(int)
        assert covered[row, column]
    assert any(set(np.unique(view.mask)) - {0, 255} for view in seen), "edges are soft"


def test_usual_offsets_are_the_same_on_both_sides():
    offsets = blazepose_offsets()
    assert offsets.shape == (33, 3)
    np.testing.assert_allclose(offsets[list(mirrored_landmarks())] * [-1, 1, 1], offsets, atol=1e-7)
    # Hips are marked closer together, ears far behind.
    assert offsets[LANDMARKS.index("left_hip"), 0] < -0.005
    assert offsets[LANDMARKS.index("right_ear"), 2] > 0.03
