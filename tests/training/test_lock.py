"""Two trainings never share a folder."""

import os
import signal
import subprocess
import sys

import pytest

from twofold.errors import TwofoldError
from twofold.training.lock import LOCK, locked, require_unlocked

HOLD = (
    "import sys, time; from pathlib import Path; from twofold.training.lock import locked\n"
    "with locked(Path(sys.argv[1])): print('held', flush=True); time.sleep(60)"
)


@pytest.fixture
def holder(tmp_path):
    """Another process that has locked the folder."""
    with subprocess.Popen([sys.executable, "-c", HOLD, str(tmp_path)], stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == "held\n"
        yield process
        process.kill()


def test_a_locked_folder_is_refused_in_one_sentence(holder, tmp_path):
    for take in (lambda: locked(tmp_path).__enter__(), lambda: require_unlocked(tmp_path)):
        with pytest.raises(TwofoldError, match="is being trained by another process") as refused:
            take()
        assert str(tmp_path) in str(refused.value)
    assert (tmp_path / LOCK).exists()


def test_the_lock_of_a_killed_process_is_free(holder, tmp_path):
    holder.send_signal(signal.SIGKILL if os.name != "nt" else signal.SIGTERM)
    holder.wait()
    assert (tmp_path / LOCK).exists()
    require_unlocked(tmp_path)
    with locked(tmp_path):
        pass


def test_nothing_is_left_of_a_lock_and_one_process_locks_once(tmp_path):
    with locked(tmp_path):
        with pytest.raises(TwofoldError, match="being filled by another process"), locked(tmp_path, "filled"):
            pass
        assert (tmp_path / LOCK).exists()
    assert list(tmp_path.iterdir()) == []
    require_unlocked(tmp_path)
    assert list(tmp_path.iterdir()) == []
