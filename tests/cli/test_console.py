"""Progress is told honestly where nobody watches a terminal."""

import os
import signal

import pytest

from twofold.cli import console


def test_a_line_tells_of_progress_every_tenth_where_there_is_no_terminal(capsys: pytest.CaptureFixture[str]) -> None:
    with console.bar("Working") as progress:
        for step in range(41):
            progress(step / 40, f"step {step}")
    lines = capsys.readouterr().err.splitlines()
    assert [line.split(",")[0] for line in lines] == [f"Working: {10 * tenth} %" for tenth in range(1, 11)]
    assert [line.split(", ")[-1] for line in lines] == [f"step {4 * tenth}" for tenth in range(1, 11)]


def test_a_line_tells_of_slow_progress_now_and_then_and_how_long_it_will_take(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    now = 1000.0
    for clock in ("time.monotonic", "rich.console.monotonic"):
        monkeypatch.setattr(clock, lambda: now)
    with console.bar("Working") as progress:
        for step in range(100):
            progress(step / 1000, "")
            now += 10
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 33
    assert lines[-1].startswith("Working: 10 %, 2:30:")


def test_what_stands_still_takes_ever_longer(monkeypatch: pytest.MonkeyPatch) -> None:
    now = 0.0
    monkeypatch.setattr("time.monotonic", lambda: now)
    left = console.TimeLeft()
    assert left.seconds() is None
    for step in range(100):
        left.note(step / 100)
        now += 1
    assert left.seconds() == pytest.approx(1, abs=0.5)
    now += 200
    seconds = left.seconds()
    assert seconds is not None
    assert seconds > 2
    left.note(1.0)
    assert left.seconds() is None


def test_the_time_left_follows_the_speed_of_late_and_starts_where_a_resumed_run_does(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    now = 0.0
    monkeypatch.setattr("time.monotonic", lambda: now)
    left = console.TimeLeft()
    for step in range(5000, 6000):  # of 10,000: one a second, then ten times as slow
        left.note(step / 10_000)
        now += 1
    assert left.seconds() == pytest.approx(4000, rel=0.05)
    for step in range(6000, 6200):
        left.note(step / 10_000)
        now += 10
    assert left.seconds() == pytest.approx(38_000, rel=0.25)
    assert len(left._past) < 1200


@pytest.mark.skipif(not hasattr(signal, "SIGCONT"), reason="no such signal here")
def test_the_time_that_a_process_was_stopped_does_not_count(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    now, before = 0.0, signal.getsignal(signal.SIGCONT)
    for clock in ("time.monotonic", "rich.console.monotonic"):
        monkeypatch.setattr(clock, lambda: now)
    with console.bar("Working") as progress:
        for step in range(400):
            if step == 300:
                now += 7200
                os.kill(os.getpid(), signal.SIGCONT)
            progress(step / 1000, "")
            now += 1
    assert capsys.readouterr().err.splitlines()[-1].startswith("Working: 39 %, 0:10:")
    assert signal.getsignal(signal.SIGCONT) == before
