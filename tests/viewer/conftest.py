"""A viewed capture."""

import pytest

from twofold.viewer.scene_state import SceneState
from twofold.viewer.viewed import view_capture


@pytest.fixture
def viewed(person):
    return view_capture(person)


@pytest.fixture
def state(viewed):
    return SceneState(viewed.body, viewed.turn, viewed.timelines)
