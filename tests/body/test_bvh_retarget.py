import dataclasses

import pytest
import torch
from motion_rigs import bvh_of, rigs, stick_body
from test_foot_contacts import slide_of_standing_feet

from twofold.body.builtin_motions import BUILTIN_MOTIONS
from twofold.body.bvh import Bvh
from twofold.body.bvh_retarget import retarget
from twofold.body.motion import joint_frames
from twofold.body.skeleton import JOINT_NAMES

SOURCE = stick_body(size=1.07)
FAMILIES = list(rigs(SOURCE.joints.double()))
MOVED = BUILTIN_MOTIONS["dance"](SOURCE)
MOVED = dataclasses.replace(MOVED, poses=MOVED.poses[:90], translations=MOVED.translations[:90])
WALKED = BUILTIN_MOTIONS["walk"](SOURCE)
BONES = [("left_hip", "left_knee"), ("left_knee", "left_ankle"), ("left_shoulder", "left_elbow")]
BONES += [("left_elbow", "left_wrist")]
BONES += [(a.replace("left", "right"), b.replace("left", "right")) for a, b in BONES]


def played(family, body, motion=MOVED):
    joints = SOURCE.joints.double()
    made, values = bvh_of(rigs(joints)[family], joints, motion)
    return retarget(Bvh(made, torch.from_numpy(values), motion.fps), body, f"{family}.bvh")


def limbs(joints, motion):
    _, positions = joint_frames(joints, motion)
    starts, ends = ([JOINT_NAMES.index(bone[k]) for bone in BONES] for k in (0, 1))
    return torch.nn.functional.normalize(positions[:, ends] - positions[:, starts], dim=-1)


def degrees(a, b):
    return torch.linalg.cross(a, b).norm(dim=-1).clamp(0, 1).asin().rad2deg().max()


@pytest.mark.parametrize("family", FAMILIES)
@pytest.mark.parametrize("motion", [MOVED, WALKED], ids=["dance", "walk"])
def test_limbs_point_as_in_the_file_on_a_body_with_other_legs(family, motion):
    body = stick_body(thigh=0.96, shin=1.03, hips=0.95, size=0.93)
    result = played(family, body, motion)
    assert degrees(limbs(body.joints, result.motion), limbs(SOURCE.joints, motion)) < 5
    assert result.error < 5


@pytest.mark.parametrize("family", FAMILIES)
@pytest.mark.parametrize("motion", [MOVED, WALKED], ids=["dance", "walk"])
def test_feet_that_stand_slide_less_than_a_centimetre_on_other_legs(family, motion):
    body = stick_body(thigh=0.9, shin=1.05, hips=0.9, size=0.9)
    result = played(family, body, motion)
    assert slide_of_standing_feet(SOURCE, motion, body, result.motion) < 0.01
    _, positions = joint_frames(body.joints, result.motion)
    lowest = positions[:, [10, 11], 1].min() - (body.joints[10, 1] - body.vertices[:, 1].min())
    assert abs(float(lowest)) < 0.005


@pytest.mark.parametrize("family", FAMILIES)
def test_a_body_like_the_source_moves_as_the_source(family):
    result = played(family, SOURCE)
    assert degrees(limbs(SOURCE.joints, result.motion), limbs(SOURCE.joints, MOVED)) < 1
    _, ours = joint_frames(SOURCE.joints, result.motion)
    _, expected = joint_frames(SOURCE.joints, MOVED)
    assert (ours - expected)[:, [0, 4, 7, 12, 20, 21]].norm(dim=-1).max() < 0.03


@pytest.mark.parametrize("family", FAMILIES)
def test_joints_turn_about_their_bones_as_the_source_does(family):
    result = played(family, SOURCE)
    ours, _ = joint_frames(SOURCE.joints, result.motion)
    expected, _ = joint_frames(SOURCE.joints, MOVED)
    names = ["pelvis", "spine1", "spine2", "left_hip", "right_knee", "left_ankle", "right_shoulder", "left_elbow"]
    checked = [JOINT_NAMES.index(name) for name in names]
    change = ours[:, checked].transpose(-1, -2) @ expected[:, checked]
    cosines = (change.diagonal(dim1=-2, dim2=-1).sum(-1) - 1) / 2
    assert cosines.clamp(-1, 1).acos().rad2deg().max() < 20


def test_what_was_found_is_reported():
    assert played("cmu", SOURCE).reference.startswith("frame 0, a T-pose")
    assert len(played("cmu", SOURCE).motion) == len(MOVED)
    assert played("mixamo", SOURCE).reference == "the pose of all zeros"
    assert played("lafan1", SOURCE).reference.startswith("bones and bending axes")
    assert played("mixamo-z-up", SOURCE).up == "z"
    assert played("mixamo", SOURCE).up == "y"
    assert played("mixamo", SOURCE).leg == pytest.approx(85, abs=3)
