"""Grids as fine as the images: what a pixel covers, which spacings follow, and that a run stores what it was."""

import itertools
from dataclasses import replace

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from small_recipes import CASES

from twofold.capture.types import Capture
from twofold.field.factorized_grid import GridFieldConfig
from twofold.methods.pixel_levels import FINEST, following, levels_for, pixel_size
from twofold.training.loop import train
from twofold.training.run import read_recipe


def larger(capture: Capture, times: float) -> Capture:
    """The same capture as if its images had that many times the rows and columns."""
    frames = []
    for frame in capture.train:
        intrinsics = frame.camera.intrinsics.clone()
        intrinsics[:2] *= times
        frames.append(replace(frame, camera=replace(frame.camera, intrinsics=intrinsics)))
    return replace(capture, splits={**capture.splits, "train": tuple(frames)})


def test_a_pixel_covers_what_moves_the_root_by_a_pixel(person: Capture) -> None:
    pixel = pixel_size(person)
    found = []
    for frame in person.train:
        root = person.body.joints[0] + frame.translation
        right = frame.camera.world_to_camera[0, :3]
        at = [frame.camera.intrinsics @ (frame.camera.world_to_camera[:3] @ torch.cat([p, torch.ones(1)]))
              for p in (root, root + pixel * right)]  # fmt: skip
        found.append(float(at[1][0] / at[1][2] - at[0][0] / at[0][2]))
    assert sorted(found)[(len(found) - 1) // 2] == pytest.approx(1, rel=1e-4)
    assert pixel_size(larger(person, 4)) == pytest.approx(pixel / 4, rel=1e-5)


@given(st.lists(st.floats(0.004, 0.2), min_size=1, max_size=4), st.floats(1e-4, 0.1))
def test_added_spacings_are_halves_and_show_nothing_smaller_than_a_pixel(voxels: list[float], pixel: float) -> None:
    levels = levels_for(tuple(voxels), pixel)
    assert levels[: len(voxels)] == tuple(voxels)
    added = levels[len(voxels) :]
    for above, below in itertools.pairwise((min(voxels), *added)):
        assert below == above / 2
    assert all(level >= max(pixel, FINEST) for level in added)
    assert min(levels) / 2 < max(pixel, FINEST)


def test_large_images_get_a_finer_level_and_the_user_is_told(person: Capture) -> None:
    field = GridFieldConfig(follow_images=True)
    sharp = larger(person, pixel_size(person) / 0.004)
    settled, note = following(field, sharp)
    assert settled.high_voxels == (0.02, 0.01, 0.005)
    assert (settled.finest_radius, settled.follow_images) == (0.04, False)
    assert note is not None
    assert "A pixel covers 4.0 mm of the person, so the feature grids end at 5 mm instead of 10 mm" in note
    assert following(field, larger(person, pixel_size(person) / 0.006)) == (replace(field, follow_images=False), None)
    assert following(replace(field, follow_images=False), sharp)[1] is None


def test_a_run_stores_the_levels_that_it_has(person: Capture, tmp_path) -> None:
    recipe = CASES["quick"]
    field = replace(recipe.method.field, high_voxels=(0.2,), follow_images=True)
    recipe = replace(recipe, method=replace(recipe.method, field=field), training=replace(recipe.training, steps=2))
    said: list[str] = []
    pixel = pixel_size(person)
    avatar = train(person, recipe, tmp_path / "run", torch.device("cpu"), say=said.append)
    expected = levels_for((0.2,), pixel)
    assert len(expected) > 1
    assert read_recipe(tmp_path / "run").method.field.high_voxels == expected == avatar.config.field.high_voxels
    assert any("feature grids end at" in line for line in said)
    # What was stored goes on, from the recipe of the folder as from the one that was given.
    for given_one in (read_recipe(tmp_path / "run"), recipe):
        again = train(person, given_one, tmp_path / "run", torch.device("cpu"), resume=True)
        assert again.config.field.high_voxels == expected
