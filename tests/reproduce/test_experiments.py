"""Tables as experiments: rows, recipes, shared cells."""

from dataclasses import replace

import pytest

from twofold.errors import TwofoldError
from twofold.methods.factorized_recipes import ABLATIONS, ablation, demo_recipe
from twofold.methods.table import RECIPES
from twofold.reproduce.experiments import EXPERIMENTS, GRID_CM, base_recipe, planned
from twofold.reproduce.scheduling import distinct
from twofold.reproduce.sources import StudioSource

SOURCES = [StudioSource(101), StudioSource(102)]


def plan(name, recipe="quick", **options):
    return planned(name, SOURCES, recipe, options.pop("seeds", 2), **options)


@pytest.mark.parametrize("recipe", ["quick", "fast", "released"])
@pytest.mark.parametrize("name", sorted(set(EXPERIMENTS) - {"beyond"}))
def test_every_table_has_each_row_for_each_subject_and_seed(name, recipe):
    places = plan(name, recipe)
    rows = {place.row.key for place in places}
    assert len(places) == 4 * len(rows) == len({(p.row.key, p.subject, p.seed) for p in places})
    assert {place.cell.recipe.seed for place in places} == {0, 1}
    assert len(distinct([place.cell for place in places])) == len(places)


def test_ablations_are_the_six_and_the_full_model():
    keys = [place.row.key for place in plan("ablation", seeds=1)][:7]
    assert keys == [*ABLATIONS, "full"]


def test_tables_share_the_cells_that_are_the_same_training():
    def keys(name):
        return {place.row.key: place.cell.key for place in plan(name, seeds=1) if place.subject == "studio 101"}

    main, ablations, bands, flow = (keys(name) for name in ("main", "ablation", "frequency", "consistency"))
    assert main["factorized"] == ablations["full"] == bands["full"] == flow["full"]
    # As in the paper, where [10] is w/o {s1, c1}.
    assert bands["[1cm]"] == ablations["wo_s1c1"]
    assert len({*main.values(), *ablations.values(), *bands.values()}) == 6 + 6 + 9


def test_frequencies_of_grids_are_their_finest_spacings():
    field = ablation("[4cm,1cm]", demo_recipe(0)).method.field
    assert field.low_voxels == (0.08, 0.04)
    assert field.high_voxels == (0.02, 0.01)
    alone = ablation("[2cm]", demo_recipe(0)).method
    assert (alone.field.branches, alone.field.high_voxels, alone.losses.common) == ("high", (0.04, 0.02), 0.0)


def test_full_model_on_grids_is_the_one_at_the_named_spacings():
    field = base_recipe("quick", True).method.field
    assert min(field.low_voxels) == GRID_CM[5] / 100
    assert min(field.high_voxels) == GRID_CM[10] / 100
    assert ablation("[6cm,1cm]", demo_recipe(0)).method.field == field


def test_variants_beyond_the_paper_share_the_full_model_and_give_details_to_some_parts():
    cells = {place.row.key: place.cell for place in plan("beyond", seeds=1) if place.subject == "studio 101"}
    full = {place.row.key: place.cell for place in plan("ablation", seeds=1) if place.subject == "studio 101"}["full"]
    assert set(cells) == {"part_bands", "full"}
    assert cells["full"].key == full.key
    field = cells["part_bands"].recipe.method.field
    assert max(field.detail_voxels) < min(field.low_voxels)
    assert replace(field, detail_voxels=()) == full.recipe.method.field


@pytest.mark.parametrize("recipe", ["fast", "released"])
def test_variants_beyond_the_paper_need_feature_grids(recipe):
    with pytest.raises(TwofoldError, match="needs feature grids: --recipe quick"):
        plan("beyond", recipe)
    with pytest.raises(ValueError, match="feature grids only"):
        ablation("part_bands", RECIPES[recipe]())


def test_networks_are_named_in_octaves_and_grids_in_centimetres():
    with pytest.raises(ValueError, match="in centimetres"):
        ablation("[5,10]", demo_recipe(0))
    with pytest.raises(ValueError, match="in octaves"):
        ablation("[6cm,1cm]", RECIPES["fast"]())


def test_synthetic_subjects_have_the_settings_of_the_demo_and_real_ones_those_of_quick():
    assert base_recipe("quick", True).training.steps == 900
    assert base_recipe("quick", False).training.steps == RECIPES["quick"]().training.steps
    assert base_recipe("released", True).method == RECIPES["released"]().method


def test_settings_change_every_recipe():
    places = plan("main", settings=["training.steps=7"])
    assert {place.cell.recipe.training.steps for place in places} == {7}


def test_rows_can_be_chosen_and_unknown_ones_are_refused_with_those_there_are():
    assert {place.row.key for place in plan("main", methods=["npc", "factorized"])} == {"npc", "factorized"}
    with pytest.raises(TwofoldError, match=r"no row 'danbo'; it has humannerf, .*factorized"):
        plan("main", methods=["danbo"])


def test_steps_scale_the_whole_schedule_of_every_row_and_settings_still_hold():
    rows = {place.row.key: place.cell.recipe for place in plan("main", steps=300, settings=["training.pixels.rays=99"])}
    assert {recipe.method.total_steps(recipe.training) for recipe in rows.values()} == {300}
    own, short = RECIPES["npc_fast"]().method.first_steps, rows["npc"].method.first_steps
    assert (own, short) == (500, 75)
    assert {recipe.training.pixels.rays for recipe in rows.values()} == {99}


def test_cells_of_other_lengths_are_other_cells():
    def keys(**options):
        return {place.cell.key for place in plan("ablation", seeds=1, **options)}

    assert not keys() & keys(steps=300)
    assert keys(steps=900) == keys()
