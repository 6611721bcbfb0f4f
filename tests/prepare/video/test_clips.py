"""Clips and their cameras: guessed, given or calibrated, in the size that is used; and what does not go together."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from made_clips import grey, write_clip
from PIL import Image
from walker import camera, projected

from twofold.errors import TwofoldError
from twofold.files import write_json
from twofold.geometry.cameras import Camera, project
from twofold.prepare.cameras.calibration import undistort
from twofold.prepare.video.clips import (
    FOCAL_GUESS,
    PrepareConfig,
    clip_names,
    longer,
    open_clips,
    read_frames,
    read_intrinsics,
    require_options,
)

PLAIN = PrepareConfig()


def a_clip(folder, name="walk", width=240, height=160, count=3):
    """A folder of grey images."""
    (folder / name).mkdir(parents=True)
    for k in range(count):
        Image.fromarray(grey(90 + k, height, width)).save(folder / name / f"{k}.png")
    return folder / name


def small_camera(name, azimuth=0.0, **options):
    """One of the walker's cameras for images of 240 x 160."""
    return replace(
        camera(name, azimuth, **options), height=160, width=240,
        intrinsics=np.array([[200.0, 0, 119], [0, 210, 81], [0, 0, 1]]),
    )  # fmt: skip


def a_calibration(folder, cameras):
    write_json(
        folder / "cameras.json",
        {
            "cameras": {
                c.name: {
                    "world_to_camera": c.world_to_camera.tolist(), "intrinsics": c.intrinsics.tolist(),
                    "height": c.height, "width": c.width, "distortion": c.distortion.tolist(),
                }
                for c in cameras
            }
        },
    )  # fmt: skip
    return folder / "cameras.json"


def test_a_camera_nobody_knows_is_guessed(tmp_path):
    (clip,) = open_clips([a_clip(tmp_path)], PLAIN)
    assert clip.name == "walk"
    assert clip.lens is None
    assert clip.calibrated is None
    assert (clip.camera.height, clip.camera.width) == (160, 240)
    focal = FOCAL_GUESS * 240
    expected = torch.tensor([[focal, 0, 119.5], [0, focal, 79.5], [0, 0, 1]])
    torch.testing.assert_close(clip.camera.intrinsics, expected)
    torch.testing.assert_close(clip.camera.world_to_camera, torch.eye(4))


@pytest.mark.parametrize("max_size", [960, 120, 100, 77])
def test_given_intrinsics_are_those_of_the_clip_itself(tmp_path, max_size):
    """Smaller images see the same: as `Camera.resized` has it, whole pixel areas."""
    config = replace(PLAIN, intrinsics=(300.0, 310.0, 100.0, 90.0), max_size=max_size)
    (clip,) = open_clips([a_clip(tmp_path)], config)
    full = Camera(torch.eye(4), torch.tensor([[300.0, 0, 100], [0, 310, 90], [0, 0, 1]]), 160, 240)
    assert max(clip.camera.height, clip.camera.width) == min(max_size, 240)
    expected = full.resized(clip.camera.height, clip.camera.width)
    torch.testing.assert_close(clip.camera.intrinsics, expected.intrinsics)


@pytest.mark.parametrize("max_size", [960, 120, 100])
@pytest.mark.parametrize("distortion", [(0, 0, 0, 0, 0), (-0.2, 0.05, 1e-3, -1e-3, 0)])
def test_calibrated_cameras_see_the_same_in_smaller_images(tmp_path, max_size, distortion):
    lenses = [small_camera("left", 0.3, distortion=distortion), small_camera("right", 1.4, distortion=distortion)]
    clips = [a_clip(tmp_path, name) for name in ("right", "left")]
    config = replace(PLAIN, calibration=a_calibration(tmp_path, lenses), max_size=max_size)
    ready = open_clips(clips, config)
    assert [clip.name for clip in ready] == ["right", "left"]
    points = np.random.default_rng(0).uniform(-0.5, 0.5, (20, 3)) + np.array([0, 1, 0])
    for clip, lens in zip(ready, lenses[::-1], strict=True):
        scale = np.array([clip.info.width / 240, clip.info.height / 160])
        expected = (projected(lens, points) + 0.5) * scale - 0.5
        found = project(clip.camera, torch.from_numpy(points).float())[0].numpy()
        np.testing.assert_allclose(found, expected, atol=1e-3)
        np.testing.assert_allclose(projected(clip.calibrated, points), expected, atol=1e-9)
        assert not clip.calibrated.distortion.any()
        if not any(distortion):
            assert clip.lens is None
            continue
        # The lens is one for the smaller images, and undone it shows what the full one shows.
        pixels = np.random.default_rng(1).uniform([0, 0], [239, 159], (20, 2))
        small = (pixels + 0.5) * scale - 0.5
        there = (undistort(lens, pixels) + 0.5) * scale - 0.5
        np.testing.assert_allclose(undistort(clip.lens, small), there, atol=5e-3)


