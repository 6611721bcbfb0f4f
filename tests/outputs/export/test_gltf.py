"""Binary glTF: what an independent reader shows is what twofold's own skinning gives."""

import io
from dataclasses import replace

import numpy as np
import pytest
import torch
from characters import TARGETS, as_still, pose_tensors, small_character
from gltf_reader import Glb, read_glb, shown_at
from PIL import Image

from twofold.body.skeleton import joint_transforms, skin
from twofold.outputs.export.character import Character, pose_character
from twofold.outputs.export.gltf import four_influences, quaternions, write_glb
from twofold.outputs.export.options import ExportOptions
from twofold.outputs.export.rig import joint_names


@pytest.fixture(scope="module")
def character() -> Character:
    return small_character()


def written(character: Character, folder, **options) -> Glb:
    write_glb(character, folder / "a.glb", ExportOptions(**options))
    return read_glb(folder / "a.glb")


def test_joints_and_skinned_vertices_are_twofolds_own(character: Character, tmp_path) -> None:
    glb, clip = written(character, tmp_path), character.clips[0]
    corners = character.atlas.vertex
    for frame in range(len(clip.times)):
        joints, vertices = shown_at(glb, 0, frame)
        pose, translation = pose_tensors(clip, frame)
        transforms = joint_transforms(torch.from_numpy(character.joints), pose, translation)
        expected = (transforms[:, :3, :3] @ torch.from_numpy(character.joints)[:, :, None])[..., 0]
        assert np.abs(joints - (expected + transforms[:, :3, 3]).numpy()).max() < 1e-4
        own = pose_character(character, clip.poses[frame], clip.translations[frame], clip.weights[frame])
        assert np.abs(vertices - own[corners]).max() < 1e-4


def test_own_skinning_is_linear_blend_skinning_after_morphs(character: Character) -> None:
    clip = character.clips[0]
    pose, translation = pose_tensors(clip, 2)
    moved = character.vertices + sum(w * t for w, t in zip(clip.weights[2], character.targets, strict=True))
    transforms = joint_transforms(torch.from_numpy(character.joints), pose, translation)
    expected = skin(torch.from_numpy(moved), torch.from_numpy(character.weights), transforms).numpy()
    own = pose_character(character, clip.poses[2], clip.translations[2], clip.weights[2])
    assert np.abs(own - expected).max() < 1e-5


def test_rest_pose_stands_on_the_ground_facing_forward(character: Character, tmp_path) -> None:
    glb = written(character, tmp_path)
    assert abs(glb.accessor(glb.primitive["attributes"]["POSITION"])[:, 1].min()) < 1e-6
    names = {node["name"]: index for index, node in enumerate(glb.json["nodes"])}
    assert set(joint_names("smpl")) < set(names)
    assert glb.json["nodes"][names["left_shoulder"]]["translation"][0] > 0


def test_weights_sum_to_one_and_joints_without_weight_are_zero(character: Character) -> None:
    joints, weights = four_influences(character.weights)
    assert np.abs(weights.sum(1, dtype=np.float64) - 1).max() < 3e-7
    assert not joints[weights == 0].any()
    dense = np.zeros_like(character.weights)
    np.add.at(dense, (np.arange(len(dense))[:, None], joints), weights)
    assert np.abs(dense - character.weights).max() < 1e-4


def test_image_in_the_file_is_the_texture(character: Character, tmp_path) -> None:
    glb = written(character, tmp_path)
    with Image.open(io.BytesIO(glb.image(0))) as image:
        assert (np.asarray(image) == character.texture).all()
    assert glb.json["materials"][0]["normalTexture"] == {"index": 1}


def test_vertex_colours_are_stored_linear(tmp_path) -> None:
    character = small_character(texture=0)
    grey = replace(character, colors=np.full_like(character.colors, 0.5))
    glb = written(grey, tmp_path)
    stored = glb.accessor(glb.primitive["attributes"]["COLOR_0"])
    assert np.abs(stored[:, :3] - 0.21404).max() < 1e-4
    assert (stored[:, 3] == 1).all()


def test_lit_colours_are_shown_without_light(tmp_path) -> None:
    glb = written(small_character(lit=True), tmp_path)
    assert glb.json["extensionsUsed"] == ["KHR_materials_unlit"]
    assert "normalTexture" not in glb.json["materials"][0]


def test_still_mesh_has_no_rig(character: Character, tmp_path) -> None:
    glb = written(as_still(character), tmp_path)
    assert not {"skins", "animations"} & set(glb.json)
    stored = glb.accessor(glb.primitive["attributes"]["POSITION"])
    assert np.abs(stored - character.vertices[character.atlas.vertex]).max() < 1e-6


def test_morph_targets_have_names_and_normals_on_request(character: Character, tmp_path) -> None:
    assert len(written(character, tmp_path).json["meshes"][0]["extras"]["targetNames"]) == TARGETS
    assert "NORMAL" in written(character, tmp_path).primitive["targets"][0]
    assert "NORMAL" not in written(character, tmp_path, morph_normals=False).primitive["targets"][0]


def test_quaternions_take_the_short_way_from_frame_to_frame() -> None:
    poses = np.zeros((40, 24, 3), dtype=np.float32)
    poses[:, 3, 1] = np.linspace(0, 6 * np.pi, 40)
    whole = quaternions(poses)
    assert ((whole[1:] * whole[:-1]).sum(-1) > 0.8).all()
    assert np.abs(whole[0] - [0, 0, 0, 1]).max() < 1e-7
