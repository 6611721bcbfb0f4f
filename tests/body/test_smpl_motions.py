import dataclasses

import numpy as np
import pytest
import torch
from motion_rigs import stick_body
from scipy.spatial.transform import Rotation
from test_foot_contacts import slide_of_standing_feet

from twofold.body.builtin_motions import BUILTIN_MOTIONS
from twofold.body.motion import UP_AXES, joint_frames, turned_upright
from twofold.body.skeleton import Body
from twofold.body.smpl_motions import SMPL_LEG, read_smpl_motion
from twofold.errors import TwofoldError

SMPL_SIZED = stick_body(size=SMPL_LEG / 0.7937)
"""A body with the legs that a file's unknown body is taken to have."""

MOVED = BUILTIN_MOTIONS["dance"](SMPL_SIZED)
MOVED = dataclasses.replace(MOVED, poses=MOVED.poses[:60].float(), translations=MOVED.translations[:60].float())
POSES, TRANS = MOVED.poses.numpy(), MOVED.translations.numpy()
IN_Z_UP = np.array(UP_AXES["z"]).T
PELVIS = SMPL_SIZED.joints[0].numpy()


def z_up():
    """Poses (T, 72) and translations of the same motion in AMASS's world."""
    roots = Rotation.from_matrix(IN_Z_UP @ Rotation.from_rotvec(POSES[:, 0]).as_matrix()).as_rotvec()
    poses = np.concatenate([roots[:, None], POSES[:, 1:]], 1).reshape(len(POSES), 72)
    return poses, (TRANS + PELVIS) @ IN_Z_UP.T - PELVIS


def amass_h():
    poses, trans = z_up()
    fingers = np.random.default_rng(0).normal(size=(len(poses), 90))
    return {
        "poses": np.concatenate([poses[:, :66], fingers], 1), "trans": trans, "betas": np.zeros(16),
        "dmpls": np.zeros((len(poses), 8)), "gender": np.array("female"), "mocap_framerate": np.array(120.0),
    }  # fmt: skip


def amass_x(split=False):
    poses, trans = z_up()
    rest = np.random.default_rng(0).normal(size=(len(poses), 99))
    arrays = {
        "trans": trans, "betas": np.zeros(16), "gender": np.array("neutral"), "surface_model_type": np.array("smplx"),
        "mocap_frame_rate": np.array(120.0), "markers_latent": np.zeros((40, 3)), "num_betas": np.array(16),
        "labels": np.array([["LFHD", None]], dtype=object),
    }  # fmt: skip
    if split:
        return arrays | {"root_orient": poses[:, :3], "pose_body": poses[:, 3:66], "pose_hand": rest[:, :90]}
    return arrays | {"poses": np.concatenate([poses[:, :66], rest], 1)}


FLAT = POSES.reshape(-1, 72)
MATRICES = Rotation.from_rotvec(POSES.reshape(-1, 3)).as_matrix().reshape(-1, 24, 3, 3)
FILES = {
    "flat": ({"poses": FLAT, "trans": TRANS, "betas": np.zeros(10), "fps": 50}, "SMPL", "y", 50),
    "24x3": ({"poses": POSES, "trans": TRANS, "mocap_framerate": 50.0}, "SMPL", "y", 50),
    "matrices": ({"poses": MATRICES, "transl": TRANS, "fps": 50.0}, "SMPL", "y", 50),
    "flat matrices": ({"poses": MATRICES.reshape(-1, 24, 9), "trans": TRANS}, "SMPL", "y", 30),
    "body alone": ({"poses": FLAT[:, :66], "trans": TRANS}, "SMPL", "y", 30),
    "split": ({"global_orient": FLAT[:, :3], "body_pose": FLAT[:, 3:], "transl": TRANS}, "SMPL", "y", 30),
    "AIST++": ({"smpl_poses": FLAT, "smpl_trans": TRANS * 90, "smpl_scaling": [90.0]}, "AIST++", "y", 60),
    "AMASS SMPL+H": (amass_h(), "AMASS SMPL+H", "z", 120),
    "AMASS SMPL-X": (amass_x(), "AMASS SMPL-X (stage II)", "z", 120),
    "AMASS SMPL-X in parts": (amass_x(True), "AMASS SMPL-X (stage II)", "z", 120),
    "capture": ({"poses": POSES, "translations": TRANS, "betas": np.zeros(10)}, "capture", "y", 30),
}


