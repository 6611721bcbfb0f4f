"""Commands that make captures: what they refuse, and what they say comes next."""

from pathlib import Path

import pytest
from command_line import refused

from twofold.cli.main import main


def test_what_was_imported_is_to_be_checked_first(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("twofold.prepare.import_fitted.import_prepared", lambda *_, **__: None)
    main(["import", str(tmp_path / "given"), str(tmp_path / "capture")])
    assert f"Next: twofold check {tmp_path / 'capture'}" in " ".join(capsys.readouterr().err.split())


@pytest.mark.parametrize("below", ["", "page"])
def test_a_page_in_the_place_of_a_file_is_refused_before_any_work(
    below: str, person_folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "file").write_text("mine")
    monkeypatch.setattr("twofold.check.measure.measure_capture", lambda *_: pytest.fail("work was done"))
    said = refused(capsys, "check", person_folder, "--out", tmp_path / "file" / below)
    assert f"{tmp_path / 'file'} is a file, expected a folder" in said
    assert (tmp_path / "file").read_text() == "mine"
