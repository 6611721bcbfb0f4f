"""What cameras see of a pose's change: against finite differences, and that one camera does not see depth."""

import itertools

import torch
from little_body import little_body

from twofold.body.skeleton import joint_transforms, shape_body
from twofold.deform.observability import left_jacobian, observed_projection, pose_jacobian
from twofold.geometry.rotations import axis_angle_to_matrix

CAMERA = torch.tensor([[0.0, 0.0, 6.0]])


def person():
    body = little_body()
    return shape_body(body, torch.zeros(body.shape_basis.shape[-1]))


def some_pose(size=0.4, seed=0):
    return size * torch.randn(24, 3, generator=torch.Generator().manual_seed(seed))


def joints_of(shaped, numbers):
    placed = joint_transforms(shaped.joints.double(), numbers[:72].reshape(24, 3), numbers[72:])
    return (placed[:, :3, :3] @ shaped.joints.double()[..., None])[..., 0] + placed[:, :3, 3]


def test_left_jacobian_is_that_of_the_exponential():
    vectors = torch.cat([torch.zeros(1, 3), 1e-5 * torch.ones(1, 3), some_pose(1.5)]).double()
    step = 1e-6
    for axis in range(3):
        moved = vectors.clone()
        moved[:, axis] += step
        change = axis_angle_to_matrix(moved) @ axis_angle_to_matrix(vectors).transpose(1, 2)
        spin = torch.stack([change[:, 2, 1], change[:, 0, 2], change[:, 1, 0]], -1) / step
        torch.testing.assert_close(left_jacobian(vectors)[..., axis], spin, atol=1e-4, rtol=1e-4)


def test_the_jacobian_agrees_with_automatic_differentiation():
    shaped, pose = person(), some_pose()
    numbers = torch.cat([pose.flatten(), torch.tensor([0.1, 0.2, 0.3])]).double()
    expected = torch.autograd.functional.jacobian(lambda n: joints_of(shaped, n), numbers)
    points, moves = pose_jacobian(shaped, pose, torch.tensor([0.1, 0.2, 0.3]))
    # The first of each joint's seven points is the joint itself.
    torch.testing.assert_close(points[::7].double(), joints_of(shaped, numbers), atol=1e-5, rtol=1e-5)
    torch.testing.assert_close(moves[::7].double(), expected, atol=1e-4, rtol=1e-4)


def projection(cameras=CAMERA, pose=None):
    return observed_projection(*pose_jacobian(person(), some_pose() if pose is None else pose, torch.zeros(3)), cameras)


def test_it_is_a_projection():
    one = projection()
    torch.testing.assert_close(one @ one, one, atol=1e-6, rtol=1e-6)
    # Some directions are seen, and some are not.
    assert 50 < float(one.diagonal().sum()) < 74


def test_one_camera_does_not_see_depth():
    one = projection(pose=torch.zeros(24, 3))
    far = torch.zeros(75, dtype=torch.float64)
    far[74] = 1
    assert float((one @ far)[74]) < 0.02
    aside = torch.zeros(75, dtype=torch.float64)
    aside[72] = 1
    assert float((one @ aside)[72]) > 0.9


def test_what_is_removed_hardly_moves_in_the_image_and_two_cameras_see_nearly_all():
    shaped, pose = person(), some_pose()
    points, moves = pose_jacobian(shaped, pose, torch.zeros(3))
    rays = torch.nn.functional.normalize(points - CAMERA[0], dim=-1).double()
    removed = torch.eye(75, dtype=torch.float64) - projection(pose=pose)
    generator = torch.Generator().manual_seed(5)
    for _ in range(5):
        step = moves.double() @ (removed @ torch.randn(75, generator=generator, dtype=torch.float64))
        across = step - rays * (step * rays).sum(-1, keepdim=True)
        assert float(across.square().sum() / step.square().sum()) < 0.45
    several = torch.tensor([[0.0, 0.0, 6.0], [6.0, 0.0, 0.0]])
    assert float(projection(several, pose).diagonal().sum()) > 73


def test_corrections_that_follow_images_stay_right_in_depth():
    """Poses that four cameras agreed on, off by a little; one camera's joints then pull on them, with faults."""
    shaped, true = person(), some_pose(0.3)
    numbers = torch.cat([true.flatten(), torch.zeros(3)]).double()
    generator = torch.Generator().manual_seed(2)
    given = numbers + 0.02 * torch.randn(75, generator=generator, dtype=torch.float64)
    target = joints_of(shaped, numbers)
    blur = 0.01 * torch.randn(24, 3, generator=generator, dtype=torch.float64)
    kept = projection(pose=given[:72].reshape(24, 3).float())

    def across(places):
        return places[:, :2] / (6 - places[:, 2:])

    def depth_error(found):
        return float((joints_of(shaped, found) - target)[:, 2].square().mean().sqrt())

    ends, seen = {}, {}
    for name, project in (("free", False), ("observed", True)):
        change = torch.zeros(75, dtype=torch.float64, requires_grad=True)
        optimizer = torch.optim.Adam([change], lr=1e-3)
        for _ in range(100):
            optimizer.zero_grad()
            (across(joints_of(shaped, given + change)) - across(target + blur)).square().sum().backward()
            optimizer.step()
            if project:
                change.data.copy_(kept @ change.data)
        found = given + change.detach()
        ends[name], seen[name] = depth_error(found), float((across(joints_of(shaped, found)) - across(target)).norm())
    assert ends["observed"] <= depth_error(given) < 0.9 * ends["free"]
    # Nothing is lost in the image.
    assert seen["observed"] < 1.3 * seen["free"]


def test_more_cameras_never_see_less():
    cameras = torch.tensor([[0.0, 0.0, 6.0], [3.0, 1.0, 5.0], [-4.0, 0.0, 2.0]])
    seen = [float(projection(cameras[:count]).diagonal().sum()) for count in (1, 2, 3)]
    assert all(b >= a - 1e-6 for a, b in itertools.pairwise(seen))