def saved(tmp_path, arrays):
    path = tmp_path / "motion.npz"
    np.savez(path, **{name: np.asarray(value) for name, value in arrays.items()})
    return path


@pytest.mark.parametrize("kind", FILES)
def test_each_format_gives_the_same_motion(tmp_path, kind):
    arrays, name, up, fps = FILES[kind]
    found = read_smpl_motion(saved(tmp_path, arrays), SMPL_SIZED)
    assert (found.layout, found.up, found.frames, found.motion.fps) == (name, up, 60, fps)
    ours, expected = (joint_frames(SMPL_SIZED.joints, m)[1][:, :22] for m in (found.motion, MOVED))
    torch.testing.assert_close(ours, expected, atol=0.012, rtol=0)


def test_hands_of_other_bodies_stay_at_rest(tmp_path):
    motion = read_smpl_motion(saved(tmp_path, amass_h()), SMPL_SIZED).motion
    assert motion.poses[:, 22:].abs().max() == 0


def test_cameras_worlds_with_y_down_are_turned_upright(tmp_path):
    down = turned_upright(MOVED, "-y", SMPL_SIZED.joints[0])
    path = saved(tmp_path, {"poses": down.poses, "trans": down.translations})
    found = read_smpl_motion(path, SMPL_SIZED)
    assert found.up == "-y"
    ours, expected = (joint_frames(SMPL_SIZED.joints, m)[1] for m in (found.motion, MOVED))
    torch.testing.assert_close(ours, expected, atol=0.012, rtol=0)


def test_centimetres_are_metres_times_a_hundred(tmp_path):
    # The pelvis's rest place is the body's, so only translations that leave it out of account scale exactly.
    path = saved(tmp_path, {"poses": FLAT, "trans": 100 * TRANS})
    found = read_smpl_motion(path, SMPL_SIZED, units="cm")
    assert found.units == "centimetres"
    torch.testing.assert_close(found.motion.translations.float(), MOVED.translations, atol=0.012, rtol=0)


@pytest.mark.parametrize("name", ["walk", "turn", "range-of-motion"])
def test_feet_stay_where_they_stand_on_other_legs(tmp_path, name):
    body = stick_body(thigh=0.95, shin=1.05, hips=1.1, size=1.1)
    motion = BUILTIN_MOTIONS[name](SMPL_SIZED)
    path = saved(tmp_path, {"poses": motion.poses.numpy(), "trans": motion.translations.numpy(), "fps": 30.0})
    found = read_smpl_motion(path, body)
    assert slide_of_standing_feet(SMPL_SIZED, motion, body, found.motion) < 0.01


def test_betas_of_an_smpl_body_tell_whose_legs_moved(tmp_path):
    joints = SMPL_SIZED.joints
    longer = torch.zeros(24, 3, 1)
    longer[[4, 5, 7, 8, 10, 11], 1, 0] = torch.tensor([-0.1, -0.1, -0.2, -0.2, -0.2, -0.2])
    vertices = SMPL_SIZED.vertices
    model = Body(
        "smpl", vertices, SMPL_SIZED.faces, SMPL_SIZED.weights, joints,
        torch.zeros(len(vertices), 3, 1), longer, SMPL_SIZED.pose_basis,
    )  # fmt: skip
    arrays = {"poses": FLAT, "trans": TRANS}
    own = read_smpl_motion(saved(tmp_path, arrays | {"betas": np.zeros(1)}), SMPL_SIZED, model).motion
    other = read_smpl_motion(saved(tmp_path, arrays | {"betas": np.ones(1)}), SMPL_SIZED, model).motion
    reach = [float(np.ptp(m.translations[:, 0].numpy())) for m in (own, other)]
    assert reach[1] / reach[0] == pytest.approx(0.78 / 0.98, abs=0.02)


def test_without_translations_the_body_stands_on_the_floor(tmp_path):
    found = read_smpl_motion(saved(tmp_path, {"poses": FLAT}), SMPL_SIZED)
    assert any("no translations" in note for note in found.notes)
    _, positions = joint_frames(SMPL_SIZED.joints, found.motion)
    lowest = positions[:, [10, 11], 1].amin(1) - (SMPL_SIZED.joints[10, 1] - SMPL_SIZED.vertices[:, 1].min())
    assert lowest.abs().max() < 1e-5


