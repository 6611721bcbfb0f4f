"""Closed, full and broken standard streams never change what a command does."""

import io
import os
import subprocess
import sys
from pathlib import Path

import pytest

from twofold.cli.console import bar, say
from twofold.cli.main import main
from twofold.cli.streams import streams_that_never_fail

posix_only = pytest.mark.skipif(os.name == "nt", reason="shells and devices of POSIX")

SCRIPT = """
import sys
from pathlib import Path
from twofold.cli.console import bar, say
from twofold.cli.main import main
from twofold.cli.streams import streams_that_never_fail
with streams_that_never_fail():
    file = Path(sys.argv[1]).open("w")
    for line in range(3000):
        print("out", line, "x" * 100)
        print("error", line, "x" * 100, file=sys.stderr)
    file.write("whole")
    file.close()
    sys.exit(3)
"""


@posix_only
@pytest.mark.parametrize("streams", [
    "| head -1", "2>&1 | head -1", ">/dev/full", "2>/dev/full", "<&- >&- 2>&-", ">&-", "2>&-",
    ">/dev/null 2> >(head -1 >/dev/null)",
])  # fmt: skip
def test_a_program_does_all_of_its_work_whatever_its_streams_are(streams: str, tmp_path: Path) -> None:
    command = f'"$0" -c "$1" "$2" {streams}; exit "${{PIPESTATUS[0]}}"'
    words = ["bash", "-c", command, sys.executable, SCRIPT, str(tmp_path / "file")]
    done = subprocess.run(words, capture_output=True, text=True, check=False, timeout=60)
    assert (done.returncode, (tmp_path / "file").read_text()) == (3, "whole")
    assert "Traceback" not in done.stderr
    assert "Exception ignored" not in done.stderr


def test_characters_that_a_stream_has_no_code_for_are_written_as_escapes(monkeypatch: pytest.MonkeyPatch) -> None:
    raw = io.BytesIO()
    monkeypatch.setattr("sys.stderr", io.TextIOWrapper(raw, encoding="ascii"))
    with streams_that_never_fail():
        print("Zo\u00eb \udcff", file=sys.stderr)
    assert raw.getvalue() == b"Zo\\xeb \\udcff\n"


def test_afterwards_the_streams_are_as_before() -> None:
    before = sys.stdout, sys.stderr
    with streams_that_never_fail():
        assert sys.stdout is not before[0]
    assert (sys.stdout, sys.stderr) == before


class Broken(io.StringIO):
    """A stream whose reader has gone."""

    def write(self, text: str) -> int:
        raise BrokenPipeError

    def flush(self) -> None:
        raise BrokenPipeError


def test_progress_and_messages_go_nowhere_when_nobody_reads(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("sys.stdout", "sys.stderr"):
        monkeypatch.setattr(name, Broken())
    main(["--version"])
    main(["train", "--settings"])
    with pytest.raises(SystemExit) as ended:
        main(["train", "nowhere"])
    assert ended.value.code == 2
    with streams_that_never_fail(), bar("Working") as progress:
        for done in (0.0, 0.5, 1.0):
            progress(done, "")
        say("The result is here.", "nothing")
