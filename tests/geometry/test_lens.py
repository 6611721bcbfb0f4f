"""Lens distortion against OpenCV, and its inverse."""

import numpy as np
import pytest

from twofold.geometry.lens import (
    distorted_pixels,
    image_undistorter,
    largest_distortion,
    pixel_places,
    undistorted_pixels,
)

K = np.array([[110.0, 0, 52.0], [0, 112.0, 47.0], [0, 0, 1]])
BENT = np.array([-0.28, 0.12, 0.001, -0.0005, -0.02])


def test_points_agree_with_opencv():
    cv2 = pytest.importorskip("cv2", reason="OpenCV is not installed")
    rays = np.random.default_rng(0).normal(size=(50, 3)) * [0.3, 0.3, 0] + [0, 0, 1]
    theirs = cv2.projectPoints(rays, np.zeros(3), np.zeros(3), K, BENT)[0][:, 0]
    np.testing.assert_allclose(distorted_pixels(K, BENT, (rays @ K.T)[:, :2]), theirs, atol=1e-9)


def test_images_agree_with_opencv():
    cv2 = pytest.importorskip("cv2", reason="OpenCV is not installed")
    rows, columns = np.mgrid[0:96, 0:104]
    waves = [128 + 100 * np.sin(rows / 9 + k) * np.cos(columns / 11) for k in range(3)]
    image = np.stack(waves, -1).astype(np.uint8)
    ours, theirs = image_undistorter(K, BENT, 96, 104)(image), cv2.undistort(image, K, BENT)
    assert np.abs(ours.astype(int) - theirs)[8:-8, 8:-8].max() <= 3  # OpenCV rounds places to 1/32 of a pixel


def test_undistortion_is_the_inverse():
    pixels = pixel_places(np.arange(0, 96, 7), np.arange(0, 104, 7))
    again = distorted_pixels(K, BENT, undistorted_pixels(K, BENT, pixels))
    np.testing.assert_allclose(again, pixels, atol=2e-3)


def test_a_perfect_lens_moves_nothing():
    assert largest_distortion(K, np.zeros(5), 96, 104) < 1e-12
    assert largest_distortion(K, BENT, 96, 104) > 1


def test_the_largest_distortion_is_in_a_corner():
    barrel, corner = np.array([-0.1, 0, 0, 0, 0]), np.array([[0.0, 0.0]])
    moved = np.linalg.norm(distorted_pixels(K, barrel, corner) - corner)
    assert largest_distortion(K, barrel, 94, 104) == pytest.approx(moved, rel=1e-6)
