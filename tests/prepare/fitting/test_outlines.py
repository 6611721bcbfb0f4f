"""Masks as distances and outlines, against the plain way to compute them, and where there is no person at all."""

from dataclasses import fields

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image
from scipy import ndimage

from twofold.prepare.fitting.outlines import open_mask, trace_outlines

seeds = st.integers(0, 10**6)


def disc(center, radius, height=180, width=240):
    """Soft by half a pixel, as a mask of area is; `center` is (column, row)."""
    rows, columns = np.mgrid[:height, :width]
    away = np.hypot(columns - center[0], rows - center[1])
    return (255 * np.clip(radius - away + 0.5, 0, 1)).round().astype(np.uint8)


def blob(seed, height=90, width=120):
    """Somebody of no particular shape, nowhere thinner than some cells of the grid."""
    rng = np.random.default_rng(seed)
    noise = ndimage.gaussian_filter(rng.standard_normal((height, width)), 7)
    rows, columns = np.mgrid[:height, :width]
    middle = np.exp(-(((columns - width / 2) / 25) ** 2) - ((rows - height / 2) / 25) ** 2)
    shape = ndimage.binary_opening(noise / noise.std() + 4 * middle > 2, iterations=3)
    return (shape * 255).astype(np.uint8)


def slow_distance(mask, pixels):
    """To the nearest pixel of the person, one by one."""
    rows, columns = np.nonzero(mask > 127)
    person = np.stack([columns, rows], 1)
    return np.linalg.norm(pixels[:, None] - person, axis=-1).min(1)


@given(seed=seeds)
def test_distances_are_those_to_the_nearest_pixel_of_the_person(seed):
    mask = blob(seed)
    outlines = trace_outlines([mask])
    rows, columns = np.nonzero(mask > 127)
    low, high = np.array([columns.min(), rows.min()]), np.array([columns.max(), rows.max()])
    rng = np.random.default_rng(seed)
    # Within the surroundings, and not where distances fade at the image's edge.
    reach, edge = 0.3 * (high - low).max(), 2 * float(outlines.cell[0])
    size = np.array([119, 89])
    places = rng.uniform(np.maximum(low - reach, edge), np.minimum(high + reach, size - edge), (200, 2))
    found = outlines.away(torch.from_numpy(places)[None].float())[0].numpy()
    np.testing.assert_allclose(found, slow_distance(mask, places), atol=1.5 * float(outlines.cell[0]) + 1)
    inside = np.stack([columns, rows], 1)[ndimage.binary_erosion(mask > 127, iterations=3)[rows, columns]]
    if len(inside):
        assert not outlines.away(torch.from_numpy(inside)[None].float()).any()


def test_far_away_counts_as_the_edge_of_the_surroundings():
    outlines = trace_outlines([disc((120, 90), 30)])
    away = outlines.away(torch.tensor([[[165.0, 90], [220, 90], [10000, 90]]]))[0]
    assert away[0] == pytest.approx(15, abs=1)
    assert away[1] == away[2] == pytest.approx(21, abs=1)


@given(radius=st.floats(15, 60), across=st.floats(-8, 8), down=st.floats(-8, 8))
def test_the_outline_of_a_disc_is_its_circle(radius, across, down):
    center = np.array([120 + across, 90 + down])
    outlines = trace_outlines([disc(center, radius)])
    points, normals = outlines.points[0].numpy() - center, outlines.normals[0].numpy()
    distance = np.linalg.norm(points, axis=1)
    np.testing.assert_allclose(distance, radius, atol=0.6 * float(outlines.cell[0]) + 0.4)
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1, atol=1e-5)
    assert ((normals * points).sum(1) / distance > 0.97).all()
    angles = np.sort(np.arctan2(points[:, 1], points[:, 0]))
    assert np.diff(angles, append=angles[0] + 2 * np.pi).max() < 4 * 2 * np.pi / len(points)
    assert outlines.size == pytest.approx(2 * radius, abs=2)


