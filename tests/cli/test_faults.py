"""What nobody foresaw is one sentence too, and its traceback lies in a file."""

import errno
import os
import re
from pathlib import Path

import numpy as np
import pytest
import torch
from command_line import refused

from twofold.cli.faults import LOWER, explain, is_out_of_memory, write_log
from twofold.cli.main import COMMANDS, main


def raised(error: Exception) -> Exception:
    """The error as it is after it was raised."""
    try:
        raise error
    except Exception as caught:
        return caught


@pytest.fixture(autouse=True)
def _logs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Logs go to the test's own folder."""
    (tmp_path / "logs").mkdir()
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path / "logs"))


def test_an_unforeseen_error_of_a_command_is_one_sentence_with_a_log(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def fails(*_: object, **__: object) -> None:
        raise KeyError("odd\nthing")

    monkeypatch.setattr("twofold.studio.generate.make_studio", fails)
    said = refused(capsys, "studio", tmp_path / "out")
    found = re.fullmatch(
        r"twofold: An unexpected fault ended the command \(KeyError: 'odd\\nthing'\); please report it with (\S+), "
        r"which holds the details\.", said,
    )  # fmt: skip
    assert found, said
    log = Path(found[1]).read_text()
    assert "Traceback (most recent call last)" in log
    assert f"twofold studio {tmp_path / 'out'}" in log
    assert f"torch {torch.__version__.partition('+')[0]}" in log
    assert "numpy" in log


def test_ctrl_c_is_still_no_fault(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def stopped(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("twofold.studio.generate.make_studio", stopped)
    with pytest.raises(SystemExit) as ended:
        main(["studio", str(tmp_path / "out")])
    assert ended.value.code == 130
    assert list((tmp_path / "logs").iterdir()) == []


def numpy_full() -> MemoryError:
    with pytest.raises(MemoryError) as error:
        np.empty(2**60, np.uint8)
    return error.value


def torch_full() -> RuntimeError:
    with pytest.raises(RuntimeError) as error:
        torch.empty(2**60, dtype=torch.uint8)
    return error.value


FULL = [
    MemoryError(), torch.OutOfMemoryError("CUDA out of memory. Tried to allocate 20.00 GiB"), RuntimeError("bad_alloc"),
    OSError(errno.ENOMEM, "Cannot allocate memory"),
]  # fmt: skip


@pytest.mark.parametrize("error", FULL, ids=repr)
def test_each_way_to_run_out_of_memory_is_known(error: Exception) -> None:
    assert is_out_of_memory(error)


def test_each_command_says_what_to_lower_where_the_memory_does_not_suffice() -> None:
    assert set(COMMANDS) <= set(LOWER)
    assert explain(MemoryError(), ["export", "train"]).startswith("The memory does not suffice; lower --texture")


def test_what_numpy_and_torch_say_without_memory_is_known() -> None:
    assert is_out_of_memory(numpy_full())
    assert is_out_of_memory(torch_full())
    assert not is_out_of_memory(RuntimeError("shapes do not match"))
    assert not is_out_of_memory(ValueError("out of memory"))


@pytest.mark.parametrize(
    ("command", "setting"),
    [
        ("train", "training.pixels.rays"), ("render", "--chunk"), ("evaluate", "--max-meshes"), ("studio", "--size"),
        ("prepare", "--max-size"), ("check", "--max-images"),
    ],
)  # fmt: skip
def test_without_memory_the_setting_to_lower_is_named(command: str, setting: str, tmp_path: Path) -> None:
    said = explain(MemoryError(), [command, "x"])
    assert said.startswith("The memory does not suffice; ")
    assert setting in said
    assert list((tmp_path / "logs").iterdir()) == []


def test_what_the_system_refuses_is_named_with_advice(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    full = OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), "some.png")
    assert explain(full, ["check"]) == "Cannot use some.png: the disk is full; free some space or choose another disk."
    for command in ("train", "check", "evaluate", "render"):
        said = refused(capsys, command, tmp_path / ("x" * 5000))
        assert len(said) < 700
        assert "report" not in said
    assert list((tmp_path / "logs").iterdir()) == []


def test_without_a_place_for_the_log_the_sentence_says_so(tmp_path: Path) -> None:
    (tmp_path / "logs").rmdir()
    said = explain(raised(ValueError("x" * 10_000)), ["train"])
    assert "no log could be written" in said
    assert len(said) < 400


def test_the_log_takes_text_of_any_kind(tmp_path: Path) -> None:
    log = write_log(raised(ValueError("\ud800 \N{GRINNING FACE}")), ["train", os.fsdecode(b"caf\xe9")])
    assert "\\ud800" in Path(log).read_text()
