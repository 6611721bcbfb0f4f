"""Tables as Markdown, LaTeX, JSON and CSV, from stored cells."""

import csv
import io
import json
import re
from dataclasses import replace

import pytest
from stub_cells import store_results

from twofold.files import write_json
from twofold.reproduce.cells import FAILURE, store_cell
from twofold.reproduce.experiments import planned
from twofold.reproduce.sources import FolderSource, StudioSource
from twofold.reproduce.tables import as_json, csv_text, fill, image_rows, latex, markdown, write_table

ABOUT = {"data": "studio", "recipe": "quick", "settings": []}
SOURCES = [StudioSource(101), StudioSource(102)]
METHODS = ("wo_s1c1", "wo_feat", "full")
PSNR = {"wo_s1c1": 20.0, "wo_feat": 24.0, "full": 30.0}


def stored(out, name="ablation", sources=SOURCES, seeds=2, methods=METHODS, psnr=PSNR):
    """A plan whose cells are all done; the PSNR of a row is that of `psnr` plus the seed."""
    plan = planned(name, sources, "quick", seeds, methods)
    for place in plan:
        store_results(store_cell(place.cell, out), psnr.get(place.row.key, 20.0))
    return plan


def cell_of(table, row, column):
    line = next(line for line in as_json(table)["lines"] if line["row"] == row)
    return line["values"][column]


def test_numbers_are_means_with_the_spread_over_seeds_beside_the_papers(tmp_path):
    table = fill("ablation", stored(tmp_path), tmp_path, ABOUT)
    found = cell_of(table, "Ours", "view PSNR")
    assert found["mean"] == pytest.approx(30.5)
    assert found["spread"] == pytest.approx(0.5**0.5)
    assert (found["seeds"], found["subjects"], found["printed"], found["mark"]) == (2, 2, [30.68], "best")
    assert cell_of(table, "w/o feat", "view PSNR")["mark"] == "second"
    assert cell_of(table, "w/o {s1, c1}", "view box PSNR")["printed"] == []


def test_markdown_marks_the_best_and_names_what_is_missing(tmp_path):
    text = markdown(fill("ablation", stored(tmp_path), tmp_path, ABOUT))
    assert "| Ours | **30.50 ± 0.71** (30.68) |" in text
    assert "| w/o feat | <u>24.50 ± 0.71</u> (29.49) |" in text
    assert "| w/o {s1, c1} | 20.50 ± 0.71 (30.13) |" in text
    assert "- n/a: put vgg.pth in weights." in text
    assert "two trainings" in text
    lines = [line for line in text.splitlines() if line.startswith("|")]
    assert len({line.count("|") for line in lines}) == 1
    assert len(lines) == 2 + len(METHODS)


def test_nothing_is_marked_with_one_seed(tmp_path):
    text = markdown(fill("ablation", stored(tmp_path, seeds=1), tmp_path, ABOUT))
    assert "**" not in text
    assert "±" not in text.replace("± is the", "")


def test_latex_is_balanced_and_has_a_column_for_each_number(tmp_path):
    text = latex(fill("ablation", stored(tmp_path), tmp_path, ABOUT))
    rows = [line for line in text.splitlines() if line.endswith(r"\\")]
    columns = re.search(r"\\begin\{tabular\}\{(\w+)\}", text)
    assert columns
    assert {len(re.findall(r"(?<!\\)&", row)) for row in rows} == {len(columns[1]) - 1}
    assert r"w/o $\{s_1, c_1\}$" in text
    assert r"\textbf{30.50 $\pm$ 0.71} {\scriptsize (30.68)}" in text
    assert r"\underline{24.50 $\pm$ 0.71}" in text
    for row in rows:
        assert row.count("{") - row.count(r"\{") == row.count("}") - row.count(r"\}")
        assert len(re.findall(r"(?<!\\)\$", row)) % 2 == 0
    body = text[text.index(r"\begin") :]
    assert not re.search(r"(?<!\\)[#%~^]", body)
    assert all(line.startswith("%") for line in text[: text.index(r"\begin")].splitlines())


def test_rows_that_begin_with_a_bracket_are_no_argument_of_the_line_above(tmp_path):
    plan = stored(tmp_path, "frequency", methods=("[6cm]", "full"))
    text = latex(fill("frequency", plan, tmp_path, ABOUT))
    assert "{}[6 cm] & " in text
    assert not re.search(r"^\[", text, re.MULTILINE)


