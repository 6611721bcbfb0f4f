"""Figures from trained cells."""

import shutil
from dataclasses import replace

import numpy as np
import pytest
from PIL import Image
from stub_cells import stub_cells
from tiny_person import tiny_recipe

from twofold.errors import TwofoldError
from twofold.files import write_json
from twofold.reproduce.cells import RESULTS, RUN, Cell, store_cell
from twofold.reproduce.experiments import PlannedCell, TableRow
from twofold.reproduce.figures import make_figures
from twofold.reproduce.measuring import Measures, measure_avatar
from twofold.reproduce.sources import FolderSource, folder_digest
from twofold.training.run import load


@pytest.fixture(scope="module")
def experiment(trained, person_folder, tmp_path_factory):
    """Two rows of one trained avatar."""
    out = tmp_path_factory.mktemp("experiment")
    source = FolderSource(str(person_folder), folder_digest(person_folder))
    measures = Measures(3, 1, False)
    found = measure_avatar(load(trained.folder)[0], trained.capture, measures)
    plan = []
    for seed, (key, label) in enumerate([("wo_feat", "w/o feat"), ("full", "Ours")]):
        cell = Cell(source, replace(tiny_recipe(), seed=seed), measures)
        shutil.copytree(trained.folder, store_cell(cell, out) / RUN)
        write_json(cell.folder(out) / RESULTS, {"measures": vars(measures), **found})
        plan.append(PlannedCell(TableRow(key, label, label, tiny_recipe), source.name, 0, cell))
    return out, plan


def test_figures_show_every_row_and_the_branches(experiment, tmp_path):
    out, plan = experiment
    told = []
    files = make_figures({"ablation": plan}, out, tmp_path / "figures", lambda done, name: told.append(name))
    names = ["branches", "ablation", "ablation_canonical", "ablation_geometry", "ablation_extreme", "ablation_worst"]
    assert [file.stem for file in files] == names == told
    for file in files:
        pixels = np.asarray(Image.open(file).convert("RGB"))
        assert min(pixels.shape[:2]) > 60
        assert len(np.unique(pixels.reshape(-1, 3), axis=0)) > 50


def test_without_a_finished_cell_the_command_that_makes_them_is_named(tmp_path):
    cell = stub_cells(1)[0]
    place = PlannedCell(TableRow("full", "Ours", "Ours", tiny_recipe), "studio 101", 0, cell)
    with pytest.raises(TwofoldError, match="run `twofold reproduce ablation`"):
        make_figures({"ablation": [place]}, tmp_path, tmp_path / "figures")
    assert not (tmp_path / "figures").exists()