@pytest.mark.parametrize("kind", ["empty", "speck", "line", "faint"])
def test_a_mask_without_a_person_is_known_as_such_and_all_numbers_are_finite(kind):
    mask = np.zeros((50, 60), np.uint8)
    if kind == "speck":
        mask[20:22, 30:32] = 255
    elif kind == "line":
        mask[20, :] = 255
    elif kind == "faint":
        mask[10:40, 20:30] = 100
    outlines = trace_outlines([mask, disc((30, 25), 12, 50, 60)])
    assert outlines.known.tolist() == [0, 1]
    assert outlines.size == pytest.approx(24, abs=2)  # of the mask that shows somebody
    for field in fields(outlines):
        if field.name != "size":
            assert getattr(outlines, field.name).isfinite().all()
    assert not outlines.away(torch.tensor([[[3.0, 4.0]], [[30.0, 25.0]]])).any()
    assert not outlines.normals[0].any()
    nobody = trace_outlines([mask])
    assert np.isfinite(nobody.size)
    assert nobody.size > 0


@pytest.mark.parametrize("side", ["left", "right", "top", "bottom"])
def test_no_outline_where_the_image_cuts_the_person_off(side):
    center = {"left": (5, 90), "right": (234, 90), "top": (120, 5), "bottom": (120, 174)}[side]
    outlines = trace_outlines([disc(center, 40)])
    edge = {"left": -0.5, "right": 239.5, "top": -0.5, "bottom": 179.5}[side]
    axis = 0 if side in ("left", "right") else 1
    points = outlines.points[0].numpy()
    assert np.abs(points[:, axis] - edge).min() > float(outlines.cell[0])
    assert np.abs(np.linalg.norm(points - center, axis=1) - 40).max() < 1
    assert np.linalg.norm(outlines.normals[0].numpy(), axis=1).min() > 0.99
    # Beyond the image the person may go on, so nothing counts as outside there.
    beyond = np.array(center, dtype=np.float32)
    beyond[axis] = edge + (-12 if side in ("left", "top") else 12)
    assert float(outlines.away(torch.from_numpy(beyond)[None, None])) == 0
    # In the image it does.
    inside = np.array(center, dtype=np.float32)
    inside[axis] += 55 if side in ("left", "top") else -55
    assert float(outlines.away(torch.from_numpy(inside)[None, None])) == pytest.approx(15, abs=1.5)


def test_somebody_who_fills_the_image_has_no_outline():
    outlines = trace_outlines([np.full((40, 50), 255, np.uint8)])
    assert outlines.known.tolist() == [1]
    assert not outlines.normals.any()
    assert not outlines.away(torch.tensor([[[25.0, 20.0], [-30.0, 20.0], [25.0, 60.0]]])).any()


def test_pixels_that_are_no_numbers_do_not_crash():
    outlines = trace_outlines([disc((120, 90), 30)])
    places = torch.tensor([[[torch.nan, 3], [torch.inf, 90], [-torch.inf, torch.nan], [1e30, -1e30], [120, 90]]])
    away = outlines.away(places.requires_grad_())
    assert away.isfinite().all()
    assert float(away[0, -1].detach()) == 0
    away.sum().backward()


def test_distance_grows_outwards():
    outlines = trace_outlines([disc((120, 90), 30)])
    angle = torch.linspace(0, 6.28, 40)
    direction = torch.stack([angle.cos(), angle.sin()], -1)
    places = (torch.tensor([120.0, 90]) + 42 * direction)[None].requires_grad_()
    outlines.away(places).sum().backward()
    assert ((places.grad[0] * direction).sum(-1) > 0.85).all()


def test_files_are_as_good_as_arrays_and_parts_as_the_whole(tmp_path):
    masks = [disc((100 + 5 * k, 90), 25 + k) for k in range(4)]
    paths = [tmp_path / f"{k}.png" for k in range(4)]
    for path, mask in zip(paths, masks, strict=True):
        Image.fromarray(mask).save(path)
    whole, from_files = trace_outlines(masks), trace_outlines(paths)
    assert np.array_equal(open_mask(paths[1]), masks[1])
    part = whole[1:3]
    for field in fields(whole):
        first, second, some = (getattr(o, field.name) for o in (whole, from_files, part))
        if field.name == "size":
            assert first == second == some
        else:
            assert torch.equal(first, second)
            assert torch.equal(first[1:3], some)
