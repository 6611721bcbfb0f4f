"""Scenes, and a data set of each format written of them."""

import pytest
from smpl_subject import make_scene


@pytest.fixture(scope="session")
def scene(tmp_path_factory):
    """Ten frames by three cameras."""
    return make_scene(tmp_path_factory.mktemp("scene"), frames=10, cameras=3, size=48)


@pytest.fixture(scope="session")
def small(tmp_path_factory):
    """Four frames by two cameras, to break."""
    return make_scene(tmp_path_factory.mktemp("small"), frames=4, cameras=2, size=32)
