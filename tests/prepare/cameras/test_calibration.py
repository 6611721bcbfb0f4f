"""Calibrated cameras: matched to clips, brought to image sizes, freed of distortion."""

from dataclasses import replace

import av
import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from walker import CALIBRATION, CLIPS, camera, needs_clips, projected

from twofold.errors import TwofoldError
from twofold.geometry.cameras import project
from twofold.prepare.cameras.calibration import (
    distort,
    for_pictures,
    match_cameras,
    pinhole,
    undistort,
    undistorter,
)
from twofold.prepare.cameras.calibration_files import read_calibration

POINTS = np.random.default_rng(0).uniform((-0.8, 0.1, -0.8), (0.8, 1.7, 0.8), (50, 3))
LENS = (-0.28, 0.12, 0.002, -0.003, 0.01)


def named(*names):
    return {name: replace(camera(), name=name) for name in names}


@pytest.mark.parametrize(
    ("cameras", "clips", "chosen"),
    [
        (("cam01", "cam02"), ("cam02", "cam01"), ("cam02", "cam01")),
        (("CAM_01", "CAM_02"), ("cam2", "cam-1"), ("CAM_02", "CAM_01")),
        (("int_cam01_img", "int_cam02_img"), ("cam02", "cam01"), ("int_cam02_img", "int_cam01_img")),
        (("cam1", "cam2"), ("walk_cam2_take1", "walk_cam1_take1"), ("cam2", "cam1")),
        (("1", "2", "10"), ("cam10", "cam01"), ("10", "1")),
        (("26580", "26581"), ("walk_Miqus_26581", "walk_Miqus_26580"), ("26581", "26580")),
        (("cam01", "cam02", "cam03"), ("cam03",), ("cam03",)),
        (("a", "b"), ("GX014", "GX015"), ("a", "b")),
        (("left", "right"), ("right side", "left side"), ("right", "left")),
    ],
)
def test_clips_find_their_cameras(cameras, clips, chosen):
    assert [view.name for view in match_cameras(named(*cameras), clips)] == list(chosen)


@pytest.mark.parametrize(
    ("cameras", "clips"),
    [
        (("cam01", "cam02"), ("front",)),
        (("cam01", "cam02"), ("cam01", "front")),
        (("cam1", "cam2"), ("cam1_a", "cam1_b")),
        (("cam1", "cam2"), ("walk", "run", "jump")),
    ],
)
def test_clips_that_tell_nothing_are_refused(cameras, clips):
    with pytest.raises(TwofoldError, match="cannot be told apart by the cameras of the calibration"):
        match_cameras(named(*cameras), clips)


def test_two_clips_of_one_name_are_refused():
    with pytest.raises(TwofoldError, match="Two videos are called cam1; rename one after its camera"):
        match_cameras(named("cam1", "cam2"), ["cam1", "cam1"])


def image(height, width, bars=(0, 0), seed=0):
    pixels = np.random.default_rng(seed).integers(60, 200, (height, width, 3)).astype(np.uint8)
    top, left = bars
    pixels[:top] = pixels[height - top :] = 3
    pixels[:, :left] = pixels[:, width - left :] = 3
    return pixels


def test_images_of_the_calibrated_size_change_nothing():
    assert for_pictures(camera(), image(1280, 720)) is not None
    assert for_pictures(view := camera(), image(1280, 720)) is view


@given(st.sampled_from([(640, 360), (1920, 1080), (427, 240), (1279, 720)]))
def test_scaled_images_show_the_same_in_another_size(size):
    height, width = size
    view = for_pictures(camera(), image(height, width))
    assert (view.height, view.width) == size
    # Fractions of the image stay, counted from its edge at -0.5.
    expected = (projected(camera(), POINTS) + 0.5) / [720, 1280] * [width, height] - 0.5
    assert np.abs(projected(view, POINTS) - expected).max() < 1e-9


def test_black_bars_are_seen():
    # 720 x 1280 shrunk to 700 columns leaves 1244.4 rows, so bars of 17.8 above and below.
    view = for_pictures(camera(), image(1280, 700, bars=(17, 0)))
    expected = (projected(camera(), POINTS) + 0.5) * 700 / 720 + [0, (1280 - 1280 * 700 / 720) / 2] - 0.5
    assert np.abs(projected(view, POINTS) - expected).max() < 1e-9
    wide = for_pictures(camera(), image(720, 1280, bars=(0, 437)))
    expected = (projected(camera(), POINTS) + 0.5) * 720 / 1280 + [437.5, 0] - 0.5
    assert np.abs(projected(wide, POINTS) - expected).max() < 1e-9


def test_dark_images_are_not_taken_for_bars():
    view = for_pictures(camera(), np.zeros((1280, 712, 3), np.uint8))
    assert np.array_equal(view.intrinsics, camera().intrinsics)


def test_what_coders_cut_off_lies_right_and_below():
    for height, width in [(1280, 712), (1272, 720), (1288, 720)]:
        view = for_pictures(camera(), image(height, width))
        assert np.array_equal(view.intrinsics, camera().intrinsics)
        assert (view.height, view.width) == (height, width)


@pytest.mark.parametrize(
    ("size", "sentence"),
    [
        ((720, 1280), "720x1280 images, its video has 1280x720; turn the video upright"),
        ((1080, 1080), "720x1280 images, its video has 1080x1080; give the video as it was calibrated"),
        ((1280, 600), "its video has 600x1280; give the video"),
    ],
)
def test_sizes_that_do_not_go_together_are_refused(size, sentence):
    with pytest.raises(TwofoldError, match=sentence):
        for_pictures(camera(), image(*size))


