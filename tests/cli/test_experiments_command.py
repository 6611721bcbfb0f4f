"""`twofold reproduce` on the command line."""

import json
import signal
import subprocess
import sys
import time

import pytest
from command_line import refused, set_small
from stub_cells import stub_work

from twofold.cli.main import main
from twofold.reproduce import cells
from twofold.reproduce.experiments import EXPERIMENTS

DEBUG = ["--cluster", "debug"]
pytestmark = pytest.mark.filterwarnings("ignore::ResourceWarning", "ignore::pytest.PytestUnraisableExceptionWarning")


@pytest.fixture
def quick_work(monkeypatch):
    """Cells are done at once, in this process."""
    monkeypatch.setattr(cells, "train_and_measure", stub_work)


def test_every_table_has_its_name_in_the_help(capsys):
    with pytest.raises(SystemExit):
        main(["reproduce", "--help"])
    shown = capsys.readouterr().out
    assert all(name in shown for name in [*EXPERIMENTS, "figures"])


def test_dry_run_lists_cells_and_hours_and_does_nothing(tmp_path, capsys):
    main(["reproduce", "ablation", "--out", str(tmp_path / "r"), "--seeds", "2", "--dry-run"])
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) == 15
    assert all("not begun" in line and " left" in line for line in lines[:-1])
    assert lines[-1].startswith("14 cells, ")
    assert not (tmp_path / "r").exists()


def test_shards_list_disjoint_parts(tmp_path, capsys):
    keys = []
    for part in ("1/3", "2/3", "3/3"):
        main(["reproduce", "ablation", "--out", str(tmp_path), "--dry-run", "--shard", part])
        keys += [line.split()[0] for line in capsys.readouterr().out.splitlines()[:-1]]
    assert len(keys) == len(set(keys)) == 7


def test_table_is_made_and_made_again_without_work(tmp_path, capsys, quick_work):
    words = ["reproduce", "ablation", "--out", str(tmp_path), "--methods", "full", "wo_feat", "--seeds", "2", *DEBUG]
    main(words)
    said = " ".join(capsys.readouterr().err.split())
    file = tmp_path / "tables" / "ablation-studio-quick.md"
    assert f"The table is {file}. Next: twofold reproduce figures --data studio" in said
    first = file.with_suffix(".json").read_text()
    main(words)
    assert file.with_suffix(".json").read_text() == first
    assert {p.read_text() for p in tmp_path.glob("cells/*/visits")} == {"x"}


def test_failed_cell_is_reported_and_the_others_are_in_the_table(tmp_path, capsys, quick_work):
    words = ["--out", str(tmp_path), "--methods", "full", "--seeds", "14", *DEBUG]
    said = refused(capsys, "reproduce", "ablation", *words)
    assert "Failed: Ours, studio 101, seed 13" in said
    assert "1 of 14 cells failed, the first with: The loss at step 3 is not a finite number." in said
    table = json.loads((tmp_path / "tables" / "ablation-studio-quick.json").read_text())
    assert [cell["state"] for cell in table["cells"]].count("done") == 13


def test_a_shard_makes_its_cells_and_says_that_others_are_missing(tmp_path, capsys, quick_work):
    for part, missing in (("1/2", 3), ("2/2", 0)):
        main(["reproduce", "ablation", "--out", str(tmp_path), "--shard", part, *DEBUG])
        said = " ".join(capsys.readouterr().err.split())
        assert (f"({missing} cells are missing)" in said) == bool(missing)


