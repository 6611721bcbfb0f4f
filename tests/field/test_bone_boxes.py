import math

import pytest
import torch
from little_body import JOINTS

from twofold.body.skeleton import PARENTS, joint_transforms
from twofold.field.bone_boxes import (
    RIGID_PARTS,
    TWO_HOPS,
    BoxSizes,
    assign_to_boxes,
    bone_frames,
    box_coordinates,
    box_window,
    initial_half_sizes,
    inside_boxes,
)

JOINTS = torch.tensor(JOINTS, dtype=torch.float64)
ONE_CHILD = [1, 2, 3, 4, 5, 6, 7, 8, 12, 13, 14, 16, 17, 18, 19, 20, 21]


def posed(generator):
    pose = 0.5 * torch.randn(24, 3, generator=generator, dtype=torch.float64)
    return joint_transforms(JOINTS, pose, torch.tensor([0.3, -0.2, 0.5], dtype=torch.float64))


def test_bones_lie_along_z_with_the_origin_in_their_middle_in_any_pose(generator):
    transforms = posed(generator)
    to_frame = bone_frames(JOINTS).world_to_frame(transforms)
    places = (transforms[:, :3, :3] @ JOINTS[..., None])[..., 0] + transforms[:, :3, 3]
    for child in range(1, 24):
        joint = PARENTS[child]
        if joint not in ONE_CHILD:
            continue
        ends = torch.stack([places[joint], places[child]])
        local = ends @ to_frame[joint, :3, :3].T + to_frame[joint, :3, 3]
        half = (JOINTS[child] - JOINTS[joint]).norm() / 2
        expected = torch.tensor([[0, 0, -half], [0, 0, half]], dtype=torch.float64)
        torch.testing.assert_close(local, expected, atol=1e-12, rtol=0)


def test_frames_of_other_joints_are_the_joints_own(generator):
    transforms = posed(generator)
    to_frame = bone_frames(JOINTS).world_to_frame(transforms)
    for joint in sorted(set(range(24)) - set(ONE_CHILD)):
        x = torch.rand(3, generator=generator, dtype=torch.float64)
        world = transforms[joint, :3, :3] @ (x + JOINTS[joint]) + transforms[joint, :3, 3]
        torch.testing.assert_close(to_frame[joint, :3, :3] @ world + to_frame[joint, :3, 3], x)


def test_frames_are_rotations_also_for_bones_along_minus_z():
    joints = JOINTS.clone()
    joints[7] = joints[4] - torch.tensor([0, 0, 0.4], dtype=torch.float64)
    rotations = bone_frames(joints).rotations
    torch.testing.assert_close(rotations @ rotations.mT, torch.eye(3, dtype=torch.float64).expand(24, 3, 3))
    torch.testing.assert_close(torch.linalg.det(rotations), torch.ones(24, dtype=torch.float64))


def test_initial_sizes_are_the_listed_proportions():
    def length(a, b):
        return math.dist(JOINTS[a].tolist(), JOINTS[b].tolist())

    knees, shoulders = length(4, 5), length(16, 17)
    sizes = initial_half_sizes(JOINTS)
    assert sizes[4].tolist() == pytest.approx([knees / 2, knees / 2, 0.8 * length(4, 7)])
    root = 0.8 * (length(0, 1) + length(0, 2) + length(0, 3)) / 3
    assert sizes[0].tolist() == pytest.approx([shoulders / 2, shoulders / 2, root])
    chest = 0.8 * (length(9, 12) + length(9, 13) + length(9, 14)) / 3
    assert sizes[9].tolist() == pytest.approx([shoulders / 2, shoulders / 2, chest])
    assert sizes[18].tolist() == pytest.approx([0.4 * knees, 0.4 * knees, 0.8 * length(18, 20)])
    assert sizes[10].tolist() == pytest.approx([knees / 2, knees / 2, length(7, 10)])
    assert sizes[22].tolist() == pytest.approx([0.4 * knees, 0.4 * knees, length(20, 22)])
    others = [j for j in range(24) if j not in (12, 15)]
    largest = max(sizes[j, 2].item() for j in others)
    assert sizes[12].tolist() == pytest.approx([0.3 * shoulders, 0.35 * shoulders, 0.3 * largest])
    assert sizes[15].tolist() == pytest.approx([0.3 * shoulders, 0.6 * shoulders, 0.3 * largest])


def test_sizes_stop_at_their_minimum_but_gradients_pass():
    initial = initial_half_sizes(JOINTS)
    boxes = BoxSizes(initial)
    torch.testing.assert_close(boxes(), initial)
    with torch.no_grad():
        boxes.sizes[3] *= 0.5
        boxes.sizes[4] *= 2
    torch.testing.assert_close(boxes()[3], 0.95 * initial[3])
    torch.testing.assert_close(boxes()[4], 2 * initial[4])
    boxes().sum().backward()
    assert (boxes.sizes.grad == 1).all()
    assert sum(p.numel() for p in boxes.parameters()) == 72


def test_coordinates_are_those_of_the_frame_over_the_half_sizes(generator):
    to_frame, sizes = bone_frames(JOINTS).world_to_frame(posed(generator)), initial_half_sizes(JOINTS)
    points = torch.randn(4, 3, generator=generator, dtype=torch.float64)
    found = box_coordinates(points, to_frame, sizes)
    for s in range(4):
        for j in range(24):
            expected = (to_frame[j, :3, :3] @ points[s] + to_frame[j, :3, 3]) / sizes[j]
            torch.testing.assert_close(found[s, j], expected)


def test_points_are_inside_up_to_the_faces():
    points = torch.tensor([[1.0, -1, 0.2], [1.01, 0, 0], [0, 0, 0]])
    assert inside_boxes(points).tolist() == [True, False, True]


def test_window_is_the_printed_exponential(generator):
    x = torch.randn(20, 3, generator=generator, dtype=torch.float64)
    expected = [math.exp(-2 * sum(c**6 for c in row)) for row in x.tolist()]
    assert box_window(x).tolist() == pytest.approx(expected)
    assert torch.autograd.gradcheck(box_window, x.requires_grad_())


def test_parts_are_nineteen_and_reach_only_each_other():
    assert len(RIGID_PARTS) == 19
    assert set(TWO_HOPS) == set(RIGID_PARTS)
    assert all(part in row and set(row) <= set(RIGID_PARTS) and len(row) >= 3 for part, row in TWO_HOPS.items())


def test_points_belong_to_the_nearest_box_that_holds_them(generator):
    coordinates = 1.5 * torch.randn(60, 7, 3, generator=generator)
    half_sizes = 0.1 + torch.rand(7, 3, generator=generator)
    found = assign_to_boxes(coordinates, half_sizes, tries=4).tolist()
    for n, part in enumerate(found):
        by_distance = sorted(range(7), key=lambda j: (coordinates[n, j] * half_sizes[j]).norm().item())
        holding = [j for j in by_distance[:4] if coordinates[n, j].abs().max() <= 1]
        assert part == (holding[0] if holding else -1)
    assert -1 in found
    assert len(set(found)) > 4
