import math

import pytest
import torch
from little_body import JOINTS

from twofold.body.skeleton import joint_transforms
from twofold.field.bone_boxes import bone_frames, box_coordinates, initial_half_sizes
from twofold.geometry.cameras import Rays
from twofold.sampling.box_bounds import clip_to_bone_boxes, clip_to_cylinder

JOINTS = torch.tensor(JOINTS)


def boxes(generator):
    posed = joint_transforms(JOINTS, 0.3 * torch.randn(24, 3, generator=generator), torch.zeros(3))
    return bone_frames(JOINTS).world_to_frame(posed), initial_half_sizes(JOINTS)


def rays_around(generator, count=300):
    origins = torch.randn(count, 3, generator=generator)
    origins = 3 * origins / origins.norm(dim=1, keepdim=True)
    targets = 0.5 * torch.randn(count, 3, generator=generator)
    directions = torch.nn.functional.normalize(targets - origins, dim=1)
    return Rays(origins, directions, torch.zeros(count), torch.full((count,), 10.0))


def test_bounds_are_the_first_and_last_point_in_any_box(generator):
    frames, sizes = boxes(generator)
    rays = rays_around(generator)
    clipped, meets = clip_to_bone_boxes(rays, frames, sizes)
    steps = torch.linspace(0, 7, 3501)
    points = rays.origins[:, None] + steps[:, None] * rays.directions[:, None]
    inside = (box_coordinates(points.flatten(0, 1), frames, 1.1 * sizes).abs() <= 1).all(-1).any(-1)
    inside = inside.unflatten(0, (len(rays), -1))
    assert 0.2 < meets.float().mean() < 1
    for ray in range(len(rays)):
        found = steps[inside[ray]].tolist()
        if not found:
            short = (clipped.far[ray] - clipped.near[ray]).item() if meets[ray] else 0
            assert short < 0.01
            continue
        assert meets[ray]
        assert clipped.near[ray].item() == pytest.approx(found[0], abs=0.006)
        assert clipped.far[ray].item() == pytest.approx(found[-1], abs=0.006)


def test_rays_that_miss_keep_their_bounds(generator):
    frames, sizes = boxes(generator)
    rays = Rays(torch.full((1, 3), 5.0), torch.tensor([[1.0, 0, 0]]), torch.ones(1), torch.full((1,), 7.0))
    clipped, meets = clip_to_bone_boxes(rays, frames, sizes)
    assert not meets.any()
    assert (clipped.near.item(), clipped.far.item()) == (1, 7)


def test_rays_along_a_face_are_finite():
    rays = Rays(torch.tensor([[-3.0, 0.2, 0.2]]), torch.tensor([[1.0, 0, 0]]), torch.zeros(1), torch.full((1,), 9.0))
    clipped, meets = clip_to_bone_boxes(rays, torch.eye(4)[None], torch.full((1, 3), 0.5))
    assert meets.all()
    assert clipped.near.item() == pytest.approx(3 - 0.55)
    assert clipped.far.item() == pytest.approx(3 + 0.55)


def test_cylinder_is_upright_around_the_pelvis(generator):
    rays, up = rays_around(generator), torch.tensor([0.0, 1, 0])
    clipped, meets = clip_to_cylinder(rays, JOINTS, up)
    radius = 0.25 + max(math.hypot(x - JOINTS[0, 0].item(), z - JOINTS[0, 2].item()) for x, _, z in JOINTS.tolist())
    for depth, bound in ((clipped.near, 0.0), (clipped.far, 10.0)):
        hit = rays.origins + depth[:, None] * rays.directions - JOINTS[0]
        distance = hit[:, [0, 2]].norm(dim=1)
        assert ((distance[meets] - radius).abs().lt(1e-4) | (depth[meets] == bound)).all()
    assert meets.float().mean() > 0.5
