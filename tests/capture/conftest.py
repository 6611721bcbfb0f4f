"""A tiny capture folder and ways to change it."""

import json
import shutil

import numpy as np
import pytest
from tiny_capture import write_tiny


@pytest.fixture(scope="session")
def flawless(tmp_path_factory):
    return write_tiny(tmp_path_factory.mktemp("flawless") / "tiny")


@pytest.fixture
def tiny(flawless, tmp_path):
    """The folder of a flawless tiny capture, to break."""
    return shutil.copytree(flawless, tmp_path / "tiny")


@pytest.fixture
def describe(tiny):
    """A function that changes `capture.json` of `tiny` by a function of its contents."""

    def change(edit):
        path = tiny / "capture.json"
        description = json.loads(path.read_text())
        edit(description)
        path.write_text(json.dumps(description))

    return change


@pytest.fixture
def move(tiny):
    """A function that changes `motion.npz` of `tiny`."""

    def change(**arrays):
        with np.load(tiny / "motion.npz") as old:
            np.savez(tiny / "motion.npz", **({name: old[name] for name in old} | arrays))

    return change
