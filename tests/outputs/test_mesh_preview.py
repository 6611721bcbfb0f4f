"""The compiled rasterizer beside the slow one of `geometry.raster`."""

import numpy as np
import pytest
import torch
from characters import small_character

from twofold.geometry.cameras import Camera
from twofold.geometry.raster import box_filter, rasterize, supersampled
from twofold.outputs.export.character import Character
from twofold.outputs.mesh_preview import render_mesh
from twofold.outputs.views import look_at

BACKGROUND = np.array([0.2, 0.4, 0.9], np.float32)


def camera(size: int = 96, away: float = 3.0) -> Camera:
    pose = look_at(torch.tensor([0.7, 0.4, away]), torch.tensor([0.0, -0.2, 0.0]), torch.tensor([0.0, 1.0, 0.0]))
    intrinsics = torch.tensor([[1.4 * size, 0, size / 2], [0, 1.4 * size, size / 2], [0, 0, 1.0]])
    return Camera(pose, intrinsics, size, size)


def slow(character: Character, view: Camera, samples: int) -> tuple[torch.Tensor, torch.Tensor]:
    vertices, faces = torch.from_numpy(character.vertices), torch.from_numpy(character.faces)
    hits = rasterize(supersampled(view, samples), vertices, faces, cull=True)
    colors = (torch.from_numpy(character.colors)[faces[hits.face]] * hits.barycentric[..., None]).sum(1)
    opacity = box_filter(view, samples, hits.pixel, torch.ones(len(hits.pixel), 1))
    color = box_filter(view, samples, hits.pixel, colors) + (1 - opacity) * torch.from_numpy(BACKGROUND)
    return color, opacity[..., 0]


@pytest.mark.parametrize("samples", [1, 2, 3])
def test_image_is_that_of_the_slow_rasterizer(samples: int) -> None:
    character = small_character(texture=0)
    found = render_mesh(character, character.vertices, camera(), BACKGROUND, samples)
    color, opacity = slow(character, camera(), samples)
    differs = (np.abs(found[..., :3] - color.numpy()).max(-1) > 2e-3) | (np.abs(found[..., 3] - opacity.numpy()) > 1e-3)
    assert differs.mean() < 2e-3  # pixel centres that lie on an edge, by rounding
    assert opacity.max() == 1


def test_texture_shows_what_the_vertices_have() -> None:
    plain = small_character(texture=0)
    textured = small_character(texture=512)
    images = [render_mesh(c, c.vertices, camera(), BACKGROUND) for c in (plain, textured)]
    assert np.abs(images[0] - images[1]).mean() < 0.01


def test_headlight_darkens_what_turns_away() -> None:
    character = small_character(texture=0)
    plain, shaded = (
        render_mesh(character, character.vertices, camera(), BACKGROUND, 2, light) for light in (False, True)
    )
    inside = plain[..., 3] == 1
    assert (shaded[inside][:, :3] <= plain[inside][:, :3] + 1e-5).all()
    assert shaded[inside][:, :3].mean() < 0.97 * plain[inside][:, :3].mean()


def test_mesh_behind_the_camera_is_not_seen() -> None:
    character = small_character(texture=0)
    image = render_mesh(character, character.vertices + np.array([0, 0, 9], np.float32), camera(), BACKGROUND)
    assert (image[..., 3] == 0).all()
    assert np.abs(image[..., :3] - BACKGROUND).max() < 1e-6