def test_calibration_without_a_size_takes_the_videos():
    view = for_pictures(replace(camera(), height=None, width=None), image(1280, 720))
    assert (view.height, view.width) == (1280, 720)
    for width, height in ((2160, 3840), (540, 960), (1080, 1920)):
        with pytest.raises(TwofoldError, match=f"the middle of images of about 720x1280, and the video has {width}x"):
            for_pictures(replace(camera(), height=None, width=None), image(height, width))


@pytest.mark.parametrize(("height", "width"), [(640, 368), (848, 480), (1920, 1088)])
def test_a_side_that_an_encoder_rounded_has_its_own_scale(height, width):
    """720 x 1280 scaled to 360 x 640, 477 x 848 and 1080 x 1920, whose shorter sides became multiples of 16."""
    view = for_pictures(camera(), image(height, width))
    assert (view.height, view.width) == (height, width)
    across, down = width / 720, height / 1280
    assert view.intrinsics[0, 0] == pytest.approx(across * camera().intrinsics[0, 0])
    assert view.intrinsics[1, 1] == pytest.approx(down * camera().intrinsics[1, 1])
    middle = (camera().intrinsics[:2, 2] + 0.5) * [across, down] - 0.5
    assert view.intrinsics[:2, 2] == pytest.approx(middle)


def distorted_literally(view, pixel):
    """OpenCV's documentation, for one pixel."""
    k1, k2, p1, p2, k3 = view.distortion
    fx, skew, cx = view.intrinsics[0]
    fy, cy = view.intrinsics[1, 1:]
    y = (pixel[1] - cy) / fy
    x = (pixel[0] - cx - skew * y) / fx
    r = x**2 + y**2
    u = x * (1 + k1 * r + k2 * r**2 + k3 * r**3) + 2 * p1 * x * y + p2 * (r + 2 * x**2)
    v = y * (1 + k1 * r + k2 * r**2 + k3 * r**3) + p1 * (r + 2 * y**2) + 2 * p2 * x * y
    return [fx * u + skew * v + cx, fy * v + cy]


def test_distortion_is_opencvs():
    view = camera(distortion=LENS)
    view.intrinsics[0, 1] = 3.0
    pixels = np.random.default_rng(0).uniform(0, 700, (20, 2))
    assert np.allclose(distort(view, pixels), [distorted_literally(view, pixel) for pixel in pixels])


@given(st.floats(-0.3, 0.3), st.floats(-0.05, 0.1), st.floats(-0.003, 0.003), st.floats(-0.003, 0.003))
def test_undistorting_is_the_inverse(k1, k2, p1, p2):
    view = camera(distortion=(k1, k2, p1, p2, 0.0))
    pixels = np.stack(np.meshgrid(np.linspace(0, 719, 9), np.linspace(0, 1279, 9)), -1)
    assert np.abs(undistort(view, distort(view, pixels)) - pixels).max() < 0.01


def test_unknown_pixels_stay_unknown():
    pixels = np.array([[np.nan, np.nan], [300.0, 200.0]])
    view = camera(distortion=LENS)
    assert np.isnan(undistort(view, pixels)[0]).all()
    assert np.allclose(distort(view, undistort(view, pixels))[1], pixels[1], atol=0.01)


def test_undistorted_images_are_what_a_perfect_lens_shows():
    view = replace(camera(distortion=LENS), height=256, width=144)
    view = replace(view, intrinsics=np.array([[200.0, 0, 71.5], [0, 200, 127.5], [0, 0, 1]]))

    def scene(pixels):
        waves = [100 + 80 * np.sin(pixels[..., 0] / 9 + c) * np.cos(pixels[..., 1] / 13) for c in range(3)]
        return np.stack(waves, -1)

    grid = np.stack(np.meshgrid(np.arange(144.0), np.arange(256.0)), -1)
    taken = scene(undistort(view, grid)).round().astype(np.uint8)
    taken.setflags(write=False)
    straight = undistorter(view, 256, 144)(taken)
    source = distort(view, grid)
    inside = ((source >= 0) & (source <= [143, 255])).all(-1)
    assert inside.mean() > 0.9
    assert np.abs(straight - scene(grid))[inside].max() < 3
    assert np.abs(taken - scene(grid))[inside].max() > 30


def test_pinholes_project_alike():
    view = pinhole(camera(), 1280, 720)
    pixels, depth = project(view, torch.as_tensor(POINTS, dtype=torch.float32))
    assert np.abs(pixels.numpy() - projected(camera(), POINTS)).max() < 1e-2
    assert depth.min() > 0
    assert (view.height, view.width) == (1280, 720)


@needs_clips
def test_black_bars_of_real_clips_are_seen():
    cameras = read_calibration(CALIBRATION)
    for name, view in cameras.items():
        with av.open(str(CLIPS / "pose2sim" / f"{name}.mp4")) as clip:
            first = next(clip.decode(video=0)).to_ndarray(format="rgb24")
        scale = 1080 / 1088 if name in ("cam01", "cam02") else 1.0
        fitted = for_pictures(view, first)
        assert fitted.intrinsics[0, 0] == pytest.approx(scale * view.intrinsics[0, 0])
        assert fitted.intrinsics[1, 1] == pytest.approx(scale * view.intrinsics[1, 1])
        middle = (view.intrinsics[:2, 2] + 0.5) * scale + [0, (1920 - 1920 * scale) / 2] - 0.5
        assert np.allclose(fitted.intrinsics[:2, 2], middle)
