import math

import numpy as np
import pytest
import torch
from watching import camera_at

from twofold.geometry.cameras import project
from twofold.geometry.raster import depth_map
from twofold.outputs.views import RenderedImage
from twofold.viewer.body_pose import BodyPose
from twofold.viewer.view_images import (
    FAR,
    PAPER,
    QUANTITIES,
    body_character,
    cut_out,
    depth_colors,
    field_view,
    joint_palette,
    mesh_box,
    mesh_view,
    quaternion,
    residual_character,
    strips,
    view_camera,
)


@pytest.fixture
def clay(viewed):
    return body_character(viewed.body)


@pytest.mark.parametrize("quantity", QUANTITIES)
def test_the_mesh_is_where_the_literal_rasterizer_sees_it(viewed, clay, quantity):
    camera, posed = camera_at(viewed), viewed.timelines[0].poses[2]
    image = mesh_view(clay, posed, camera, quantity)
    from twofold.outputs.export.character import pose_character

    vertices = torch.from_numpy(pose_character(clay, posed.pose.numpy(), posed.translation.numpy()))
    depth, seen = depth_map(camera, vertices, viewed.body.faces)
    covered = torch.from_numpy(image.depth) < FAR
    assert (covered == seen).float().mean() > 0.995
    both = covered & seen
    assert both.sum() > 100
    assert (torch.from_numpy(image.depth)[both] - depth[both]).abs().max() < 2e-3
    paper = (255, 255, 255) if quantity == "normals" else tuple(round(255 * share) for share in PAPER)
    assert (image.color[0, 0] == paper).all()
    assert (image.color[both.numpy()] != paper).any(-1).mean() > 0.9


def test_a_mesh_beside_the_view_is_not_seen_and_one_around_the_camera_does_no_harm(viewed, clay):
    camera = camera_at(viewed)
    aside = BodyPose(torch.zeros(24, 3), torch.tensor([50.0, 0, 0]))
    assert (mesh_view(clay, aside, camera, "colour").depth == FAR).all()
    around = BodyPose(torch.zeros(24, 3), camera.center - viewed.body.joints[0])
    assert mesh_view(clay, around, camera, "colour").color.shape == (48, 64, 3)


def test_the_box_holds_every_projected_vertex(viewed):
    camera, vertices = camera_at(viewed), viewed.body.vertices + viewed.timelines[0].poses[0].translation
    rows, columns = mesh_box(vertices.numpy(), camera)
    pixels, _ = project(camera, vertices)
    inside = (pixels[:, 0] >= 0) & (pixels[:, 0] <= 63) & (pixels[:, 1] >= 0) & (pixels[:, 1] <= 47)
    assert (pixels[inside, 1] >= rows.start).all()
    assert (pixels[inside, 1] < rows.stop).all()
    assert (pixels[inside, 0] >= columns.start).all()
    assert (pixels[inside, 0] < columns.stop).all()


def test_a_part_of_an_image_sees_the_same_points_at_shifted_pixels(viewed):
    camera, points = camera_at(viewed), viewed.body.vertices
    part = cut_out(camera, slice(10, 30), slice(5, 50))
    whole, _ = project(camera, points)
    own, _ = project(part, points)
    assert torch.allclose(own + torch.tensor([5.0, 10.0]), whole, atol=1e-3)
    assert (part.height, part.width) == (20, 45)


def test_strips_cover_every_row_once(viewed):
    cut = strips(camera_at(viewed), 20)
    assert [(rows.start, rows.stop) for rows, _ in cut] == [(0, 20), (20, 40), (40, 48)]


def test_a_browser_camera_sees_what_its_quaternion_says(viewed):
    camera = camera_at(viewed)
    wxyz = np.array(quaternion(camera.world_to_camera[:3, :3].T))
    fov = 2 * math.atan(0.5 * 48 / float(camera.intrinsics[1, 1]))
    same = view_camera(wxyz, camera.center.numpy(), fov, 48, 64)
    assert torch.allclose(same.world_to_camera, camera.world_to_camera, atol=1e-5)
    assert torch.allclose(same.intrinsics, camera.intrinsics, atol=1e-4)


def test_near_points_are_yellow_and_far_ones_violet():
    colors = depth_colors(np.array([[1.0, 2.0, np.inf]], dtype=np.float32))
    assert colors[0, 0, 0] > 240
    assert colors[0, 0, 2] < 60
    assert colors[0, 1, 0] < 80
    assert tuple(colors[0, 2]) == tuple(round(255 * share) for share in PAPER)


def test_weights_of_neighbouring_joints_have_clearly_different_colours():
    palette = joint_palette()
    from twofold.body.skeleton import PARENTS

    apart = [np.abs(palette[joint] - palette[parent]).max() for joint, parent in enumerate(PARENTS) if parent >= 0]
    assert min(apart) > 0.2


def test_residual_is_grey_where_base_and_full_agree(clay):
    other = residual_character(clay, clay)
    assert np.allclose(other.colors, 0.5)


def test_field_views_show_part_and_quantity_and_a_depth_along_the_axis(viewed):
    camera = camera_at(viewed, 6, 8)
    ones = torch.ones(6, 8)
    image = RenderedImage(
        0.8 * torch.ones(6, 8, 3), ones, 2 * ones, torch.zeros(6, 8, 3), 0.3 * torch.ones(6, 8, 3),
        torch.zeros(6, 8, 3), 0.2 * ones,
    )  # fmt: skip
    assert field_view(image, camera, "full", "colour").color[0, 0, 0] == 204
    assert field_view(image, camera, "base", "colour").color[0, 0, 0] in (76, 77)
    assert field_view(image, camera, "residual", "colour").color[0, 0, 0] == 255
    depth = field_view(image, camera, "full", "depth").depth
    assert depth.max() == pytest.approx(2.0, abs=0.02)
    assert depth[0, 0] < depth[3, 4]
