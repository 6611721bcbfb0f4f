"""Finished cells become a stored study with every number by row, subject and seed."""

import json

import pytest
from stub_cells import store_results

from benchmarks.study import collect, with_full_model, with_rows_of
from twofold.reproduce.cells import CELLS, store_cell
from twofold.reproduce.experiments import planned
from twofold.reproduce.sources import StudioSource
from twofold.reproduce.tables import as_json, fill


def test_study_holds_the_numbers_of_all_finished_cells_and_nothing_of_the_others(tmp_path):
    plan = planned("ablation", [StudioSource(101)], "quick", 2, ("wo_feat", "full"), ["training.steps=7"])
    for place in plan[:3]:
        store_results(store_cell(place.cell, tmp_path), 20.0)
    about = {"data": "studio", "recipe": "quick", "subjects": ["studio 101"], "seeds": 2, "settings": []}
    table = json.loads(json.dumps(as_json(fill("ablation", plan, tmp_path, about))))
    study = collect(table, tmp_path / CELLS)
    assert study["rows"]["w/o feat"]["novel_pose.psnr_box"] == {"studio 101, seed 0": 15.0, "studio 101, seed 1": 16.0}
    assert study["rows"]["Ours"]["novel_view.psnr_box"] == {"studio 101, seed 0": 15.0}
    assert study["steps"] == {"w/o feat": 7, "Ours": 7}
    assert study["minutes"] == {}, "these cells do not know how long they trained"
    assert len(study["cells"]) == 3
    assert study["printed"]["Ours"]["view PSNR"] == [30.68]
    assert study["extreme"]["bins"]["w/o feat"] == [[5.0, 15.5, 0.5, 2]]
    assert study["about"] == about


def test_study_knows_how_long_a_row_trained(tmp_path):
    plan = planned("ablation", [StudioSource(101)], "quick", 2, ("full",), ["training.steps=120"])
    for place, rate in zip(plan, (1.0, 2.0), strict=True):
        store_results(store_cell(place.cell, tmp_path), seconds={"processor_seconds_per_step": rate})
    table = json.loads(json.dumps(as_json(fill("ablation", plan, tmp_path, {}))))
    assert collect(table, tmp_path / CELLS)["minutes"] == {"Ours": 3.0}


def test_table_without_finished_cells_gives_an_empty_study(tmp_path):
    plan = planned("ablation", [StudioSource(101)], "quick", 1, ("full",))
    study = collect(as_json(fill("ablation", plan, tmp_path, {})), tmp_path / CELLS)
    assert study["rows"] == {}
    assert study["extreme"]["bins"] == {}
    assert pytest.approx(0) == len(study["cells"])


def collected(name, rows, folder, value, settings=()):
    plan = planned(name, [StudioSource(101)], "quick", 1, rows, ["training.steps=7"])
    for place in plan:
        store_results(store_cell(place.cell, folder), value)
    about = {"data": "studio", "recipe": "quick", "settings": list(settings)}
    return collect(json.loads(json.dumps(as_json(fill(name, plan, folder, about)))), folder / CELLS)


def test_full_model_of_another_table_takes_the_place_of_a_missing_one(tmp_path):
    study = collected("beyond", ("part_bands",), tmp_path / "a", 20.0)
    other = collected("ablation", ("wo_feat", "full"), tmp_path / "b", 30.0)
    merged = with_full_model(study, other)
    assert (
        set(merged["rows"]) == set(merged["steps"]) == set(merged["extreme"]["bins"]) == {"Bands by body part", "Ours"}
    )
    assert merged["rows"]["Ours"] == other["rows"]["Ours"]
    assert [cell["row"] for cell in merged["cells"]] == ["Bands by body part", "Ours"]
    assert "Ours" not in study["rows"], "the study itself stays"


def test_full_model_that_was_trained_otherwise_is_refused(tmp_path):
    study = collected("beyond", ("part_bands",), tmp_path / "a", 20.0)
    other = collected("ablation", ("full",), tmp_path / "b", 30.0, ["training.steps=8"])
    with pytest.raises(ValueError, match="settings is"):
        with_full_model(study, other)


def test_rows_of_another_length_join_a_study_of_the_same_subjects(tmp_path):
    study = collected("ablation", ("full", "wo_feat"), tmp_path / "a", 20.0)
    other = collected("ablation", ("full", "pose_lf"), tmp_path / "b", 30.0)
    merged = with_rows_of(study, other)
    rows = {"Ours", "w/o feat", "Pose_lf"}
    assert set(merged["rows"]) == set(merged["steps"]) == set(merged["extreme"]["bins"]) == rows
    assert merged["rows"]["Ours"] == study["rows"]["Ours"] != other["rows"]["Ours"]
    assert [cell["row"] for cell in merged["cells"]].count("Ours") == 1
    assert "Pose_lf" not in study["rows"], "the study itself stays"
    with pytest.raises(ValueError, match="settings is"):
        with_rows_of(study, collected("ablation", ("full",), tmp_path / "c", 30.0, ["training.steps=8"]))