def test_a_lens_that_moves_nothing_by_half_a_pixel_is_none(tmp_path):
    lenses = [small_camera("left", distortion=(1e-4, 0, 0, 0, 0)), small_camera("right", distortion=(-0.1, 0, 0, 0, 0))]
    clips = [a_clip(tmp_path, lens.name) for lens in lenses]
    ready = open_clips(clips, replace(PLAIN, calibration=a_calibration(tmp_path, lenses)))
    assert ready[0].lens is None
    assert ready[1].lens is not None


@pytest.mark.parametrize(
    ("file", "name"),
    [("walk.v2", "walk.v2"), ("my walk (1)", "my_walk__1_"), ("--x", "x"), ("läufer", "l_ufer"), ("...", "cam"),
     ("日本", "__")],
)  # fmt: skip
def test_names_of_clips_become_names_of_folders(tmp_path, file, name):
    if file == "...":
        assert clip_names([tmp_path / "..."]) == [name]
        return
    (clip,) = open_clips([a_clip(tmp_path, file)], PLAIN)
    assert clip.name == name


def test_a_video_is_called_without_its_ending(tmp_path):
    path = write_clip(tmp_path / "cam.one.mp4", [grey(k, 64, 96) for k in range(4)], fps=20)
    (clip,) = open_clips([path], PLAIN)
    assert clip.name == "cam.one"
    assert clip.info.fps == pytest.approx(20)
    assert (clip.camera.height, clip.camera.width) == (64, 96)


@pytest.mark.parametrize(
    ("clips", "changes", "words"),
    [
        ((), {}, "none was given"),
        (("a", "b"), {}, "2 videos were given, which need --calibration"),
        (("a",), {"intrinsics": (0.0, 1.0, 1.0, 1.0)}, "fx and fy above 0"),
        (("a",), {"intrinsics": (9.0, 9.0, 1.0, 1.0), "calibration": "c.json"}, "were both given"),
        (("a",), {"held_out": 2}, "One frame of 2 cannot be held out"),
    ],
)
def test_options_that_do_not_go_together_are_refused(tmp_path, clips, changes, words):
    if "calibration" in changes:
        changes = changes | {"calibration": tmp_path / changes["calibration"]}
    with pytest.raises(TwofoldError, match=words):
        require_options([tmp_path / clip for clip in clips], replace(PLAIN, **changes))


def test_options_that_go_together_are_taken(tmp_path):
    require_options([tmp_path / "a"], PLAIN)
    require_options([tmp_path / "a"], replace(PLAIN, held_out=3, intrinsics=(9.0, 9.0, 1.0, 1.0)))
    require_options([tmp_path / "a", tmp_path / "b"], replace(PLAIN, calibration=tmp_path / "c.json"))


@pytest.mark.parametrize("text", ["1,2,3", "1,2,3,4,5", "a,b,c,d", "", "1;2;3;4"])
def test_intrinsics_are_four_numbers(text):
    with pytest.raises(TwofoldError, match="--intrinsics should be four numbers"):
        read_intrinsics(text)
    assert read_intrinsics(None) is None


