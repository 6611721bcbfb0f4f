"""Commands that make captures: what they refuse, and what they say comes next."""

from pathlib import Path

import pytest

from twofold.cli import main


def test_what_was_imported_is_to_be_checked_first(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("twofold.capture.prepared.import_prepared", lambda *_, **__: None)
    main(["import", str(tmp_path / "given"), str(tmp_path / "capture")])
    assert f"Next: twofold check {tmp_path / 'capture'}" in " ".join(capsys.readouterr().err.split())
