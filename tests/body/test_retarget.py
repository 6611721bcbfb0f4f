"""The way from a body's own rest pose to the T-pose, on a synthetic body and on real fits."""

import os
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from twofold.body.retarget import convert_pose, straighten
from twofold.body.skeleton import JOINT_NAMES, PARENTS, joint_transforms, skin
from twofold.geometry.rotations import axis_angle_to_matrix

REAL = Path(os.environ.get("TWOFOLD_PREPARED", Path(__file__).parents[3] / "shared" / "data" / "capture"))

# An upright body with its arms hanging at an angle and its elbows and knees a little bent (left side, then mirrored).
LEFT = {
    "hip": (0.1, -0.09, 0), "knee": (0.14, -0.5, 0.03), "ankle": (0.16, -0.92, -0.02), "foot": (0.17, -0.98, 0.12),
    "collar": (0.03, 0.42, 0), "shoulder": (0.17, 0.45, -0.02), "elbow": (0.36, 0.26, -0.04),
    "wrist": (0.5, 0.1, 0.08), "hand": (0.55, 0.04, 0.13),
}  # fmt: skip
MIDDLE = {"pelvis": (0, 0, 0), "spine1": (0, 0.1, 0), "spine2": (0, 0.2, 0), "spine3": (0, 0.3, 0),
          "neck": (0, 0.5, 0), "head": (0, 0.6, 0.02)}  # fmt: skip
QUARTER_TURNS = {
    "y up": [[1, 0, 0], [0, 1, 0], [0, 0, 1]],
    "z up, facing -y": [[1, 0, 0], [0, 0, -1], [0, 1, 0]],
    "y down, facing -z": [[1, 0, 0], [0, -1, 0], [0, 0, -1]],
    "y up, facing x": [[0, 0, 1], [0, 1, 0], [-1, 0, 0]],
}


def made_up_joints():
    places = dict(MIDDLE)
    for name, (x, y, z) in LEFT.items():
        places |= {f"left_{name}": (x, y, z), f"right_{name}": (-x, y, z)}
    return torch.tensor([places[name] for name in JOINT_NAMES], dtype=torch.float64)


def vertices_on_joints(joints, seed=0):
    """Points near each joint that move with it alone."""
    random = np.random.default_rng(seed)
    near = torch.from_numpy(random.normal(size=(24, 5, 3)) * 0.05) + joints[:, None]
    return near.flatten(0, 1), torch.eye(24, dtype=torch.float64).repeat_interleave(5, 0)


def straightened(joints):
    vertices, weights = vertices_on_joints(joints)
    return straighten(vertices, joints, weights)


def mirrored(name):
    side, _, part = name.partition("_")
    return {"left": f"right_{part}", "right": f"left_{part}"}.get(side, name)


def posed(joints, vertices, weights, pose, shift):
    transforms = joint_transforms(joints, pose, shift)
    moved = (transforms[:, :3, :3] @ joints[:, :, None])[..., 0] + transforms[:, :3, 3]
    return moved, skin(vertices, weights, transforms)


def direction(joints, start, end):
    vector = joints[JOINT_NAMES.index(end)] - joints[JOINT_NAMES.index(start)]
    return vector / vector.norm()


@pytest.mark.parametrize("axes", QUARTER_TURNS.values(), ids=QUARTER_TURNS)
def test_limbs_end_up_level_and_straight_whichever_axis_was_up(axes):
    joints = made_up_joints() @ torch.tensor(axes, dtype=torch.float64).T
    _, t_joints, _ = straightened(joints)
    for side, x in (("left", 1.0), ("right", -1.0)):
        for start, end in (("shoulder", "elbow"), ("elbow", "wrist"), ("wrist", "hand")):
            assert direction(t_joints, f"{side}_{start}", f"{side}_{end}")[0] * x > 0.98
        for start, end in (("hip", "knee"), ("knee", "ankle")):
            assert direction(t_joints, f"{side}_{start}", f"{side}_{end}")[1] < -0.99
        assert direction(t_joints, f"{side}_ankle", f"{side}_foot")[2] > 0.8
    assert direction(t_joints, "pelvis", "neck")[1] > 0.99


