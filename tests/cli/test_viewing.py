from pathlib import Path

import pytest

from twofold.cli.main import main
from twofold.errors import install_command


def refusal(words: list[str], capsys: pytest.CaptureFixture[str]) -> str:
    with pytest.raises(SystemExit) as end:
        main(words)
    assert end.value.code == 2
    return capsys.readouterr().err


def test_what_is_neither_run_nor_capture_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "me.mp4").write_bytes(b"0")
    assert "is a video, expected a capture folder" in refusal(["view", str(tmp_path / "me.mp4")], capsys)


def test_a_port_that_is_none_is_refused_before_anything_is_read(
    person_folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert "--port should be 1 to 65535" in refusal(["view", str(person_folder), "--port", "99999"], capsys)


def test_a_capture_has_no_other_capture(person_folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    said = refusal(["view", str(person_folder), "--capture", str(person_folder)], capsys)
    assert "is no run; --capture names the capture of a run" in said


def test_a_training_without_viewer_takes_no_port(
    person_folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["train", str(person_folder), "--out", str(tmp_path / "run"), "--port", "8090"]
    assert "--host and --port are the viewer's; add --view" in refusal(words, capsys)
    assert not (tmp_path / "run").exists()


def test_without_viser_one_sentence_says_what_to_install(
    person_folder: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(__import__("sys").modules, "viser", None)
    assert f"run {install_command('viewer')}" in refusal(["view", str(person_folder)], capsys)
