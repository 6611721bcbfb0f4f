"""Runs side by side: what may be compared, what the table says."""

import json
import shutil
from dataclasses import replace

import numpy as np
import pytest
import torch
from PIL import Image

from twofold.comparison import (
    ComparedRun,
    common_capture,
    comparison_table,
    measured,
    shared_protocol,
    shown_frames,
    write_comparison,
)
from twofold.errors import TwofoldError


def run_of(name, box, chamfer=None, frames="all 3 images"):
    metrics = {
        "novel_view": {"psnr_box": box, "protocol": {"psnr_box": "PSNR of the box", "frames": frames}},
        "cost": {"parameters": 12_000, "protocol": {"parameters": "all of them"}},
    }
    if chamfer is not None:
        metrics["geometry"] = {"chamfer_cm": chamfer, "protocol": {"chamfer_cm": "mean distance"}}
    return ComparedRun(name, "quick", 100, metrics, {})


def test_the_best_of_several_values_is_marked_and_missing_ones_are_dashes():
    table = comparison_table([run_of("a", 20.0, 1.5), run_of("b", 25.0, 0.5), run_of("c", 22.0)])
    assert table.columns == (
        "run", "recipe", "steps", "novel view: box PSNR, dB", "Chamfer distance, cm", "parameters",
    )  # fmt: skip
    assert [line[3] for line in table.rows] == ["20.00", "25.00 *", "22.00"]
    assert [line[4] for line in table.rows] == ["1.50", "0.5000 *", "\N{EN DASH}"]
    assert {line[5] for line in table.rows} == {"12,000"}


def test_what_was_measured_differently_is_told_for_each_run():
    told = shared_protocol([run_of("a", 20.0), run_of("b", 25.0, frames="3 of 9 images")])
    assert told["novel view, psnr box"] == "PSNR of the box"
    assert told["novel view, frames"] == "a: all 3 images; b: 3 of 9 images"


def test_shown_frames_are_of_different_cameras(person):
    frames = shown_frames(person, "novel_view", 30)
    assert len(frames) == min(3, len(person.splits["novel_view"]))
    assert len({f.camera_name for f in frames}) == min(3, len({f.camera_name for f in person.splits["novel_view"]}))
    assert shown_frames(replace(person, splits={"train": person.train}), "novel_pose", 30) == []


@pytest.fixture
def pair(trained, tmp_path):
    """The same run twice."""
    runs = [tmp_path / "first", tmp_path / "second"]
    for run in runs:
        shutil.copytree(trained.folder, run)
    return runs


def test_runs_of_different_captures_are_not_compared(pair):
    first, second = pair
    assert common_capture(pair).is_dir()
    about = json.loads((second / "run.json").read_text())
    (second / "run.json").write_text(json.dumps(about | {"capture": "/captures/smaller"}))
    with pytest.raises(
        TwofoldError, match=r"second was trained on /captures/smaller, but .*first on .*cannot be compared"
    ):
        common_capture(pair)
    with pytest.raises(TwofoldError, match="two runs or more"):
        common_capture([first])
    with pytest.raises(TwofoldError, match="first is named twice"):
        common_capture([first, first])


def test_a_comparison_has_sheets_a_table_and_a_page(trained, pair, tmp_path):
    capture, pieces = trained.capture, []
    runs = [measured(run, capture, torch.device("cpu"), 2, 0, lambda: pieces.append(1)) for run in pair]
    out = tmp_path / "comparison"
    for _ in range(2):  # An earlier comparison is replaced.
        write_comparison(out, capture, runs, 2)
    stored = json.loads((out / "comparison.json").read_text())
    assert [run["run"] for run in stored["runs"]] == ["first", "second"]
    first, second = (run["metrics"]["novel_view"] for run in stored["runs"])
    assert first == second
    assert first["psnr_box"] > 5
    assert stored["runs"][0]["metrics"]["cost"]["training_seconds"] > 0
    assert stored["runs"][0]["steps"] == 100
    text = (out / "comparison.md").read_text()
    assert "| first | " in text
    assert "![Novel views](novel_view.png)" in text
    page = (out / "report.html").read_text()
    assert "data:image/png;base64" in page
    assert "box PSNR" in page
    frame = shown_frames(capture, "novel_view", 2)[0]
    with Image.open(out / "novel_view.png") as image:
        assert image.width > 3 * 10
        colors = np.asarray(image)
    assert runs[0].images["novel_view"][0].shape[0] <= frame.camera.height
    assert colors.std() > 1


def test_a_folder_with_something_else_is_left_alone(trained, tmp_path):
    (tmp_path / "notes.txt").write_text("mine")
    with pytest.raises(TwofoldError, match="holds something that is no comparison"):
        write_comparison(tmp_path, trained.capture, [], 1)
    assert [file.name for file in tmp_path.iterdir()] == ["notes.txt"]
