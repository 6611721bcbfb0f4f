import numpy as np
import pytest
import torch
from motion_rigs import bvh_of, bvh_text, rigs, stick_body

from twofold.body.builtin_motions import BUILTIN_MOTIONS
from twofold.body.bvh import write_bvh
from twofold.body.motion import joint_frames
from twofold.body.motion_files import READERS, MotionOptions, read_motion
from twofold.errors import TwofoldError

BODY = stick_body()
MOVED = BUILTIN_MOTIONS["walk"](BODY)


def saved(tmp_path, family="mixamo"):
    path = tmp_path / f"{family}.bvh"
    path.write_text(bvh_text(*bvh_of(rigs(BODY.joints.double())[family], BODY.joints.double(), MOVED), MOVED.fps))
    return path


@pytest.mark.parametrize("name", BUILTIN_MOTIONS)
def test_motions_without_a_file_are_read_by_name(name):
    read = read_motion(name, BODY)
    assert read.format == f"built-in motion {name!r}"
    assert len(read.motion) == read.frames
    assert read.motion.poses.dtype == read.motion.translations.dtype == torch.float32


@pytest.mark.parametrize(
    ("family", "units"),
    [("mixamo", "centimetres"), ("mixamo-z-up", "metres"), ("cmu", "CMU units"), ("3ds-max", "inches")],
)
def test_units_are_told_by_the_length_of_the_legs(tmp_path, family, units):
    read = read_motion(saved(tmp_path, family), BODY)
    assert read.units.startswith(units)
    assert any("legs of 0.79 m" in note for note in read.notes)


def test_everything_that_was_found_is_reported(tmp_path):
    lines = read_motion(saved(tmp_path, "mixamo-z-up"), BODY).lines()
    assert lines[:4] == ["format: BVH", "frames: 130 at 30 fps (4.30 s)", "up axis: z", "units: metres"]
    assert any(line.startswith("note: limbs point as in the file within") for line in lines)


def test_own_files_come_back_as_they_were(tmp_path):
    write_bvh(tmp_path / "own.bvh", BODY.joints, MOVED)
    again = read_motion(tmp_path / "own.bvh", BODY).motion
    ours, expected = (joint_frames(BODY.joints, m) for m in (again, MOVED))
    torch.testing.assert_close(ours[0], expected[0], atol=0.01, rtol=0)
    torch.testing.assert_close(ours[1], expected[1], atol=0.003, rtol=0)


def test_options_change_rate_and_place(tmp_path):
    read = read_motion(saved(tmp_path), BODY, MotionOptions(fps=15.0, start_at_origin=True))
    assert (read.fps, read.frames) == (pytest.approx(30), 130)
    assert (read.motion.fps, len(read.motion)) == (15, 65)
    start = read.motion.translations[0] + BODY.joints[0]
    assert start[[0, 2]].abs().max() < 1e-6


def test_another_up_axis_is_believed(tmp_path):
    read = read_motion(saved(tmp_path), BODY, MotionOptions(up="z"))
    assert read.up == "z"
    _, positions = joint_frames(BODY.joints, read.motion)
    assert np.ptp(positions[0, :, 1].numpy()) < np.ptp(positions[0, :, 2].numpy())


def test_units_that_make_giants_are_refused(tmp_path):
    with pytest.raises(TwofoldError, match=r"79.* m long, expected about 0\.8"):
        read_motion(saved(tmp_path), BODY, MotionOptions(units="m"))


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("motion.pt", "PyTorch file.*np.savez"),
        ("motion.pkl", "pickle.*np.savez"),
        ("motion.fbx", "not read.*convert it to BVH"),
        ("motion.npy", "single array.*np.savez"),
        ("motion.txt", "not read"),
    ],
)
def test_formats_that_are_not_read_are_refused_unopened_with_advice(tmp_path, name, words):
    (tmp_path / name).write_bytes(b"cos\nsystem\n(S'false'\ntR.")
    with pytest.raises(TwofoldError, match=words):
        read_motion(tmp_path / name, BODY)


def test_what_is_neither_a_file_nor_a_name_is_said(tmp_path):
    with pytest.raises(TwofoldError, match=r"neither a file nor a built-in motion.*walk, turn, dance"):
        read_motion("wlak", BODY)
    with pytest.raises(TwofoldError, match="neither a file"):
        read_motion("walk" * 2000, BODY)
    with pytest.raises(TwofoldError, match="is a folder"):
        read_motion(tmp_path, BODY)


def test_every_reader_is_one_of_a_file_ending():
    assert all(ending.startswith(".") and ending == ending.lower() for ending in READERS)
