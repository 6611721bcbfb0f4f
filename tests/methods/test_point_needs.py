"""What NPC needs is found out before anything is trained."""

from dataclasses import replace
from pathlib import Path

import pytest
import torch
import trimesh
from small_recipes import CASES

from twofold.body.skeleton import pose_body, shape_body
from twofold.capture.coverage import coverage_of
from twofold.capture.types import Capture
from twofold.errors import TwofoldError
from twofold.field.bone_boxes import RIGID_PARTS, assign_to_boxes
from twofold.methods.point_needs import MOST_UNSEEN, _coordinates, body_surface, require_points, unseen_parts
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
    assert require_points(person, sizes, 300, 0.005) is None


def test_few_unseen_parts_are_named_in_a_note_and_one_more_is_refused(
    person: Capture, sizes: torch.Tensor, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Coverage of the parts is given here; `coverage_of` has tests of its own."""
    parts = [RIGID_PARTS.index(9), RIGID_PARTS.index(1), RIGID_PARTS.index(2)]
    coverage = coverage_of(person)
    whole = replace(coverage, weight=torch.ones_like(coverage.weight))
    vertices = pose_body(shape_body(person.body, person.betas), torch.zeros(24, 3), torch.zeros(3)).vertices
    part_of = assign_to_boxes(_coordinates(vertices, shape_body(person.body, person.betas).joints, sizes), sizes)

    def see_all_but(hidden: list[int]) -> None:
        seen = ~torch.isin(part_of, torch.tensor(hidden))
        monkeypatch.setattr(
            "twofold.methods.point_needs.coverage_of", lambda _: replace(whole, weight=whole.weight * seen)
        )

    see_all_but(parts[:1])
    assert unseen_parts(person, sizes) == {parts[0]: 0.0}
    note = require_points(person, sizes, 8, 0.03)
    assert note == "No training image shows the spine3 well: NPC takes its points there from the body model's surface."
    assert len(parts) == MOST_UNSEEN + 1
    see_all_but(parts)
    with pytest.raises(TwofoldError, match=r"show 0 % of the left hip and too little of 2 other parts"):
        require_points(person, sizes, 8, 0.03)


def test_points_of_the_body_lie_on_its_faces(person: Capture) -> None:
    points, area = body_surface(person.body, person.betas)
    body = pose_body(shape_body(person.body, person.betas), torch.zeros(24, 3), torch.zeros(3))
    mesh = trimesh.Trimesh(body.vertices.numpy(), body.faces.numpy(), process=False)
    assert area == pytest.approx(mesh.area, rel=1e-4)
    away = trimesh.proximity.closest_point_naive(mesh, points[::400].numpy())[1]
    assert away.max() < 1e-5


def test_a_part_that_no_image_shows_is_named_before_anything_is_written(
    person: Capture, sizes: torch.Tensor, tmp_path: Path
) -> None:
    cut = tuple(replace(f, camera=replace(f.camera, height=f.camera.height * 2 // 3)) for f in person.train)
    hidden = replace(person, splits={**person.splits, "train": cut})
    with pytest.raises(
        TwofoldError, match=r"5 training images of .* show 0 % of the left knee and .*; add training frames"
    ):
        train(hidden, CASES["npc_fast"], tmp_path / "run", torch.device("cpu"))
    assert not (tmp_path / "run").exists()
