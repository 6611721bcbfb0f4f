"""What NPC needs is found out before anything is trained."""

from dataclasses import replace
from pathlib import Path

import pytest
import torch
from small_recipes import CASES

from twofold.capture.types import Capture
from twofold.errors import TwofoldError
from twofold.field.bone_boxes import RIGID_PARTS
from twofold.methods.point_needs import require_points
from twofold.methods.subject import Subject
from twofold.training.loop import train


@pytest.fixture(scope="module")
def sizes(person: Capture) -> torch.Tensor:
    return CASES["npc_fast"].method.build(Subject.of(person)).boxes().detach()[list(RIGID_PARTS)]


def test_enough_room_for_as_many_points_as_a_first_stage_finds(person: Capture, sizes: torch.Tensor) -> None:
    """The estimate comes near the count on a surface like the body's: what it refuses, extraction would."""
    require_points(person, sizes, 8, 0.03)
    with pytest.raises(TwofoldError, match="needs 300 points on each body part") as few:
        require_points(person, sizes, 300, 0.03)
    assert "lower method.points" in str(few.value)
    require_points(person, sizes, 300, 0.005)


def test_a_part_that_no_image_shows_is_named_before_anything_is_written(
    person: Capture, sizes: torch.Tensor, tmp_path: Path
) -> None:
    cut = tuple(replace(f, camera=replace(f.camera, height=f.camera.height * 2 // 3)) for f in person.train)
    hidden = replace(person, splits={**person.splits, "train": cut})
    with pytest.raises(TwofoldError, match=r"5 training images of .* show 0 % of the left knee; add training frames"):
        train(hidden, CASES["npc_fast"], tmp_path / "run", torch.device("cpu"))
    assert not (tmp_path / "run").exists()
