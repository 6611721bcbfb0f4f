import numpy as np
import pytest
import torch
from motion_rigs import bvh_of, bvh_text, rigs, stick_joints
from scipy.spatial.transform import Rotation
from test_motion import random_motion

from twofold.body.bvh import Bvh, BvhJoint, bvh_frames, read_bvh, write_bvh
from twofold.body.motion import Motion, joint_frames
from twofold.body.skeleton import JOINT_NAMES
from twofold.errors import TwofoldError

JOINTS = stick_joints()
SMALL = """HIERARCHY
ROOT Hips
{
  OFFSET 0 0 0
  CHANNELS 6 Xposition Yposition Zposition Zrotation Xrotation Yrotation
  JOINT Chest
  {
    OFFSET 0 5 0
    CHANNELS 3 Zrotation Xrotation Yrotation
    End Site
    {
      OFFSET 0 2 0
    }
  }
}
MOTION
Frames: 2
Frame Time: 0.0333333
1 2 3 10 20 30 40 50 60
1 2 3 11 21 31 41 51 61
"""


def saved(tmp_path, text):
    path = tmp_path / "motion.bvh"
    path.write_bytes(text.encode())
    return path


@pytest.mark.parametrize("units", ["m", "cm"])
def test_what_is_written_is_read_back(tmp_path, units):
    motion = random_motion(1, 5, 24.0)
    for frame, quarter in enumerate((90, -90)):  # where the angles of Rz Rx Ry are not unique
        turned = Rotation.from_euler("ZXY", [40, quarter, 25], degrees=True)
        motion.poses[frame, 4] = torch.from_numpy(turned.as_rotvec())
    motion.poses[2] = 0
    path = tmp_path / "own.bvh"
    write_bvh(path, JOINTS, motion, units=units)
    bvh = read_bvh(path)
    ours = [k for k, joint in enumerate(bvh.joints) if not joint.name.endswith(" end")]
    order = [JOINT_NAMES.index(bvh.joints[k].name) for k in ours]
    rotations, positions = bvh_frames(bvh.joints, bvh.values)
    expected, places = joint_frames(JOINTS, motion)
    assert sorted(order) == list(range(24))
    assert bvh.fps == pytest.approx(24)
    torch.testing.assert_close(rotations[:, ours], expected[:, order], atol=1e-7, rtol=0)
    scale = {"m": 1, "cm": 100}[units]
    torch.testing.assert_close(positions[:, ours] / scale, places[:, order], atol=1e-6, rtol=0)


def test_another_rigs_names_are_written(tmp_path):
    write_bvh(tmp_path / "own.bvh", JOINTS, random_motion(), [f"Bone{k}" for k in range(24)])
    assert {j.name for j in read_bvh(tmp_path / "own.bvh").joints} >= {f"Bone{k}" for k in range(24)}


@pytest.mark.parametrize("order", ["XYZ", "XZY", "YXZ", "YZX", "ZXY", "ZYX"])
def test_rotations_are_multiplied_in_the_order_of_their_channels(order):
    channels = tuple(f"{axis}rotation" for axis in order)
    joints = (BvhJoint("Hips", -1, (1.0, 2.0, 3.0), channels), BvhJoint("Hips end", 0, (0.0, 1.0, 0.0), ()))
    values = torch.tensor([[20.0, -50.0, 130.0]], dtype=torch.float64)
    rotations, positions = bvh_frames(joints, values)
    expected = Rotation.from_euler(order, values[0].numpy(), degrees=True)
    np.testing.assert_allclose(rotations[0, 0], expected.as_matrix(), atol=1e-12)
    np.testing.assert_allclose(positions[0, 1], np.array([1, 2, 3]) + expected.apply([0, 1, 0]))


def literal_frames(bvh: Bvh, frame):
    """One frame by 4x4 matrices, joint by joint, as the format is described."""
    column, worlds = 0, []
    for joint in bvh.joints:
        local = np.eye(4)
        local[:3, 3] = joint.offset
        for channel in joint.channels:
            value = float(bvh.values[frame, column])
            column += 1
            if channel[1:] == "position":
                local["XYZ".index(channel[0]), 3] = value
                continue
            turn = np.eye(4)
            turn[:3, :3] = Rotation.from_euler(channel[0].lower(), value, degrees=True).as_matrix()
            local = local @ turn
        worlds.append(local if joint.parent < 0 else worlds[joint.parent] @ local)
    return np.stack(worlds)


