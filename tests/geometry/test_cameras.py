import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from twofold.geometry.cameras import (
    Camera,
    Rays,
    clip_to_box,
    pixel_grid,
    pixel_rays,
    project,
    without_tiny_components,
)
from twofold.geometry.rotations import axis_angle_to_matrix, rigid_inverse, rigid_transform


def make_camera(seed=0, height=40, width=60):
    g = torch.Generator().manual_seed(seed)
    rotation = axis_angle_to_matrix(torch.randn(3, generator=g, dtype=torch.float64))
    pose = rigid_transform(rotation, torch.randn(3, generator=g, dtype=torch.float64))
    k = torch.tensor([[70.0, 0.4, 29.0], [0, 64, 21], [0, 0, 1]], dtype=torch.float64)
    return Camera(pose, k, height, width)


@given(st.integers(0, 10_000), st.floats(0.1, 20))
def test_points_on_a_pixels_ray_project_onto_that_pixel(seed, distance):
    camera = make_camera(seed)
    pixels = torch.rand(7, 2, generator=torch.Generator().manual_seed(seed), dtype=torch.float64) * 50
    rays = pixel_rays(camera, pixels)
    back, depth = project(camera, rays.origins + distance * rays.directions)
    assert torch.allclose(back, pixels, atol=1e-8)
    assert (depth > 0).all()
    assert torch.allclose(rays.directions.norm(dim=-1), torch.ones(7, dtype=torch.float64))


def test_the_centre_is_where_the_camera_is_at_home():
    camera = make_camera(3)
    assert torch.allclose(camera.center, rigid_inverse(camera.world_to_camera)[:3, 3])


def test_a_known_camera_sees_right_to_the_right_and_up_above():
    # At z = 4 looking back along -z with y up: OpenCV axes are x right, y down, z forward.
    world_to_camera = torch.diag(torch.tensor([1.0, -1.0, -1.0, 1.0]))
    world_to_camera[2, 3] = 4.0
    camera = Camera(world_to_camera, torch.tensor([[100.0, 0, 50], [0, 100, 50], [0, 0, 1]]), 101, 101)
    pixel, depth = project(camera, torch.tensor([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 2]]))
    assert torch.allclose(pixel, torch.tensor([[50.0, 50], [75, 50], [50, 25], [50, 50]]))
    assert torch.allclose(depth, torch.tensor([4.0, 4, 4, 2]))


@pytest.mark.parametrize("factor", [2, 3, 4])
def test_the_samples_of_a_larger_image_lie_evenly_in_the_pixels_of_the_smaller(factor):
    camera = make_camera(1)
    fine = camera.resized(camera.height * factor, camera.width * factor)
    through_fine = pixel_rays(fine, pixel_grid(fine))
    pixel, _ = project(camera, through_fine.origins + through_fine.directions)
    blocks = pixel.view(camera.height, factor, camera.width, factor, 2).mean((1, 3))
    assert torch.allclose(blocks, pixel_grid(camera), atol=1e-9)


def test_resizing_there_and_back_gives_the_same_camera():
    camera = make_camera(2)
    back = camera.resized(13, 99).resized(camera.height, camera.width)
    assert torch.allclose(back.intrinsics, camera.intrinsics)


def test_the_grid_gives_column_then_row():
    grid = pixel_grid(make_camera(0, 3, 5))
    assert grid.shape == (3, 5, 2)
    assert grid[2, 4].tolist() == [4, 2]


@settings(max_examples=60)
@given(st.integers(0, 10_000))
def test_clipping_to_a_box_agrees_with_walking_along_the_ray(seed):
    g = torch.Generator().manual_seed(seed)
    origins = 3 * torch.randn(20, 3, generator=g)
    directions = torch.nn.functional.normalize(torch.randn(20, 3, generator=g), dim=-1)
    low, high = torch.tensor([-1.0, -0.5, -2.0]), torch.tensor([0.5, 1.0, 1.0])
    rays, meets = clip_to_box(Rays(origins, directions, torch.zeros(20), torch.full((20,), math.inf)), low, high)
    steps = torch.linspace(0, 20, 4001)
    points = origins[:, None] + steps[:, None] * directions[:, None]
    inside = ((points > low) & (points < high)).all(-1)
    for i in range(20):
        walked = steps[inside[i]]
        if len(walked) > 1:
            assert meets[i]
            assert abs(walked[0] - rays.near[i]) < 0.006
            assert abs(walked[-1] - rays.far[i]) < 0.006
        elif len(walked) == 0 and meets[i]:
            assert rays.far[i] - rays.near[i] < 0.006


def test_a_ray_along_an_axis_is_clipped_without_a_nan():
    ray = Rays(torch.zeros(1, 3), torch.tensor([[0.0, 0, 1]]), torch.zeros(1), torch.full((1,), math.inf))
    clipped, meets = clip_to_box(ray, torch.tensor([0.0, -1, 1]), torch.tensor([1.0, 1, 3]))
    assert torch.isfinite(clipped.near).all()
    assert torch.isfinite(clipped.far).all()
    assert meets.dtype == torch.bool


def test_rays_can_be_picked_by_index():
    rays = pixel_rays(make_camera(), torch.rand(6, 2, dtype=torch.float64))
    assert len(rays) == 6
    assert torch.equal(rays[2:4].directions, rays.directions[2:4])


def test_tiny_components_of_directions_become_the_released_constant_and_others_stay():
    given = torch.tensor([[0.0, 9e-6, -9e-6], [-0.6, 1e-5, 0.8], [-2e-5, 0.0, -1.0]], dtype=torch.float64)
    rays = Rays(torch.zeros(3, 3, dtype=torch.float64), given, torch.zeros(3), torch.ones(3))
    expected = [[1e-5 if abs(d) < 1e-5 else d for d in row] for row in given.tolist()]
    assert without_tiny_components(rays).directions.tolist() == expected
