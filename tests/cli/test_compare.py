"""`twofold compare` from its words to its last line."""

import json
import shutil

import pytest
from command_line import refused

from twofold.cli.main import main


def test_two_runs_are_compared_and_the_last_line_says_where(trained, tmp_path, capsys):
    runs = [shutil.copytree(trained.folder, tmp_path / name) for name in ("first", "second")]
    out = tmp_path / "out"
    words = [*map(str, runs), "--out", str(out), "--max-images", "1", "--max-meshes", "0"]
    main(["compare", *words])
    said = " ".join(capsys.readouterr().err.split())
    assert f"The comparison is in {out}. Next: open {out / 'report.html'}" in said
    assert [run["run"] for run in json.loads((out / "comparison.json").read_text())["runs"]] == ["first", "second"]


def test_what_cannot_be_compared_is_one_sentence_and_nothing_is_written(trained, tmp_path, capsys):
    out, other = tmp_path / "out", shutil.copytree(trained.folder, tmp_path / "other")
    about = json.loads((other / "run.json").read_text())
    (other / "run.json").write_text(json.dumps(about | {"capture": "/captures/small"}))
    said = refused(capsys, "compare", trained.folder, other, "--out", out)
    assert f"{other} was trained on /captures/small, but {trained.folder} on {trained.capture.folder}" in said
    assert "expects two runs or more" in refused(capsys, "compare", trained.folder, "--out", out)
    assert "is no run" in refused(capsys, "compare", trained.folder, tmp_path, "--out", out) or not out.exists()
    assert not out.exists()


def test_a_damaged_true_mesh_is_refused_before_anything_is_rendered(trained, tmp_path, capsys, monkeypatch):
    capture = shutil.copytree(trained.capture.folder, tmp_path / "capture")
    for mesh in (capture / "meshes").iterdir():
        mesh.write_bytes(b"no mesh")
    monkeypatch.setattr("twofold.comparison.measured", lambda *given: pytest.fail("something was measured"))
    runs = [shutil.copytree(trained.folder, tmp_path / name) for name in ("first", "second")]
    said = refused(capsys, "compare", *runs, "--capture", capture, "--out", tmp_path / "out")
    assert f"{capture / 'meshes'}" in said
    assert not (tmp_path / "out").exists()
