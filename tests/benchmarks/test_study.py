"""Finished cells become a stored study with every number by row, subject and seed."""

import json

import pytest
from stub_cells import store_results

from benchmarks.study import collect
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
    assert len(study["cells"]) == 3
    assert study["printed"]["Ours"]["view PSNR"] == [30.68]
    assert study["extreme"]["bins"]["w/o feat"] == [[5.0, 15.5, 0.5, 2]]
    assert study["about"] == about


def test_table_without_finished_cells_gives_an_empty_study(tmp_path):
    plan = planned("ablation", [StudioSource(101)], "quick", 1, ("full",))
    study = collect(as_json(fill("ablation", plan, tmp_path, {})), tmp_path / CELLS)
    assert study["rows"] == {}
    assert study["extreme"]["bins"] == {}
    assert pytest.approx(0) == len(study["cells"])
