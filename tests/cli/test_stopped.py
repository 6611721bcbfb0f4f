"""Whoever stops a command, and a disk that fills up, leave what is whole."""

import contextlib
import shlex
import shutil
import signal
from pathlib import Path

import pytest
import torch
from command_line import files, on_preview, refused, set_small
from disk import files_end_at
from tiny_person import Run

from twofold.cli.main import main
from twofold.training.run import read_checkpoint


def test_ctrl_c_stores_the_state_and_says_how_to_go_on_to_the_same_numbers(
    person_folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    torch.set_num_threads(1)
    on_preview(monkeypatch, lambda step: signal.raise_signal(signal.SIGINT) if step == 4 else None)
    run = tmp_path / "my run"
    with pytest.raises(SystemExit) as ended:
        main(["train", str(person_folder), "--out", str(run), *set_small(7), "--device", "cpu"])
    assert ended.value.code == 130
    said = capsys.readouterr().err.splitlines()[-1]
    assert said == f"twofold: stopped. The training continues with: twofold train --resume '{run}' --device cpu"
    assert read_checkpoint(run)[1] == 5
    main(shlex.split(said.partition(" with: twofold ")[2]))
    on_preview(monkeypatch, lambda step: None)
    main(["train", str(person_folder), "--out", str(tmp_path / "whole"), *set_small(7), "--device", "cpu"])
    (first, *_), (second, *_) = (read_checkpoint(folder) for folder in (run, tmp_path / "whole"))
    assert first.keys() == second.keys()
    assert all(torch.equal(tensor, second[name]) for name, tensor in first.items())


def test_ctrl_c_before_anything_is_there_promises_nothing(
    person_folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def stop(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("twofold.training.loop.Subject.of", stop)
    with pytest.raises(SystemExit) as ended:
        main(["train", str(person_folder), "--out", str(tmp_path / "run")])
    assert ended.value.code == 130
    assert capsys.readouterr().err.splitlines()[-1] == "twofold: stopped."
    assert list(tmp_path.iterdir()) == []


def test_a_disk_that_fills_up_while_training_leaves_the_last_checkpoint(
    person_folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    run = tmp_path / "run"
    with contextlib.ExitStack() as disk:
        on_preview(monkeypatch, lambda step: disk.enter_context(files_end_at(100_000)))
        said = refused(capsys, "train", person_folder, "--out", run, *set_small(5))
    assert f"Cannot write {run / 'checkpoint.safetensors'}" in said
    assert read_checkpoint(run)[1] == 2
    assert files(run) == {
        "checkpoint.safetensors", "coverage.npz", "curves.csv", "recipe.json", "run.json", "subject.npz",
    }  # fmt: skip
    on_preview(monkeypatch, lambda step: None)
    main(["train", "--resume", str(run)])
    assert read_checkpoint(run)[1] == 5


def test_a_disk_that_is_full_at_the_start_gets_no_run(
    person_folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with files_end_at(1000):
        said = refused(capsys, "train", person_folder, "--out", tmp_path / "runs" / "first", *set_small(2))
    assert f"Cannot write {tmp_path / 'runs' / 'first'}" in said
    assert "partial" not in said
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("what", ["canonical", "views", "orbit"])
def test_a_full_disk_ends_drawing_without_half_an_image(
    what: str, trained: Run, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with files_end_at(1000):
        said = refused(capsys, "render", trained.folder, "--what", what, "--size", 16, "--out", tmp_path / "out")
    assert f"Cannot write {tmp_path / 'out'}" in said
    assert not [name for name in files(tmp_path) if "partial" in name or (tmp_path / name).stat().st_size >= 1000]


def test_a_full_disk_ends_measuring_and_leaves_the_last_figures(
    trained: Run, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    shutil.copytree(trained.folder, tmp_path / "run")
    (tmp_path / "run" / "metrics.json").write_text("{}")
    before = files(tmp_path)
    with files_end_at(100):
        said = refused(capsys, "evaluate", tmp_path / "run", "--max-images", 1, "--max-meshes", 0)
    assert f"Cannot write {tmp_path / 'run' / 'metrics.json'}" in said
    assert files(tmp_path) == before
    assert (tmp_path / "run" / "metrics.json").read_text() == "{}"


def test_a_full_disk_ends_filming_and_leaves_nothing(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("anny")
    with files_end_at(500):
        said = refused(capsys, "studio", tmp_path / "mine", "--size", 32, "--frames", 4, "--cameras", 1)
    assert f"Cannot write {tmp_path / 'mine'}" in said
    assert list(tmp_path.iterdir()) == []
