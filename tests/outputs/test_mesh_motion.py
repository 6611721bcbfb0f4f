import numpy as np
import pytest
import torch
from characters import small_character

from twofold.body.builtin_motions import BUILTIN_MOTIONS
from twofold.body.motion import as_single, resampled
from twofold.capture.folder import read_capture
from twofold.outputs.export.bake import BakeConfig
from twofold.outputs.export.character import Animation, pose_character
from twofold.outputs.mesh_motion import clip_renderer, mesh_renderer
from twofold.outputs.mesh_preview import render_mesh
from twofold.outputs.motion_cameras import motion_cameras
from twofold.outputs.motion_video import field_renderer, rest_body
from twofold.training.run import load


def test_a_frame_is_the_posed_and_morphed_character():
    character = small_character(texture=0)
    targets = len(character.targets)
    poses = 0.2 * np.random.default_rng(0).normal(size=(3, 24, 3)).astype(np.float32)
    places = np.zeros((3, 3), np.float32)
    weights = np.random.default_rng(1).normal(size=(3, targets)).astype(np.float32)
    clip = Animation("clip", np.arange(3, dtype=np.float32), poses, places, weights)
    from test_mesh_preview import camera

    view = clip_renderer(character, clip)(2, camera())
    vertices = pose_character(character, poses[2], places[2], weights[2])
    expected = render_mesh(character, vertices, camera(), np.zeros(3, np.float32))
    assert np.array_equal(view.color.numpy(), expected[..., :3])
    assert np.array_equal(view.opacity.numpy(), expected[..., 3])
    white = torch.ones(3)
    assert view.on(white)[0, 0].tolist() == [1, 1, 1]


@pytest.mark.slow
def test_the_mesh_moves_as_the_field_does(trained, person_folder):
    pytest.importorskip("xatlas")
    pytest.importorskip("fast_simplification")
    avatar, _ = load(trained.folder)
    motion = resampled(as_single(BUILTIN_MOTIONS["walk"](rest_body(avatar))), 1.0)
    cameras = motion_cameras(rest_body(avatar), motion, 64, follow=True)
    config = BakeConfig(faces=4000, targets=2, frames=4, color_frames=2, texture=0, lit=True)
    mesh = mesh_renderer(avatar, read_capture(person_folder), motion, config)
    field = field_renderer(avatar, motion)
    for index in (0, 2):
        one, other = mesh(index, cameras[index]).opacity > 0.5, field(index, cameras[index]).opacity > 0.5
        assert (one & other).sum() / (one | other).sum() > 0.8
