"""Recipes of commit b5dcfbf still mean what they meant."""

import dataclasses
import json
from pathlib import Path

import pytest

from twofold.methods.factorized_recipes import quick, released
from twofold.methods.stored import ABSENT, completed
from twofold.methods.table import DROPPED, RENAMES, recipe_from_dict, recipe_to_dict
from twofold.methods.table import _renamed as renamed

STORED = Path(__file__).with_name("stored")


def leaves(config, prefix=""):
    found = {}
    for key, value in config.items():
        found |= leaves(value, f"{prefix}{key}.") if isinstance(value, dict) else {prefix + key: value}
    return found


@pytest.mark.parametrize("name", ["quick", "released"])
def test_settings_that_a_stored_recipe_lacks_are_what_was_done_before(name):
    stored = json.loads((STORED / f"{name}.json").read_text())
    read, was = leaves(recipe_to_dict(recipe_from_dict(stored, "here"))), leaves(stored)
    was = {RENAMES.get(key, key): value for key, value in was.items() if key not in DROPPED}
    assert {key: read[key] for key in was} == was, "what was stored stays"
    # Each has one of the two kinds of sampler and of field.
    other = {
        "quick": ("method.sampler:ErrorBoundedSampler",),
        "released": ("method.sampler:ShellSampler", "method.field:GridFieldConfig"),
    }[name]
    table = {
        f"{place.partition(':')[0]}.{key}": value
        for place, settings in ABSENT.items()
        for key, value in settings.items()
        if place not in other
    }
    added = {key: read[key] for key in read.keys() - was.keys() - {"method.kind"}}
    assert added == {key: table[key] for key in added}
    assert table.keys() == added.keys()


def test_quick_of_then_is_quick_of_now_but_for_these_settings():
    stored = json.loads((STORED / "quick.json").read_text())
    read = recipe_from_dict(stored, "here")
    # Since then the base branch has a mask term, and rays in random orders a structural one.
    losses = dataclasses.replace(read.method.losses, base_mask=0.3, s3im=0.3)
    # Since then corrections leave alone what no camera sees, average what a frame's images say, and shrink
    # where that is noise.
    pose = dataclasses.replace(read.method.pose, observed_only=True, averages="visits", shrinkage=1.5)
    # Since then rays leap through empty space, steps near the surface are divided, and a grid finds the samples.
    now = quick().method.sampler
    grid = {"training_grid_every": now.training_grid_every}
    sampler = dataclasses.replace(read.method.sampler, leap=0.7, finest=now.finest, **grid)
    rates = dataclasses.replace(read.method.rates, pose=3e-3)
    # Since then grids become as fine as the images, and the fine networks see fewer numbers of the pose.
    field = dataclasses.replace(read.method.field, follow_images=True, pose_code=2)
    changed = {"losses": losses, "pose": pose, "sampler": sampler, "rates": rates, "field": field}
    method = dataclasses.replace(read.method, **changed)
    method = method.completing(on=True)
    assert dataclasses.replace(read, method=method) == quick()


def test_a_recipe_of_now_is_complete():
    assert completed(recipe_to_dict(released())) == recipe_to_dict(released())


def test_every_setting_of_the_table_exists_and_the_old_value_is_allowed():
    for place, settings in ABSENT.items():
        path, _, kind = place.partition(":")
        config = quick() if kind in ("GridFieldConfig", "ShellSampler") else released()
        for name in path.split("."):
            config = getattr(config, name)
        assert not kind or type(config).__name__ == kind
        assert settings.keys() <= {f.name for f in dataclasses.fields(config)}
        # JSON has lists where a configuration has tuples.
        values = {key: tuple(value) if isinstance(value, list) else value for key, value in settings.items()}
        dataclasses.replace(config, **values)


def test_settings_of_one_method_are_not_given_to_another():
    other = {"method": {"kind": "Other", "pose": {}, "losses": {}, "sampler": {"kind": "ErrorBoundedSampler"}}}
    assert completed(other) == other


@pytest.mark.parametrize("odd", [{}, {"method": 3}, {"training": []}, {"method": {"sampler": None}}])
def test_what_is_no_recipe_is_left_to_its_reader(odd):
    found = completed(odd)
    assert {key: found[key] for key in odd if not isinstance(odd[key], dict)} == {
        key: value for key, value in odd.items() if not isinstance(value, dict)
    }


def test_renames_of_an_odd_recipe_do_not_fail():
    odd = {"method": {"rates": 5}, "training": {"rate_low": 1e-3}}
    assert renamed(odd)["method"]["rates"] == 5
    assert renamed({"training": {"rate_low": 1e-3}}) == {"training": {"rate_low": 1e-3}}
