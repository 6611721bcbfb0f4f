"""`twofold compare` from its words to its last line."""

import json
import shutil

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