@pytest.mark.parametrize("text", ["nan,500,10,10", "500,500,inf,10", "0,500,10,10", "500,-1,10,10"])
def test_intrinsics_are_finite_with_a_focal_length_above_zero(tmp_path, text):
    with pytest.raises(TwofoldError, match=f"fx and fy above 0; they are {text}"):
        read_intrinsics(text)
    numbers = tuple(float(number) for number in text.split(","))
    with pytest.raises(TwofoldError, match=f"fx and fy above 0; they are {text}"):
        require_options([tmp_path / "a"], replace(PLAIN, intrinsics=numbers))


def test_intrinsics_of_another_unit_are_refused_before_any_work(tmp_path):
    with pytest.raises(TwofoldError, match=r"--intrinsics 1.2,1.2,0.5,0.5 do not go with the video: the focal length"):
        open_clips([a_clip(tmp_path, "left")], replace(PLAIN, intrinsics=(1.2, 1.2, 0.5, 0.5)))


def test_good_intrinsics_are_taken():
    assert read_intrinsics("1050, 1051.5,540,9.6e2") == (1050, 1051.5, 540, 960)


def test_calibrations_of_other_clips_are_refused(tmp_path):
    calibration = a_calibration(tmp_path, [small_camera("left"), small_camera("right")])
    config = replace(PLAIN, calibration=calibration)
    with pytest.raises(TwofoldError, match=r"cannot be told apart by the cameras of the calibration \(left, right\)"):
        open_clips([a_clip(tmp_path, name) for name in ("a", "b", "c")], config)
    with pytest.raises(TwofoldError, match="was calibrated for 240x160 images, its video has 160x240"):
        open_clips([a_clip(tmp_path / "turned", "left", 160, 240), a_clip(tmp_path / "other", "right")], config)
    with pytest.raises(TwofoldError, match="is missing"):
        open_clips([a_clip(tmp_path, "left")], replace(PLAIN, calibration=tmp_path / "none.json"))


def test_videos_of_several_rates_are_refused_unless_one_is_given(tmp_path):
    calibration = a_calibration(tmp_path, [replace(small_camera(n), height=64, width=96) for n in ("left", "right")])
    images = [grey(k, 64, 96) for k in range(12)]
    clips = [write_clip(tmp_path / f"{n}.mp4", images, fps) for n, fps in (("left", 20), ("right", 25))]
    with pytest.raises(TwofoldError, match=r"different frame rates \(left 20, right 25\).*--fps"):
        open_clips(clips, replace(PLAIN, calibration=calibration))
    ready = open_clips(clips, replace(PLAIN, calibration=calibration, fps=10.0))
    assert [clip.info.fps for clip in ready] == [10, 10]


def test_a_longer_lens_is_the_same_camera_otherwise():
    start = Camera(torch.eye(4), torch.tensor([[50.0, 0, 20], [0, 60, 10], [0, 0, 1]]), 30, 40)
    found = longer(start, 1.5)
    torch.testing.assert_close(found.intrinsics, torch.tensor([[75.0, 0, 20], [0, 90, 10], [0, 0, 1]]))
    assert start.intrinsics[0, 0] == 50
    assert (found.height, found.width) == (30, 40)


def test_intrinsics_of_larger_images_are_refused_before_any_work(tmp_path):
    """Those of 480 x 320 for a video of 240 x 160; of a crop the middle is elsewhere, which is fine."""
    clip = a_clip(tmp_path)
    with pytest.raises(TwofoldError, match=r"the middle of images of about 480x320, and the video has\s240x160"):
        open_clips([clip], replace(PLAIN, intrinsics=(500.0, 500.0, 239.5, 159.5)))
    assert open_clips([clip], replace(PLAIN, intrinsics=(500.0, 500.0, 239.5, 79.5)))[0].info.width == 240


@pytest.mark.parametrize("text", ["", "x", "3-", "7-3", "1,,2", "-1"])
def test_lists_of_frames_are_numbers_and_ranges(text):
    assert read_frames("0, 3,7-9") == (0, 3, 7, 8, 9)
    assert read_frames(None) == ()
    if text:
        with pytest.raises(TwofoldError, match="such as 3,7-9"):
            read_frames(text)
