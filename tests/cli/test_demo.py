"""A demo overwrites what a demo has made, and nothing else."""

import json
import subprocess
import sys
from pathlib import Path

import pytest
from command_line import files, refused

from twofold.cli import demo
from twofold.training.lock import locked


class Filmed(Exception):
    """The demo has come as far as filming."""


@pytest.fixture
def filming(monkeypatch: pytest.MonkeyPatch) -> list[Path]:
    """Where demos begin to film; each then ends as a killed program does, with a part of its work on the disk."""
    begun: list[Path] = []
    done = subprocess.run([sys.executable, "-c", "import os; print(os.getpid())"], capture_output=True, check=True)

    def film(config: object, out: Path, progress: object, overwrite: bool) -> None:
        begun.append(out)
        assert overwrite
        part = out.with_name(f"{out.name}.partial-{int(done.stdout)}-01234567")
        part.mkdir(exist_ok=True)
        raise Filmed

    monkeypatch.setattr(demo, "make_studio", film)
    return begun


def begin(out: Path) -> None:
    demo.run_demo(out, 0, lambda share, what: None)


def test_after_a_kill_while_filming_the_same_command_works_again(filming: list[Path], tmp_path: Path) -> None:
    for _ in range(2):
        with pytest.raises(Filmed):
            begin(tmp_path / "new" / "demo")
    assert filming == [tmp_path / "new" / "demo" / "capture"] * 2


def test_after_a_kill_while_its_mark_was_written_a_demo_works_again(filming: list[Path], tmp_path: Path) -> None:
    (tmp_path / ".demo.partial-123-01234567.json").write_text("{")
    with pytest.raises(Filmed):
        begin(tmp_path)


def test_folders_of_the_user_with_the_names_of_a_demos_are_left_alone(
    filming: list[Path], person_folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / "checkpoint.safetensors").write_text("a week's work")
    (tmp_path / "capture").mkdir()
    (tmp_path / "capture" / "capture.json").write_text("{}")
    before = files(tmp_path)
    assert f"{tmp_path} holds files, but no demo.json" in refused(capsys, "demo", "--out", tmp_path)
    assert (files(tmp_path), filming) == (before, [])


@pytest.mark.parametrize(("part", "file", "content"), [
    ("capture", "capture.json", {"name": "studio", "notes": {"made_by": "me"}}),
    ("run", "recipe.json", {"name": "quick"}),
])  # fmt: skip
def test_a_capture_or_run_that_the_user_has_put_into_a_demos_folder_is_left_alone(
    part: str, file: str, content: object, filming: list[Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(Filmed):
        begin(tmp_path)
    (tmp_path / part).mkdir()
    (tmp_path / part / file).write_text(json.dumps(content))
    assert f"{tmp_path / part} is not what a demo has made" in refused(capsys, "demo", "--out", tmp_path)
    assert len(filming) == 1


def test_the_demos_own_capture_and_run_are_overwritten(filming: list[Path], tmp_path: Path) -> None:
    with pytest.raises(Filmed):
        begin(tmp_path)
    for file, content in (
        ("capture/capture.json", {"notes": {"made_by": "studio"}}),
        ("run/recipe.json", {"name": "demo"}),
    ):
        (tmp_path / file).parent.mkdir()
        (tmp_path / file).write_text(json.dumps(content))
    with pytest.raises(Filmed):
        begin(tmp_path)


def test_two_demos_do_not_share_a_folder(
    filming: list[Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / demo.MARK).write_text("{}")
    with locked(tmp_path):
        assert "is being filled by another process" in refused(capsys, "demo", "--out", tmp_path)
    assert filming == []
