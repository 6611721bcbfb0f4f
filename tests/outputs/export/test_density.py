"""Characters of a level in posed space: a surface that is known in every pose comes out again."""

from pathlib import Path

import numpy as np
import pytest
import torch
from gltf_reader import read_glb, shown_at
from tiny_person import bone_distances

from twofold.body.skeleton import PosedBody, pose_body, shape_body
from twofold.capture.types import Capture
from twofold.geometry.surfaces import nearest_vertices
from twofold.methods.base import EVALUATION, Avatar, PosedAvatar, Rendering
from twofold.methods.subject import Subject
from twofold.outputs.export.bake import BakeConfig, rest_body
from twofold.outputs.export.density import t_pose
from twofold.outputs.export.make import Baked, bake, still, training_poses
from twofold.outputs.export.repair import is_watertight
from twofold.outputs.export.write import ExportRequest, export

SMALL = BakeConfig(faces=1500, texture=256, frames=5, color_frames=2)
THICK = 0.09
"""How far the known surface is from the bones, metres: one more than the body's."""


class KnownSurface(Avatar[None]):
    """Its level is the distance to the posed bones, saturated as that of a density; red above the pelvis, blue below.

    Every pose is corrected, that of all zeros, too, as HumanNeRF's network does.
    """

    def __init__(self, subject: Subject):
        super().__init__()
        self.subject = subject
        self.nothing = torch.nn.Parameter(torch.zeros(1))

    def pose(self, pose, translation, frame_index=None, mode=EVALUATION):
        turned = pose.clone()
        turned[16, 2] += 0.1
        return PosedAvatar(pose_body(shape_body(self.subject.body, self.subject.betas), turned, translation), None)

    def level(self, x, posed, branch="full"):
        return from_surface(x, posed.body).clamp(-0.02, 0.02)

    @property
    def level_space(self):
        return "posed"

    def render(self, rays, posed, background, mode=EVALUATION, generator=None):
        at = rays.origins + 0.02 * rays.directions
        _, nearest = nearest_vertices(at, posed.body.vertices)
        upper = self.subject.body.template[nearest[:, 0], 1] > self.subject.body.joints[0, 1]
        opacity = torch.full_like(at[:, 0], 0.8)
        color = torch.where(upper[:, None], torch.tensor([1.0, 0, 0]), torch.tensor([0, 0, 1.0]))
        return Rendering(0.8 * color + 0.2 * background, opacity, opacity, torch.zeros_like(at))

    def losses(self, rendering, batch, posed, mode, generator):
        return {}

    def parameter_groups(self):
        return []


def from_surface(x: torch.Tensor, body: PosedBody) -> torch.Tensor:
    """Signed distance to the known surface in a pose, metres."""
    return bone_distances(body.joints, x).amin(-1) - THICK


@pytest.fixture(scope="module")
def avatar(person: Capture) -> KnownSurface:
    return KnownSurface(Subject.of(person))


@pytest.fixture(scope="module")
def baked(avatar: KnownSurface, person: Capture) -> Baked:
    return bake(avatar, person, SMALL)


def test_the_rest_pose_is_the_t_pose_whatever_the_method_corrects(avatar: KnownSurface) -> None:
    assert t_pose(avatar).pose.abs().max() == 0
    assert torch.equal(rest_body(avatar).vertices, t_pose(avatar).vertices)
    assert (avatar.pose(torch.zeros(24, 3), torch.zeros(3)).body.vertices - t_pose(avatar).vertices).norm(
        dim=1
    ).max() > 0.01


def test_character_lies_on_the_known_surface_of_the_t_pose(baked: Baked, avatar: KnownSurface) -> None:
    assert is_watertight(baked.character.vertices, baked.character.faces)
    assert len(baked.character.targets) == 0
    rest = t_pose(avatar)
    vertices = torch.from_numpy(baked.character.vertices)
    away = from_surface(vertices, rest).abs()
    assert away.median() < 0.003
    assert away.quantile(0.95) < 0.015


def test_meshes_of_single_frames_lie_on_their_known_surfaces(
    baked: Baked, avatar: KnownSurface, person: Capture
) -> None:
    for frame in person.train[::2]:
        posed = avatar.pose(frame.pose, frame.translation, frame.frame_index)
        there = torch.from_numpy(still(baked, frame.frame_index).vertices)
        away = from_surface(there, posed.body).abs()
        assert away.median() < 1e-3
        assert away.quantile(0.9) < 0.01


def test_colours_are_what_rays_onto_the_surface_see(baked: Baked, avatar: KnownSurface) -> None:
    """Opacity is divided out; the two halves keep their colours up to the triangles between them."""
    height = baked.character.vertices[:, 1] - t_pose(avatar).joints[0, 1].item()
    colors = baked.character.colors
    assert abs(colors[height > 0.1] - [1, 0, 0]).mean() < 0.02
    assert abs(colors[height < -0.1] - [0, 0, 1]).mean() < 0.02
    assert baked.character.lit


def test_the_file_holds_the_character_and_its_motion(avatar: KnownSurface, person: Capture, tmp_path: Path) -> None:
    """Read by code that shares nothing with the writer, the skinned vertices stand on the ground in every frame."""
    export(avatar, person, tmp_path, ExportRequest(("glb", "vrm"), SMALL))
    assert (tmp_path / "avatar.vrm").stat().st_size > 10_000
    glb, frames = read_glb(tmp_path / "avatar.glb"), training_poses(person)
    for index in (0, len(frames) - 1):
        _, shown = shown_at(glb, 0, index)
        body = frames[index].of(avatar).body
        height = float(body.joints[:, 1].max() - body.joints[:, 1].min()) + 2 * THICK
        assert abs(np.ptp(shown[:, 1]) - height) < 0.03
