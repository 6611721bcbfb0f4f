"""PLY and OBJ, read back by trimesh."""

import numpy as np
import trimesh
from characters import as_still, small_character

from twofold.outputs.export.options import ExportOptions
from twofold.outputs.export.ply_obj import write_obj, write_ply


def test_ply_has_positions_normals_colours_and_what_was_observed(tmp_path) -> None:
    character = as_still(small_character(texture=0))
    write_ply(character, tmp_path / "a.ply", ExportOptions())
    mesh = trimesh.load(tmp_path / "a.ply", process=False)
    assert np.abs(mesh.vertices - character.vertices).max() < 1e-6
    assert (mesh.faces == character.faces).all()
    assert np.abs(mesh.visual.vertex_colors[:, :3] / 255 - character.colors).max() < 0.6 / 255
    assert (mesh.vertex_normals * trimesh.Trimesh(mesh.vertices, mesh.faces).vertex_normals).sum(1).mean() > 0.95
    stored = mesh.metadata["_ply_raw"]["vertex"]["data"]["observed"]
    assert np.abs(stored.ravel() - character.observed).max() < 1e-6


def test_obj_carries_its_texture(tmp_path) -> None:
    character = as_still(small_character())
    write_obj(character, tmp_path / "a.obj", ExportOptions())
    mesh = trimesh.load(tmp_path / "a.obj", process=False)
    assert len(mesh.faces) == len(character.faces)
    corners = character.vertices[character.faces]
    assert np.abs(mesh.vertices[mesh.faces] - corners).max() < 1e-5
    uv = character.atlas.uv[character.atlas.faces]
    assert np.abs(mesh.visual.uv[mesh.faces] - np.stack([uv[..., 0], 1 - uv[..., 1]], -1)).max() < 1e-5
    assert (np.asarray(mesh.visual.material.image)[..., :3] == character.texture).all()


def test_obj_without_texture_has_colours_behind_the_positions(tmp_path) -> None:
    character = as_still(small_character(texture=0))
    write_obj(character, tmp_path / "a.obj", ExportOptions())
    rows = [line.split()[1:] for line in (tmp_path / "a.obj").read_text().splitlines() if line.startswith("v ")]
    assert np.abs(np.array(rows, float)[:, 3:] - character.colors).max() < 1e-4