def test_failed_and_missing_cells_are_said_and_their_rows_not_marked(tmp_path):
    plan = stored(tmp_path)
    lost = [place for place in plan if place.row.key == "full" and place.seed == 1]
    for place in lost:
        (place.cell.folder(tmp_path) / "results.json").unlink()
    write_json(lost[0].cell.folder(tmp_path) / FAILURE, {"failure": "The disk is full."})
    table = fill("ablation", plan, tmp_path, ABOUT)
    text = markdown(table)
    assert "2 of 12 cells are missing" in text
    assert "- Ours, studio 101, seed 1: The disk is full." in text
    assert "| Ours | 30.00 (30.68) |" in text
    assert cell_of(table, "Ours", "view PSNR")["missing"] == 2
    states = [cell["state"] for cell in as_json(table)["cells"]]
    assert states.count("done") == 10
    assert sorted(set(states)) == ["The disk is full.", "done", "not done"]


def test_row_without_any_cell_is_a_dash(tmp_path):
    plan = stored(tmp_path)
    for place in plan:
        if place.row.key == "full":
            (place.cell.folder(tmp_path) / "results.json").unlink()
    assert "| Ours | - (30.68) |" in markdown(fill("ablation", plan, tmp_path, ABOUT))


def test_by_subject_each_has_rows_and_marks_of_its_own(tmp_path):
    sources = [FolderSource("CoreView_377", "a"), FolderSource("ada", "b")]
    plan = stored(tmp_path, "subjects", sources, methods=("npc", "factorized"), psnr={"factorized": 25.0})
    table = fill("subjects", plan, tmp_path, ABOUT)
    assert [(line.subject, line.row.label) for line in table.lines] == [
        ("CoreView_377", "NPC"), ("CoreView_377", "Ours"), ("ada", "NPC"), ("ada", "Ours"),
    ]  # fmt: skip
    assert [line.values[0].mark for line in table.lines] == ["", "best", "", "best"]
    assert [line.printed[0][0] for line in table.lines] == [30.52, 29.92, None, None]
    assert "CoreView\\_377 & NPC" in latex(table)


def test_two_numbers_of_the_paper_stand_behind_each_other(tmp_path):
    plan = stored(tmp_path, "wild", methods=("factorized",))
    assert "n/a (28.52 / 31.74)" in markdown(fill("wild", plan, tmp_path, ABOUT))


def test_files_are_written_together_and_the_csv_has_a_row_for_each_image(tmp_path):
    plan = stored(tmp_path)
    rows = image_rows(plan, tmp_path)
    file = write_table(fill("ablation", plan, tmp_path, ABOUT), rows, tmp_path / "tables", "ablation-studio-quick")
    assert sorted(path.name for path in file.parent.iterdir()) == [
        f"ablation-studio-quick.{ending}" for ending in ("csv", "json", "md", "tex")
    ]
    assert json.loads(file.with_suffix(".json").read_text())["about"]["data"] == "studio"
    read = list(csv.DictReader(io.StringIO(file.with_suffix(".csv").read_text())))
    assert len(read) == len(plan)
    assert {row["cell"] for row in read} == {place.cell.key for place in plan}
    assert read[0]["row"] == "w/o {s1, c1}"


def test_rows_of_different_metrics_share_a_csv():
    rows = [{"a": 1, "b": 0.123456789}, {"a": 2, "c": "x"}]
    assert list(csv.DictReader(io.StringIO(csv_text(rows)))) == [
        {"a": "1", "b": "0.123457", "c": ""}, {"a": "2", "b": "", "c": "x"},
    ]  # fmt: skip


def test_same_cells_give_the_same_files(tmp_path):
    plan = stored(tmp_path)
    first = as_json(fill("ablation", plan, tmp_path, ABOUT))
    assert as_json(fill("ablation", [replace(place) for place in plan], tmp_path, ABOUT)) == first


def test_cells_of_different_versions_are_told(tmp_path):
    plan = stored(tmp_path)
    assert not any("different versions" in note for note in fill("ablation", plan, tmp_path, ABOUT).notes)
    for number, place in enumerate(plan[:5]):
        file = tmp_path / "cells" / place.cell.key / "results.json"
        made_with = {"made_with": "0.1.0 at f22924d" if number else ["damaged"]}
        file.write_text(json.dumps(json.loads(file.read_text()) | made_with))
    table = fill("ablation", plan, tmp_path, ABOUT)
    (note,) = (note for note in table.notes if "different versions" in note)
    assert "0.1.0 at f22924d (4), an unknown one (8)" in note
    assert [cell["made_with"] for cell in as_json(table)["cells"]][:2] == [["damaged"], "0.1.0 at f22924d"]