BAD = np.full_like(FLAT, np.nan)
FAULTS = {
    "degrees": ({"poses": np.degrees(FLAT), "trans": TRANS}, "look like degrees"),
    "centimetres": ({"poses": FLAT, "trans": TRANS * 100}, "give --units cm"),
    "joint count": ({"poses": FLAT[:, :63], "trans": TRANS}, "63 numbers a frame"),
    "joint count of SMPL-X": ({"poses": POSES[:, :17], "trans": TRANS}, "51 numbers a frame"),
    "NaN": ({"poses": np.concatenate([FLAT[:7], BAD]), "trans": TRANS}, "NaN or infinity in frame 7"),
    "infinite path": ({"poses": FLAT, "trans": TRANS + np.inf}, "trans .* in frame 0"),
    "lengths": ({"poses": FLAT, "trans": TRANS[:-1]}, r"shape \(60, 3\)"),
    "no frames": ({"poses": FLAT[:0], "trans": TRANS[:0]}, "0 numbers a frame"),
    "no matrices": ({"poses": 2 * MATRICES, "trans": TRANS}, "rotation matrices"),
    "mirrored": ({"poses": -MATRICES, "trans": TRANS}, "rotation matrices"),
    "rate": ({"poses": FLAT, "trans": TRANS, "fps": 0.0}, "frames per second"),
    "shape.npz": ({"betas": np.zeros(16), "gender": "male"}, "holds no motion"),
    "text": ({"poses": np.full((60, 72), "a"), "trans": TRANS}, "should be numbers"),
    "objects": ({"poses": np.array([[1, None]], dtype=object), "trans": TRANS}, "holds Python objects"),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_what_is_wrong_is_said_in_one_sentence(tmp_path, fault):
    arrays, words = FAULTS[fault]
    with pytest.raises(TwofoldError, match=words) as caught:
        read_smpl_motion(saved(tmp_path, arrays), SMPL_SIZED)
    assert "motion.npz" in str(caught.value)


def test_metres_called_centimetres_are_refused(tmp_path):
    still = {"poses": FLAT, "trans": TRANS * 0.01 - PELVIS * 100}
    with pytest.raises(TwofoldError, match="leave --units out"):
        read_smpl_motion(saved(tmp_path, still), SMPL_SIZED, units="cm")


@pytest.mark.parametrize("content", [b"", b"PK\x03\x04 cut short", b"hello"])
def test_damaged_files_are_said(tmp_path, content):
    (tmp_path / "motion.npz").write_bytes(content)
    with pytest.raises(TwofoldError, match="damaged or no npz"):
        read_smpl_motion(tmp_path / "motion.npz", SMPL_SIZED)


def test_single_arrays_and_missing_files_are_said(tmp_path):
    with (tmp_path / "motion.npz").open("wb") as file:
        np.save(file, FLAT)
    with pytest.raises(TwofoldError, match="single array"):
        read_smpl_motion(tmp_path / "motion.npz", SMPL_SIZED)
    with pytest.raises(TwofoldError, match="missing"):
        read_smpl_motion(tmp_path / "other.npz", SMPL_SIZED)


def test_frames_of_a_capture_that_were_taken_at_a_varying_rate_are_resampled(tmp_path):
    seconds = np.cumsum([0.0, *np.tile([0.1, 0.3], 30)[:59]])
    found = read_smpl_motion(saved(tmp_path, FILES["capture"][0] | {"seconds": seconds}), SMPL_SIZED)
    assert found.motion.fps == pytest.approx(59 / seconds[-1])
    assert any("varying rate" in note for note in found.notes)
    assert not any("no frame rate" in note for note in found.notes)
    even = np.interp(np.linspace(0, seconds[-1], 60), seconds, np.arange(60))
    whole = read_smpl_motion(saved(tmp_path, FILES["capture"][0]), SMPL_SIZED).motion.translations.numpy()
    expected = np.stack([np.interp(even, np.arange(60), whole[:, axis]) for axis in range(3)], 1)
    np.testing.assert_allclose(found.motion.translations.numpy(), expected, atol=1e-6)
    with pytest.raises(TwofoldError, match="seconds should be 60 increasing numbers"):
        read_smpl_motion(saved(tmp_path, FILES["capture"][0] | {"seconds": seconds[::-1]}), SMPL_SIZED)