def test_a_capture_is_trained_and_measured_to_the_end(person_folder, tmp_path, capsys, monkeypatch):
    out, data = tmp_path / "r", str(person_folder)
    options = ["--data", data, "--out", str(out), "--max-images", "2", "--max-meshes", "1", *set_small(3)]
    main(["reproduce", "ablation", "--methods", "full", "wo_s2c2", *options, *DEBUG])
    table = json.loads((out / "tables" / f"ablation-{person_folder.name}-quick.json").read_text())
    assert [line["row"] for line in table["lines"]] == ["w/o {s2, c2}", "Ours"]
    assert all(line["values"]["pose box PSNR"]["mean"] > 3 for line in table["lines"])
    plans: dict[str, list] = {}

    def note(found, folder, place, progress):
        plans.update(found)
        return [place / "branches.png"]

    monkeypatch.setattr("twofold.reproduce.figures.make_figures", note)
    capsys.readouterr()
    main(["reproduce", "figures", *options])
    assert "branches.png" in capsys.readouterr().err
    done = [place.row.key for place in plans["ablation"] if place.cell.results(out)]
    assert done == ["wo_s2c2", "full"]
    assert "main" not in plans, "its recipes have no such settings"


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        (["ablation", "--methods", "npc"], "the table ablation has no row 'npc'; it has wo_s1c1"),
        (["ablation", "--seeds", "0"], "--seeds should be 1 to 1000; it is 0"),
        (["ablation", "--shard", "3/2"], "--shard should be i/n"),
        (["ablation", "--data", "nowhere"], "nowhere is not a folder"),
        (["ablation", "--set", "training.stepz=3"], "stepz"),
        (["main", "--weights", "nowhere"], "nowhere is not a folder; name the one that holds the weights"),
        (["figures"], "holds no finished cell"),
    ],
)
def test_bad_options_are_refused_in_a_sentence(tmp_path, capsys, words, expected):
    assert expected in refused(capsys, "reproduce", *words, "--out", tmp_path / "r")
    assert not (tmp_path / "r").exists()


@pytest.mark.slow
@pytest.mark.skipif(sys.platform == "win32", reason="sends signals")
def test_command_interrupted_twice_ends_with_the_same_table(person_folder, tmp_path, monkeypatch):
    monkeypatch.setenv("PYTHONPATH", ":".join(sys.path))

    def run(out, stopped):
        words = ["reproduce", "ablation", "--methods", "full", "wo_feat", "--data", str(person_folder)]
        words += ["--out", str(out), "--max-images", "2", "--max-meshes", "1", *set_small(100)]
        for note in out.glob("cells/*/progress.json"):
            note.unlink()
        process = subprocess.Popen([sys.executable, "-m", "twofold", *words], stderr=subprocess.PIPE, text=True)
        while stopped and process.poll() is None:
            notes = [file.read_text() for file in out.glob("cells/*/progress.json")]
            if any("step" in note for note in notes):
                process.send_signal(signal.SIGINT)
                break
            time.sleep(0.02)
        said = process.communicate()[1]
        return process.returncode, said

    assert run(tmp_path / "whole", False)[0] == 0
    for _ in range(2):
        code, said = run(tmp_path / "parts", True)
        assert code == 130, said
        assert "the same command goes on from there" in said
        assert "Traceback" not in said
    assert run(tmp_path / "parts", False)[0] == 0
    name = f"tables/ablation-{person_folder.name}-quick.json"
    assert (tmp_path / "parts" / name).read_text() == (tmp_path / "whole" / name).read_text()


def test_steps_are_those_of_every_cell_and_stand_with_the_table(tmp_path, capsys, quick_work):
    words = [
        "reproduce",
        "main",
        "--out",
        str(tmp_path),
        "--methods",
        "npc",
        "factorized",
        "--steps",
        "40",
        "--max-images",
        "6",
        *DEBUG,
    ]
    main(words)
    said = " ".join(capsys.readouterr().err.split())
    # The figures are of the same cells only with the same options.
    assert "Next: twofold reproduce figures --data studio" in said
    assert "--steps 40 --max-images 6" in said
    found = [cells.read_cell(folder).recipe for folder in (tmp_path / "cells").iterdir()]
    assert sorted(recipe.method.total_steps(recipe.training) for recipe in found) == [40, 40]
    assert json.loads((tmp_path / "tables" / "main-studio-quick.json").read_text())["about"]["steps"] == 40


def test_steps_below_one_are_refused_in_one_sentence(tmp_path, capsys):
    assert "--steps should be at least 1; it is 0" in refused(capsys, "reproduce", "main", "--steps", 0)
