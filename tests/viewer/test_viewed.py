"""Any method can be viewed: with a base branch or without, with a canonical surface or without."""

from pathlib import Path

import pytest
import torch
from density_method import cloud
from watching import Eye, camera_at

from twofold.errors import TwofoldError
from twofold.methods.subject import Subject
from twofold.training.run import start_folder
from twofold.viewer.field_source import TrainedField
from twofold.viewer.live import ViewLoop
from twofold.viewer.meshes import Meshes
from twofold.viewer.scene_state import SceneState
from twofold.viewer.viewed import named_motion, open_run, view_run


@pytest.fixture
def cloud_run(person, tmp_path, monkeypatch):
    from density_method import add_to_table

    add_to_table(monkeypatch)
    subject = Subject.of(person)
    start_folder(tmp_path / "run", cloud(), subject, person.folder)
    return tmp_path / "run", cloud().method.build(subject).eval()


def test_a_density_without_base_branch_is_viewed_with_the_bare_body_moving(cloud_run, person):
    run, avatar = cloud_run
    viewed = view_run(run, avatar, person, "cloud")
    assert not viewed.has_base
    meshes = Meshes(viewed)
    meshes.bake()
    assert "train first" in meshes.note
    assert meshes.of("full")[1]
    now = iter(range(1000))
    eye = Eye(camera_at(viewed, 24, 32))
    state = SceneState(viewed.body, viewed.turn, viewed.timelines)
    loop = ViewLoop(state, meshes, TrainedField(avatar, False), clock=lambda: float(next(now)))
    loop.seat(1, eye)
    while loop.step():
        pass
    assert eye.notes == ["Bare body", "Field"]


def test_a_run_whose_capture_is_gone_can_be_viewed(trained):
    viewed = open_run(trained.folder, None, torch.device("cpu"))
    assert viewed.has_base
    assert viewed.timelines[0].name == "rest pose"
    assert "The capture of this run is gone" in viewed.notes[0]
    meshes = Meshes(viewed)
    meshes.bake()
    assert "name it with --capture" in meshes.note


def test_a_run_is_shown_with_its_corrected_poses(trained, person):
    viewed = open_run(trained.folder, person.folder, torch.device("cpu"))
    frame, posed = person.train[0], viewed.timelines[0].poses[0]
    assert posed.trained
    assert posed.frame.frame_index == frame.frame_index
    off = (posed.pose - frame.pose).abs().max()
    assert 0 < off < 0.3
    assert viewed.title.endswith("100 steps")


def test_motions_begin_where_the_person_stands(viewed):
    line = named_motion(viewed, "walk")
    assert torch.allclose(line.poses[0].translation + viewed.body.joints[0], viewed.start, atol=1e-5)
    assert len(line) > 20
    with pytest.raises(TwofoldError, match="neither a file nor a built-in motion"):
        named_motion(viewed, Path("nothing.bvh"))