def test_trunk_and_feet_keep_their_orientation_and_bones_their_length():
    joints = made_up_joints()
    _, t_joints, turns = straightened(joints)
    kept = [j for j, name in enumerate(JOINT_NAMES) if name in MIDDLE or name.endswith(("collar", "ankle", "foot"))]
    torch.testing.assert_close(turns[kept], torch.eye(3, dtype=torch.float64).expand(len(kept), 3, 3))
    parents = list(PARENTS[1:])
    lengths = (t_joints[1:] - t_joints[parents]).norm(dim=1)
    torch.testing.assert_close(lengths, (joints[1:] - joints[parents]).norm(dim=1))


def test_straightening_twice_changes_nothing():
    joints = made_up_joints()
    vertices, weights = vertices_on_joints(joints)
    once, once_joints, _ = straighten(vertices, joints, weights)
    twice, twice_joints, turns = straighten(once, once_joints, weights)
    torch.testing.assert_close(twice, once)
    torch.testing.assert_close(twice_joints, once_joints)
    torch.testing.assert_close(turns, torch.eye(3, dtype=torch.float64).expand(24, 3, 3), atol=1e-7, rtol=0)


def test_a_mirrored_body_gives_the_mirrored_result():
    joints = made_up_joints()
    _, t_joints, _ = straightened(joints)
    mirror = torch.tensor([-1.0, 1, 1], dtype=torch.float64)
    other = [JOINT_NAMES.index(mirrored(name)) for name in JOINT_NAMES]
    torch.testing.assert_close(t_joints[other] * mirror, t_joints)


@settings(max_examples=10)
@given(st.integers(0, 2**31), st.sampled_from(list(QUARTER_TURNS.values())))
def test_a_converted_pose_puts_joints_and_rigid_points_where_they_were(seed, axes):
    random = np.random.default_rng(seed)
    joints = made_up_joints() @ torch.tensor(axes, dtype=torch.float64).T
    vertices, weights = vertices_on_joints(joints, seed)
    pose, shift = torch.from_numpy(random.normal(size=(24, 3))), torch.from_numpy(random.normal(size=3))
    t_vertices, t_joints, turns = straighten(vertices, joints, weights)
    before = posed(joints, vertices, weights, pose, shift)
    after = posed(t_joints, t_vertices, weights, convert_pose(pose, turns), shift)
    torch.testing.assert_close(after, before, atol=1e-9, rtol=0)


def test_poses_are_converted_frame_by_frame():
    joints = made_up_joints()
    _, _, turns = straightened(joints)
    poses = torch.from_numpy(np.random.default_rng(0).normal(size=(4, 24, 3)))
    converted = convert_pose(poses, turns)
    for pose, one in zip(poses, converted, strict=True):
        torch.testing.assert_close(axis_angle_to_matrix(convert_pose(pose, turns)), axis_angle_to_matrix(one))


@pytest.mark.parametrize("name", ["p2s_cam01", "sam2_juggle"])
def test_real_fits_stay_where_they_were(name):
    if not (REAL / name / "capture.npz").is_file():
        pytest.skip(f"the prepared capture {name} is not at {REAL} (set TWOFOLD_PREPARED)")
    with np.load(REAL / name / "capture.npz") as file:
        vertices, joints, weights, poses, shifts = (
            torch.from_numpy(file[key]).double()
            for key in ("rest_vertices", "rest_joints", "weights", "poses", "transl")
        )
    t_vertices, t_joints, turns = straighten(vertices, joints, weights)
    for pose, shift in list(zip(poses, shifts, strict=True))[::9]:
        joints_before, skin_before = posed(joints, vertices, weights, pose, shift)
        joints_after, skin_after = posed(t_joints, t_vertices, weights, convert_pose(pose, turns), shift)
        assert (joints_after - joints_before).norm(dim=1).max() < 1e-4
        # Where joints blend, the skin of two chains of rotations differs from that of their product.
        assert (skin_after - skin_before).norm(dim=1).mean() < 0.01
