"""Hours are said as far as they are known."""

from dataclasses import replace

import pytest
from stub_cells import store_results, stub_cells

from twofold.methods.table import RECIPES
from twofold.reproduce.cells import PROGRESS, TRAINING_SHARE, Cell, store_cell
from twofold.reproduce.costs import RATES, expected_seconds, hours, known_rates, left
from twofold.reproduce.experiments import planned
from twofold.reproduce.sources import StudioSource


def test_rate_is_the_median_of_the_cells_that_are_done_here(tmp_path):
    for cell, rate in zip(stub_cells(3), (0.1, 0.2, 9.0), strict=True):
        store_results(store_cell(cell, tmp_path), seconds={"seconds_per_step": rate})
    assert known_rates(tmp_path) == {"demo": 0.2}


def test_rate_of_an_ablation_is_that_of_the_full_model_until_it_is_known():
    cell = stub_cells(1)[0]
    ablated = replace(cell, recipe=replace(cell.recipe, name="demo wo_feat"))
    assert expected_seconds(ablated, {"demo": 0.5}) == pytest.approx(900 * 0.5 / TRAINING_SHARE)
    assert expected_seconds(ablated, {"demo": 0.5, "demo wo_feat": 0.1}) == pytest.approx(900 * 0.1 / TRAINING_SHARE)


def test_what_is_done_is_not_left(tmp_path):
    first, second = stub_cells(2)
    store_results(store_cell(first, tmp_path))
    (store_cell(second, tmp_path) / PROGRESS).write_text('{"share": 0.25, "note": "step 3"}')
    assert left(first, tmp_path, {}) == 0.0
    assert left(second, tmp_path, {"demo": 1.0}) == pytest.approx(0.75 * 900 / TRAINING_SHARE)


def test_recipe_that_nobody_measured_is_unknown(tmp_path):
    cell = Cell(StudioSource(101), replace(RECIPES["quick"](), name="another"))
    assert left(cell, tmp_path, {}) is None
    assert hours([None, 7200.0], 2) == "at least 1.0 hours"


@pytest.mark.parametrize("recipe", ["quick", "fast"])
@pytest.mark.parametrize("table", ["ablation", "frequency"])
def test_every_ablation_that_a_cpu_can_train_has_a_known_rate(table, recipe):
    places = planned(table, [StudioSource(101)], recipe, 1)
    assert {expected_seconds(place.cell, {}) is not None for place in places} == {True}


def test_rates_belong_to_recipes_there_are():
    assert set(RATES) - {"demo"} <= set(RECIPES)


def test_both_stages_of_a_cell_count():
    (place,) = planned("main", [StudioSource(101)], "quick", 1, ["npc"])
    assert expected_seconds(place.cell, {"npc_fast": 1.0}) == pytest.approx(2000 / TRAINING_SHARE)
