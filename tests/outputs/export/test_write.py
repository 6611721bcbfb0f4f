"""From a trained run to files: the whole way, on the tiny person."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from gltf_reader import read_glb, shown_at

from twofold.body.skeleton import joint_transforms, skin
from twofold.capture.types import Capture
from twofold.errors import TwofoldError
from twofold.geometry.surfaces import point_to_mesh
from twofold.methods.base import Avatar
from twofold.outputs.export import write
from twofold.outputs.export.animations import capture_clip, grounded, turned, upright
from twofold.outputs.export.bake import BakeConfig, shown_surfaces
from twofold.outputs.export.make import Baked, bake, still
from twofold.outputs.export.morphs import pull_back
from twofold.outputs.export.repair import is_watertight
from twofold.outputs.export.write import ExportRequest, export
from twofold.outputs.mesh import pose_surface
from twofold.training.run import load

SMALL = BakeConfig(faces=1500, texture=256, frames=5, color_frames=2)


@pytest.fixture(scope="module")
def avatar(trained) -> Avatar:
    return load(trained.folder)[0]


@pytest.fixture(scope="module")
def baked(avatar: Avatar, person: Capture) -> Baked:
    return bake(avatar, person, SMALL)


def test_character_is_closed_and_has_about_the_triangles_asked_for(baked: Baked) -> None:
    assert is_watertight(baked.character.vertices, baked.character.faces)
    assert baked.shape.watertight
    assert 1000 < len(baked.character.faces) <= 1600


def test_surface_lies_on_the_avatars_own_in_every_training_pose(baked: Baked, avatar: Avatar, person: Capture) -> None:
    for frame in person.train[1::2]:
        posed = avatar.pose(frame.pose, frame.translation, frame.frame_index)
        there = still(baked, frame.frame_index)
        with torch.no_grad():
            x, _ = avatar.to_canonical(torch.from_numpy(there.vertices), posed)
            assert avatar.level(x, posed).abs().median() < 1e-3
        surface = pose_surface(baked.shape.skin.canonical, posed.body)
        away, _, _ = point_to_mesh(torch.from_numpy(there.vertices), surface, baked.shape.skin.faces)
        assert away.median() < 0.01


def test_morph_targets_bring_the_character_nearer_to_each_frame(baked: Baked, avatar: Avatar, person: Capture) -> None:
    shape = baked.shape
    assert shape.weights.min() >= 0
    for row, frame in enumerate(shape.frames):
        back = pull_back(avatar, frame.of(avatar), shape.skin)
        shown = torch.einsum("m,mvc->vc", shape.weights[row], shape.targets)
        without, left = back.displacement[back.found].norm(), (back.displacement - shown)[back.found].norm()
        assert left < without
    assert shape.errors["fitted_with_mm"] < shape.errors["fitted_without_mm"]


def test_unlit_colours_are_the_mean_of_the_field_without_its_light(baked: Baked, avatar: Avatar) -> None:
    assert not baked.character.lit
    colors = []
    with torch.no_grad():
        for posed, back in shown_surfaces(avatar, baked.shape, SMALL):
            colors.append(avatar.query(back.canonical, posed, lit=False).color.clamp(0, 1))
    assert np.abs(torch.stack(colors).mean(0).numpy() - baked.character.colors).max() < 1e-5


def test_texture_agrees_with_the_colours_of_the_vertices(baked: Baked) -> None:
    atlas, texture = baked.character.atlas, baked.character.texture
    place = (atlas.uv * len(texture)).astype(int).clip(0, len(texture) - 1)
    shown = texture[place[:, 1], place[:, 0]] / 255
    assert np.abs(shown - baked.character.colors[atlas.vertex]).mean() < 0.02


def test_colours_of_one_pose_and_of_the_base_branch_differ(baked: Baked, avatar: Avatar, person: Capture) -> None:
    plain = replace(SMALL, texture=0)
    of = {color: bake(avatar, person, plain, color).character.colors for color in ("base", 2)}
    assert np.abs(of["base"] - of[2]).max() > 1e-3
    assert np.abs(of["base"] - baked.character.colors).max() > 1e-3


def test_base_branch_has_no_morph_targets(avatar: Avatar, person: Capture) -> None:
    character = bake(avatar, person, replace(SMALL, texture=0, branch="base")).character
    assert len(character.targets) == 0


def test_files_agree_with_twofolds_skinning_and_say_what_is_in_them(
    avatar: Avatar, person: Capture, baked: Baked, tmp_path: Path
) -> None:
    request = ExportRequest(("glb", "vrm", "ply", "obj", "bvh"), SMALL)
    written = export(avatar, person, tmp_path / "exports", request)
    assert [path.name for path in written] == [f"avatar.{kind}" for kind in request.formats]
    glb, character = read_glb(written[0]), baked.character
    clip = grounded(turned(capture_clip(baked), upright(person), character.joints[0]), character)
    for frame in range(len(clip.times)):
        joints, vertices = shown_at(glb, 0, frame)
        pose, place = torch.from_numpy(clip.poses[frame]), torch.from_numpy(clip.translations[frame])
        transforms = joint_transforms(torch.from_numpy(character.joints), pose, place)
        moved = character.vertices + np.tensordot(clip.weights[frame], character.targets, 1)
        expected = skin(torch.from_numpy(moved), torch.from_numpy(character.weights), transforms).numpy()
        assert np.abs(vertices - expected[character.atlas.vertex]).max() < 1e-4
        own = (transforms[:, :3, :3] @ torch.from_numpy(character.joints)[:, :, None])[..., 0] + transforms[:, :3, 3]
        assert np.abs(joints - own.numpy()).max() < 1e-4
    record = json.loads((tmp_path / "exports" / write.RECORD).read_text())
    assert record["watertight"] is True
    assert record["files"]["avatar.glb"] == written[0].stat().st_size
    assert 0.2 < record["coverage"] <= 1


def test_clip_starts_over_the_origin_with_its_lowest_point_on_the_ground(baked: Baked, person: Capture) -> None:
    from twofold.outputs.export.character import pose_character

    clip = grounded(capture_clip(baked), baked.character)
    start = clip.translations[0] + baked.character.joints[0]
    assert np.abs(start[[0, 2]]).max() < 1e-6
    lowest = [
        pose_character(baked.character, *row)[:, 1].min() for row in zip(clip.poses, clip.translations, strict=True)
    ]
    assert abs(min(lowest)) < 1e-4


def test_clip_of_a_capture_whose_rate_varies_has_the_times_of_its_frames(baked: Baked) -> None:
    trained = sorted({frame.frame_index for frame in baked.capture.train})
    index = np.array(trained)
    np.testing.assert_allclose(capture_clip(baked).times, (index - index[0]) / baked.capture.fps, rtol=1e-6)
    seconds = 1e7 + torch.arange(trained[-1] + 1, dtype=torch.float64) ** 1.5
    uneven = replace(baked, capture=replace(baked.capture, seconds=seconds))
    np.testing.assert_allclose(capture_clip(uneven).times, index**1.5 - index[0] ** 1.5, rtol=1e-6)


@pytest.mark.parametrize("axis", ["y", "-y", "z", "-x"])
def test_turned_clip_is_the_turned_motion(baked: Baked, person: Capture, axis: str) -> None:
    from twofold.outputs.export.character import pose_character

    sign, index = (-1.0 if axis[0] == "-" else 1.0), "xyz".index(axis[-1])
    down = torch.zeros(3)
    down[index] = -sign
    frames = []
    for frame in person.train:
        transform = frame.camera.world_to_camera.clone()
        transform[1, :3] = down
        frames.append(replace(frame, camera=replace(frame.camera, world_to_camera=transform)))
    rotation = upright(replace(person, splits=person.splits | {"train": tuple(frames)}))
    assert torch.allclose(rotation @ -down, torch.tensor([0.0, 1.0, 0.0]), atol=1e-6)
    assert torch.linalg.det(rotation) == pytest.approx(1)
    clip, character = capture_clip(baked), baked.character
    other = turned(clip, rotation, character.joints[0])
    plain = pose_character(character, clip.poses[2], clip.translations[2])
    assert (
        np.abs(pose_character(character, other.poses[2], other.translations[2]) - plain @ rotation.numpy().T).max()
        < 1e-4
    )


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"frame": 99}, "no frame 99"),
        ({"color": 99}, "no frame 99"),
        ({"frame": 1, "formats": ("vrm",)}, "without a rig"),
        ({"formats": ("bvh",), "capture_motion": False}, "holds a motion"),
    ],
)
def test_what_cannot_be_written_is_refused_before_baking(avatar, person, tmp_path, monkeypatch, change, words) -> None:
    monkeypatch.setattr(write, "bake", lambda *_: pytest.fail("it was baked"))
    with pytest.raises(TwofoldError, match=words):
        export(avatar, person, tmp_path / "exports", replace(ExportRequest(config=SMALL), **change))
    assert not (tmp_path / "exports").exists()


def test_missing_package_is_named_before_baking(avatar, person, tmp_path, monkeypatch) -> None:
    found = write.importlib.util.find_spec
    monkeypatch.setattr(write.importlib.util, "find_spec", lambda name: None if name == "xatlas" else found(name))
    with pytest.raises(TwofoldError, match=r"needs xatlas; run pip install .*\[export\]"):
        export(avatar, person, tmp_path / "exports", ExportRequest(config=SMALL))


@pytest.mark.parametrize(("lacking", "words"), [("query", "has no field"), ("to_canonical", "does not map")])
def test_method_that_cannot_answer_for_its_surface_is_refused(
    avatar, person, tmp_path, monkeypatch, lacking, words
) -> None:
    monkeypatch.setattr(type(avatar), lacking, getattr(Avatar, lacking))
    with pytest.raises(TwofoldError, match=words):
        export(avatar, person, tmp_path / "exports", ExportRequest(config=SMALL))
    assert not (tmp_path / "exports").exists()
