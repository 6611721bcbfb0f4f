"""All frames at once are as one frame after the other; what a motion is told by does not matter to its images."""

import math
from dataclasses import replace

import pytest
import torch
from acting import needs_anny, random_motion, the_body, with_numbers
from hypothesis import given
from hypothesis import strategies as st

from twofold.body.skeleton import joint_transforms, pose_body, shape_body, skin
from twofold.geometry.rotations import axis_angle_to_matrix
from twofold.prepare.fitting.body_landmarks import body_points
from twofold.prepare.fitting.parameters import choose, place_joints, place_points, pose_motion

seeds = st.integers(0, 10**6)


def in_double(name="sausages"):
    return with_numbers(the_body(name))


def one_by_one(body, motion):
    """The posed body in each frame, by the plain functions for one pose."""
    shaped = shape_body(body, motion.betas)
    return [pose_body(shaped, pose, shift) for pose, shift in zip(motion.full_pose(), motion.translation, strict=True)]


@pytest.mark.parametrize("name", ["sausages", pytest.param("anny", marks=needs_anny)])
def test_every_frame_is_the_body_in_that_pose(name):
    body = in_double(name)
    motion = replace(random_motion(body, 3, 1, dtype=torch.float64), log_distance=torch.zeros((), dtype=torch.float64))
    posed = pose_motion(body, motion)
    everything = posed.place(choose(body, torch.arange(len(body.template))))
    joints = place_joints(posed, body, motion)
    for time, slow in enumerate(one_by_one(body, motion)):
        torch.testing.assert_close(everything[time], slow.vertices, atol=1e-9, rtol=0)
        torch.testing.assert_close(joints[time], slow.joints, atol=1e-9, rtol=0)


@given(seed=seeds)
def test_landmarks_ride_on_their_joints(seed):
    body = in_double()
    motion = replace(random_motion(body, 3, seed, dtype=torch.float64), log_distance=torch.zeros(()).double())
    points = with_numbers(body_points(the_body()))
    found = place_points(pose_motion(body, motion), points, motion)
    shaped = shape_body(body, motion.betas)
    rest = points.place + points.basis @ motion.betas + motion.marks
    for time, (pose, shift) in enumerate(zip(motion.full_pose(), motion.translation, strict=True)):
        transforms = joint_transforms(shaped.joints, pose, shift)
        slow = torch.cat([skin(rest[k : k + 1], torch.eye(24).double()[j][None], transforms)
                          for k, j in enumerate(points.joint.tolist())])  # fmt: skip
        torch.testing.assert_close(found[time], slow, atol=1e-9, rtol=0)


@given(seed=seeds)
def test_other_vertices_at_each_frame_are_placed_at_that_frame(seed):
    body = in_double()
    posed = pose_motion(body, random_motion(body, 4, seed, dtype=torch.float64))
    everything = posed.place(choose(body, torch.arange(len(body.template))))
    index = torch.randint(len(body.template), (4, 7), generator=torch.Generator().manual_seed(seed))
    some = posed.place(choose(body, index))
    torch.testing.assert_close(some, torch.stack([everything[t, index[t]] for t in range(4)]))


@given(seed=seeds, angle=st.sampled_from([0.0, 1e-6, 1.0, math.pi - 1e-5, math.pi]))
def test_the_full_pose_turns_as_guess_and_turn_together(seed, angle):
    body = in_double()
    motion = random_motion(body, 5, seed, dtype=torch.float64)
    axis = torch.nn.functional.normalize(motion.root + 1e-3, dim=1)
    motion = replace(motion, guess=axis_angle_to_matrix(angle * axis), root=torch.zeros_like(motion.root))
    for turned in (motion, random_motion(body, 5, seed, dtype=torch.float64)):
        full = turned.full_pose()
        expected = axis_angle_to_matrix(turned.root) @ turned.guess
        torch.testing.assert_close(axis_angle_to_matrix(full[:, 0]), expected, atol=1e-6, rtol=0)
        torch.testing.assert_close(full[:, 1:], turned.pose)


@given(seed=seeds)
def test_a_settled_motion_shows_the_same(seed):
    body = in_double()
    motion = random_motion(body, 3, seed, dtype=torch.float64)
    settled = motion.settled(body)
    assert float(motion.log_distance) != 0
    assert float(settled.log_distance) == 0
    everything = choose(body, torch.arange(len(body.template)))
    before, after = (pose_motion(body, m).place(everything) for m in (motion, settled))
    torch.testing.assert_close(after, before)


@given(seed=seeds)
def test_distance_moves_the_root_along_its_ray(seed):
    """The camera of a single clip stands at the origin: the pelvis stays where it is seen, at its factor's distance."""
    body = in_double()
    motion = random_motion(body, 3, seed, dtype=torch.float64)
    near = replace(motion, log_distance=torch.zeros((), dtype=torch.float64))
    before, after = (place_joints(pose_motion(body, m), body, m)[:, 0] for m in (near, motion))
    torch.testing.assert_close(after, before * motion.log_distance.exp())
    turns = [pose_motion(body, m).transforms[..., :3, :3] for m in (near, motion)]
    torch.testing.assert_close(turns[0], turns[1])


def test_parts_of_a_motion_are_the_motion_of_its_parts():
    body = in_double()
    motion = random_motion(body, 6, 0, dtype=torch.float64)
    assert len(motion) == 6
    part = motion[2:5]
    assert len(part) == 3
    joints = [place_joints(pose_motion(body, m), body, m) for m in (motion, part)]
    torch.testing.assert_close(joints[1], joints[0][2:5])


def test_detached_numbers_are_others():
    motion = random_motion(the_body())
    live = replace(motion, pose=motion.pose.clone().requires_grad_())
    apart = live.detached()
    assert not apart.pose.requires_grad
    apart.pose.zero_()
    assert live.pose.any()
