"""The viewer without a browser: its server runs, its buttons do what they say."""

import json
import math

import numpy as np
import pytest
import torch
from gltf_reader import read_glb
from PIL import Image
from watching import Eye, camera_at

from twofold.body.motion_files import read_motion
from twofold.viewer.browser import first_view
from twofold.viewer.scene_objects import JointGizmo
from twofold.viewer.server import LOOPBACK, stop_server
from twofold.viewer.session import ViewSession
from twofold.viewer.view_images import quaternion, view_camera

pytest.importorskip("viser", reason="the package viser is not installed")


@pytest.fixture
def session(viewed, tmp_path):
    made = ViewSession(viewed, LOOPBACK, 0, tmp_path / "saved")
    yield made
    stop_server(made.server)


def test_it_listens_on_this_machine_alone_and_never_opens_a_tunnel(session):
    assert session.address.startswith("http://127.0.0.1:")
    assert session.server.request_share_url() is None
    assert session.server._share_tunnel is None


def test_widgets_follow_the_state_and_do_not_change_it(session):
    panel, state = session.panel, session.state
    state.scrub(3)
    state.set_joint(panel.chosen_joint, torch.tensor([0.0, 0.2, -0.7]))
    version = state.version
    panel.follow()
    assert state.version == version
    assert panel.frame.value == 3
    assert [slider.value for slider in panel.angles] == pytest.approx([0.0, 11.5, -40.1])
    assert "edited" in panel.status.content
    assert not panel.part.visible, "a capture has no branches"


def test_a_motion_file_from_the_browser_is_played_where_the_person_stands(session, tmp_path):
    path = session.save(lambda: save_bent(session))
    session.panel.opened("mine.npz", path.read_bytes())
    assert session.state.timeline.name == "mine"
    assert session.state.pose.pose[18, 1] == pytest.approx(-1.0, abs=1e-5)
    assert torch.allclose(session.state.pose.translation + session.viewed.body.joints[0], session.viewed.start)
    session.panel.opened("evil.pkl", b"cos\nsystem\n")
    assert "evil.pkl is a pickle" in session.panel._noted
    assert session.state.timeline.name == "mine"


def save_bent(session):
    from twofold.viewer.saving import save_pose

    session.state.set_joint(18, torch.tensor([0.0, -1.0, 0.0]))
    return save_pose(session.out, session.viewed, session.state)


def test_what_is_saved_never_lies_over_what_is_there(session):
    paths = [session.save(lambda: save_bent(session)) for _ in range(2)]
    assert [path.name for path in paths] == ["pose-000.npz", "pose-001.npz"]
    read = read_motion(paths[0], session.viewed.body)
    assert read.motion.poses[0, 18, 1] == pytest.approx(-1.0, abs=1e-5)
    assert session.saved == paths


def test_image_path_video_and_character_are_saved(session):
    key = 7
    session.browsers[key] = Watching(camera_at(session.viewed), session.viewed)
    image = session.save(lambda: session._image(key))
    with Image.open(image) as stored:
        assert stored.size == (64, 48)
        assert len(np.unique(np.asarray(stored).reshape(-1, 3), axis=0)) > 10
    session.path_button("save", key)
    assert "two key views or more" in session.panel._noted
    session.path_button("add", key)
    session.path_button("add", key)
    assert session.path_note.content == "Camera path: 2 key views"
    session.path_button("save", key)
    assert len(json.loads(session.saved[-1].read_text())["frames"]) == 61
    session.path_button("video", key)
    assert session.saved[-1].stat().st_size > 500
    session.path_button("clear", key)
    assert session.keys == []
    session.state.set_joint(18, torch.tensor([0.0, -1.0, 0.0]))
    from twofold.viewer.saving import save_glb

    glb = session.save(lambda: save_glb(session.out, session.viewed, session.state, session.meshes))
    document = read_glb(glb).json
    assert [clip["name"] for clip in document["animations"]] == ["capture: train", "edited pose"]
    assert len(document["skins"][0]["joints"]) == 24


class Watching(Eye):
    def __init__(self, camera, viewed):
        super().__init__(camera)
        self.viewed = viewed

    def key_view(self):
        return first_view(self.viewed)


def test_the_gizmo_turns_its_joint_and_at_the_pelvis_moves_the_person(session):
    changes = []
    gizmo = JointGizmo(session.server, session.state, lambda: changes.append(1))
    gizmo.show(18)
    wanted = np.array([math.cos(0.3), 0.0, math.sin(0.3), 0.0])
    gizmo.apply(wanted, np.zeros(3))
    gizmo.follow()
    assert np.allclose(np.abs(gizmo._handle.wxyz @ wanted), 1, atol=1e-5)
    gizmo.show(0)
    gizmo.apply(gizmo._handle.wxyz, np.array([0.5, 0.25, -1.0]))
    assert torch.allclose(
        session.state.pose.translation + session.viewed.body.joints[0], torch.tensor([0.5, 0.25, -1.0]), atol=1e-5
    )
    assert len(changes) == 2
    gizmo.show(None)
    gizmo.apply(wanted, np.zeros(3))
    assert len(changes) == 2


def test_cameras_stand_where_the_capture_has_them_and_show_its_images(session, person):
    session.panel.cameras.show(True, True, person.train[0].frame_index)
    for frame in person.train:
        handle = session.server.scene.get_handle_by_name(f"/cameras/{frame.camera_name}")
        own = view_camera(handle.wxyz, handle.position, handle.fov, frame.camera.height, frame.camera.width)
        assert torch.allclose(own.world_to_camera, frame.camera.world_to_camera, atol=1e-4)
        assert torch.allclose(own.intrinsics[1, 1], frame.camera.intrinsics[1, 1], atol=1e-2)
    shown = session.server.scene.get_handle_by_name(f"/cameras/{person.train[0].camera_name}").image
    assert np.abs(shown.astype(int).mean() / 255 - float(person.train[0].image().mean())) < 0.02
    session.panel.cameras.show(False, True, None)
    assert not session.server.scene.get_handle_by_name(f"/cameras/{person.train[0].camera_name}").visible


def test_first_view_has_the_whole_person_in_front(viewed):
    key = first_view(viewed)
    from twofold.viewer.camera_path import path_cameras

    camera = path_cameras([key, key], 1, 60, 60)[0]
    from twofold.geometry.cameras import project

    pixels, depth = project(camera, viewed.body.vertices + viewed.timelines[0].poses[0].translation)
    assert (depth > 0.5).all()
    assert ((pixels > 0) & (pixels < 60)).float().mean() > 0.99
    assert len(quaternion(camera.world_to_camera[:3, :3])) == 4
