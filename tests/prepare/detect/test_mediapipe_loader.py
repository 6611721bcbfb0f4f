import importlib
import os
import sys
from types import ModuleType

import pytest

from twofold.errors import TwofoldError
from twofold.prepare.detect.mediapipe_loader import load_mediapipe, silenced


def test_what_compiled_code_prints_is_swallowed(capfd):
    with silenced():
        os.write(2, b"noise")
    os.write(2, b"news")
    assert capfd.readouterr().err == "news"


def test_an_error_is_passed_on_and_standard_error_comes_back(capfd):
    with pytest.raises(ValueError, match="mine"), silenced():
        raise ValueError("mine")
    os.write(2, b"news")
    assert capfd.readouterr().err == "news"


def test_a_program_without_standard_error_goes_on(monkeypatch):
    monkeypatch.setattr(sys, "stderr", None)
    with silenced():
        pass


def test_no_file_stays_open():
    before = len(os.listdir("/proc/self/fd")) if os.path.isdir("/proc/self/fd") else 0
    for _ in range(20):
        with silenced():
            pass
    assert (len(os.listdir("/proc/self/fd")) if before else 0) <= before


def test_a_missing_package_is_one_sentence(monkeypatch):
    def absent(name, *rest):
        raise ModuleNotFoundError(f"No module named {name!r}")

    monkeypatch.setattr(importlib, "import_module", absent)
    with pytest.raises(TwofoldError, match=r"needs MediaPipe 0\.10\.21; install it with `pip install .*\[prepare\]'`"):
        load_mediapipe()


def test_a_later_version_is_refused(monkeypatch):
    later = ModuleType("mediapipe")
    later.__version__ = "0.10.32"
    monkeypatch.setitem(sys.modules, "mediapipe", later)
    with pytest.raises(TwofoldError, match=r"MediaPipe 0\.10\.32 comes without models"):
        load_mediapipe()
