import numpy as np
import pytest
import torch

from twofold.geometry.cameras import project
from twofold.studio.scene import DISTANCE, HEIGHT, degrade_mask, ring, room


@pytest.fixture(scope="module")
def cameras():
    g = np.random.default_rng(0)
    body = g.uniform([-0.4, 0, -0.4], [0.4, 1.7, 0.4], (500, 3)).astype(np.float32)
    return ring(6, 80, body), torch.from_numpy(body)


def test_cameras_stand_in_a_ring_and_the_first_one_ahead(cameras):
    ringed, _ = cameras
    centers = torch.stack([camera.center for camera in ringed.values()])
    assert next(iter(ringed)) == "camera00"
    assert centers[0].tolist() == pytest.approx([0, HEIGHT, DISTANCE], abs=1e-5)
    assert torch.allclose(centers[:, [0, 2]].norm(dim=-1), torch.tensor(DISTANCE), atol=1e-4)
    gaps = (centers - centers.roll(1, 0)).norm(dim=-1)
    assert torch.allclose(gaps, gaps[0].expand(6), atol=1e-4)


def test_cameras_see_all_of_the_body_upright_and_fill_the_image(cameras):
    ringed, body = cameras
    reach = []
    for camera in ringed.values():
        pixels, depth = project(camera, body)
        assert (depth > 0).all()
        assert (pixels > -0.5).all()
        assert (pixels < 79.5).all()
        reach.append(float((pixels - 39.5).abs().max()))
        top, bottom = project(camera, torch.tensor([[0.0, 1.7, 0], [0, 0, 0]]))[0]
        assert top[1] < bottom[1]
        assert float(top[0]) == pytest.approx(39.5, abs=1e-3)
    assert max(reach) > 0.9 * 40


def test_the_room_is_coloured_all_over_and_another_seed_is_another_room(cameras):
    camera = next(iter(cameras[0].values()))
    first, again, other = room(camera, 1), room(camera, 1), room(camera, 2)
    assert first.shape == (80, 80, 3)
    assert 0 <= first.min() <= first.max() <= 1
    assert first.mean((0, 1)).min() > 0.1
    assert (first == again).all()
    assert np.abs(first - other).mean() > 0.01


def disc(size=96, radius=30):
    row, column = np.mgrid[:size, :size]
    return (np.hypot(row - size / 2, column - size / 2) < radius).astype(np.float32)


def test_a_mask_without_noise_is_left_alone():
    mask = disc()
    assert degrade_mask(mask, np.zeros((0, 2), np.float32), 0.0, np.random.default_rng(0)) is mask


def test_spoiling_is_ragged_at_the_edge_and_sound_inside():
    mask = disc()
    spoiled = degrade_mask(mask, np.zeros((0, 2), np.float32), 0.5, np.random.default_rng(1))
    row, column = np.mgrid[:96, :96]
    r = np.hypot(row - 48, column - 48)
    assert (spoiled != mask)[np.abs(r - 30) < 3].any()
    assert (spoiled[r < 24] == 1).all()
    assert (spoiled[r > 38] == 0).all()


def test_at_times_a_hand_is_missing():
    hand = np.array([[48.0, 48.0]], np.float32)
    missing = [degrade_mask(disc(), hand, 1.0, np.random.default_rng(seed))[48, 48] == 0 for seed in range(60)]
    assert 5 < sum(missing) < 30


def overlap(strength, size=96, radius=30):
    """Mean intersection over union of a disc and the same spoiled."""
    mask, values = disc(size, radius), []
    for seed in range(12):
        spoiled = degrade_mask(mask, np.zeros((0, 2), np.float32), strength, np.random.default_rng(seed))
        a, b = mask > 0, spoiled > 0
        values.append((a & b).sum() / (a | b).sum())
    return np.mean(values)


def test_more_noise_is_worse():
    assert 0.8 < overlap(1.0) < overlap(0.3) < 1


def test_small_images_are_spoiled_as_much_as_large_ones():
    lost = [1 - overlap(1.0, size, size // 10) for size in (64, 128, 256)]
    assert max(lost) < 1.5 * min(lost)
