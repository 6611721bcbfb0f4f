import torch
from little_body import little_body

from twofold.body.skeleton import pose_body, shape_body
from twofold.geometry.cameras import Camera
from twofold.geometry.raster import silhouette
from twofold.outputs.mesh_images import floor_image, mesh_image
from twofold.outputs.views import look_at

BODY = pose_body(shape_body(little_body(), torch.zeros(1)), torch.zeros(24, 3), torch.tensor([0.0, 1.21, 0.0]))
CAMERA = Camera(
    look_at(torch.tensor([0.5, 1.2, 4.0]), torch.tensor([0.0, 0.9, 0.0]), torch.tensor([0.0, 1.0, 0.0])),
    torch.tensor([[120.0, 0, 31.5], [0, 120, 31.5], [0, 0, 1]]), 64, 64,
)  # fmt: skip


def test_opacity_is_the_silhouette_and_colour_never_exceeds_it():
    color, opacity = mesh_image(CAMERA, BODY.vertices, BODY.faces)
    assert (opacity - silhouette(CAMERA, BODY.vertices, BODY.faces, 2)).abs().mean() < 0.01
    assert (color <= opacity[..., None] + 1e-6).all()
    assert color.min() >= 0


def test_given_colours_are_shown_as_they_are():
    colors = torch.tensor([0.2, 0.5, 0.9]).expand(len(BODY.vertices), 3)
    color, opacity = mesh_image(CAMERA, BODY.vertices, BODY.faces, colors)
    inside = opacity == 1
    torch.testing.assert_close(color[inside], torch.tensor([0.2, 0.5, 0.9]).expand(int(inside.sum()), 3))


def test_clay_is_brighter_towards_the_light():
    color, opacity = mesh_image(CAMERA, BODY.vertices, BODY.faces)
    shades = color.mean(-1)[opacity == 1]
    assert shades.max() > 1.5 * shades.min()


def test_the_floor_lies_below_the_horizon_and_carries_a_shadow():
    white = torch.ones(3)
    lit = floor_image(CAMERA, white, BODY.vertices + torch.tensor([0.0, 50.0, 0.0]), BODY.faces)
    shaded = floor_image(CAMERA, white, BODY.vertices, BODY.faces)
    assert torch.equal(lit[0], torch.ones(64, 3))
    assert lit[60].mean() < 0.9
    darker = (lit - shaded).mean(-1)
    assert darker.min() > -1e-6
    assert (darker > 0.1).sum() > 20
