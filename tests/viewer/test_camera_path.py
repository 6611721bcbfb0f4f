import json

import numpy as np
import pytest
import torch

from twofold.errors import TwofoldError
from twofold.geometry.cameras import project
from twofold.viewer.camera_path import KeyView, path_cameras, save_path

UP = np.array([0.0, 1.0, 0.0])
KEYS = [KeyView(np.array([float(x), 0.5, 3.0]), np.array([0.1 * x, 0, 0]), UP, 0.6 + 0.1 * x) for x in (-1, 0, 2)]


@pytest.mark.parametrize("keys", [KEYS, KEYS[:2]])
def test_a_path_goes_through_its_key_views(keys):
    cameras = path_cameras(keys, 10 * (len(keys) - 1) + 1, 60, 80)
    for index, key in enumerate(keys):
        camera = cameras[10 * index]
        assert np.allclose(camera.center.numpy(), key.eye, atol=1e-4)
        pixel, depth = project(camera, torch.from_numpy(key.target).float())
        assert pixel.tolist() == pytest.approx([39.5, 29.5], abs=1e-3)
        assert depth > 0
        assert float(camera.intrinsics[1, 1]) == pytest.approx(30 / np.tan(key.fov / 2), rel=1e-4)


def test_one_view_is_no_path():
    with pytest.raises(TwofoldError, match="two key views or more, there are 1"):
        path_cameras(KEYS[:1], 5, 60, 80)


def test_a_saved_path_holds_every_camera(tmp_path):
    cameras = path_cameras(KEYS, 5, 60, 80)
    save_path(tmp_path / "out" / "path.json", cameras, 30.0)
    stored = json.loads((tmp_path / "out" / "path.json").read_text())
    assert (stored["fps"], stored["height"], stored["width"]) == (30, 60, 80)
    for camera, frame in zip(cameras, stored["frames"], strict=True):
        assert np.allclose(frame["world_to_camera"], camera.world_to_camera.numpy(), atol=1e-6)
        assert np.allclose(frame["intrinsics"], camera.intrinsics.numpy(), atol=1e-4)