@pytest.mark.parametrize("family", ["cmu", "lafan1", "3ds-max", "mixamo-z-up"])
def test_forward_kinematics_agree_with_matrices_multiplied_one_by_one(tmp_path, family):
    joints, values = bvh_of(rigs(JOINTS)[family], JOINTS, random_motion(2, 3))
    bvh = read_bvh(saved(tmp_path, bvh_text(joints, values, 30)))
    rotations, positions = bvh_frames(bvh.joints, bvh.values)
    for frame in range(3):
        expected = literal_frames(bvh, frame)
        np.testing.assert_allclose(rotations[frame], expected[:, :3, :3], atol=1e-9)
        np.testing.assert_allclose(positions[frame], expected[:, :3, 3], atol=1e-6)


def test_a_small_file_is_read_as_it_is(tmp_path):
    bvh = read_bvh(saved(tmp_path, SMALL))
    assert [j.name for j in bvh.joints] == ["Hips", "Chest", "Chest end"]
    assert bvh.joints[1].offset == (0, 5, 0)
    assert bvh.values.shape == (2, 9)
    assert bvh.fps == pytest.approx(30, abs=1e-3)


def test_line_ends_tabs_and_capitals_do_not_matter(tmp_path):
    text = SMALL.replace("\n", "\r\n").replace("Frames: ", "FRAMES:\t").replace("  ", "\t").replace("JOINT", "Joint")
    other = read_bvh(saved(tmp_path, text.replace("Zrotation", "ZROTATION")))
    first = read_bvh(saved(tmp_path, SMALL))
    assert other.joints == first.joints
    assert torch.equal(other.values, first.values)


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("HIERARCHY", "PEOPLE", "HIERARCHY and a MOTION"),
        ("MOTION", "", "HIERARCHY and a MOTION"),
        ("OFFSET 0 5 0", "OFFSET 0 nan 0", "line 8.*'nan'"),
        ("Zrotation Xrotation Yrotation\n    End", "Zrotation Wrotation Yrotation\n    End", "line 9.*'Wrotation'"),
        ("OFFSET 0 2 0\n    }", "OFFSET 0 2 0", "never closed"),
        ("    End Site", "    Ending", "line 10.*'Ending'"),
        ("Frames: 2", "Frames: 3", "3 frames of 9 numbers"),
        ("Frames: 2", "Frames: none", "at least one frame"),
        ("0.0333333", "33.3", "Frame Time"),
        ("41 51 61", "41 51 nan", r"Frame 1 .* nan"),
        ("41 51 61", "41 51 1e300", r"Frame 1 .*1e\+300"),
        ("CHANNELS 3", "CHANNELS -5", "0 to 6 CHANNELS"),
        ("CHANNELS 3", "CHANNELS 1e300", "line 9.*at most"),
        ("41 51 61", "41 51 six", "no number"),
        ("41 51 61", "", "holds 15 numbers"),
        ("Frame Time:", "Rate:", "Frame Time:"),
    ],
)
def test_what_is_wrong_with_a_file_is_said_in_one_sentence(tmp_path, old, new, words):
    assert old in SMALL
    with pytest.raises(TwofoldError, match=words) as caught:
        read_bvh(saved(tmp_path, SMALL.replace(old, new)))
    assert "motion.bvh" in str(caught.value)


def test_a_missing_file_and_a_folder_are_said(tmp_path):
    for path, words in ((tmp_path / "none.bvh", "is missing"), (tmp_path, "is a folder")):
        with pytest.raises(TwofoldError, match=words):
            read_bvh(path)


def test_nothing_is_left_of_a_file_that_cannot_be_written(tmp_path):
    motion = Motion("m", torch.zeros(1, 24, 3), torch.zeros(1, 3), 30.0)
    with pytest.raises(TwofoldError, match="Cannot write"):
        write_bvh(tmp_path / "missing" / "own.bvh", JOINTS, motion)
    assert not list(tmp_path.iterdir())
