"""A filmed person to check, and what was measured of it."""

import shutil

import pytest
from filmed import film

from twofold.body.skeleton import shape_body
from twofold.capture.folder import read_capture
from twofold.check.frame_measures import surface_points
from twofold.check.measure import measure_capture


@pytest.fixture(scope="session")
def flawless_turner(tmp_path_factory):
    """The capture folder; not to be changed."""
    return film(tmp_path_factory.mktemp("turner") / "turner")


@pytest.fixture
def turner(flawless_turner, tmp_path):
    """A copy of it, to break."""
    return shutil.copytree(flawless_turner, tmp_path / "turner")


@pytest.fixture(scope="session")
def turner_read(flawless_turner):
    return read_capture(flawless_turner)


@pytest.fixture(scope="session")
def turner_shaped(turner_read):
    return shape_body(turner_read.body, turner_read.betas)


@pytest.fixture(scope="session")
def turner_points(turner_shaped):
    return surface_points(turner_shaped, 3000)


@pytest.fixture(scope="session")
def measured(flawless_turner):
    """Facts and capture."""
    return measure_capture(flawless_turner)
