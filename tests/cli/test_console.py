"""Progress is told honestly where nobody watches a terminal."""

import pytest

from twofold.cli import console


def test_a_line_tells_of_progress_every_tenth_where_there_is_no_terminal(capsys: pytest.CaptureFixture[str]) -> None:
    with console.bar("Working") as show:
        for step in range(41):
            show(step / 40, f"step {step}")
    lines = capsys.readouterr().err.splitlines()
    assert [line.split(",")[0] for line in lines] == [f"Working: {10 * tenth} %" for tenth in range(1, 11)]
    assert [line.split(", ")[-1] for line in lines] == [f"step {4 * tenth}" for tenth in range(1, 11)]


def test_a_line_tells_of_slow_progress_now_and_then_and_how_long_it_will_take(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    now = 1000.0
    for clock in ("time.monotonic", "rich.console.monotonic"):
        monkeypatch.setattr(clock, lambda: now)
    with console.bar("Working") as show:
        for step in range(100):
            show(step / 1000, "")
            now += 10
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 33
    assert lines[-1].startswith("Working: 10 %, 2:30:")
