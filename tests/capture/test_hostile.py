"""Captures that ask for endless time or memory, or hold what no capture holds."""

import json
import os
import time

import numpy as np
import pytest

from twofold.capture.folder import CaptureWriter, read_capture
from twofold.capture.layout import spans
from twofold.capture.validate import read_mesh, validate
from twofold.errors import TwofoldError


def only(faults):
    assert len(faults) == 1, faults
    assert faults[0].endswith(".")
    assert len(faults[0]) < 700
    return faults[0]


@pytest.mark.parametrize(
    ("edit", "sentence"),
    [
        (lambda d: d.update(fps=10**9), "up to 100000; it is 1000000000"),
        (lambda d: d.update(fps=1e-300), '"fps" should be'),
        (lambda d: d.update(name=[1] * 10**5), '"name" should be a text, it is [1, 1, 1'),
        (lambda d: d["splits"]["novel_view"].append({"camera": ["back"], "times": [0]}), "unknown camera ['back']"),
        (lambda d: d["splits"]["novel_view"].append({"camera": {}, "times": [0]}), "unknown camera an object"),
        (lambda d: d["splits"]["novel_view"].append({"camera": "x" * 5000, "times": [0]}), "unknown camera 'xxx"),
        (lambda d: d["cameras"].update({"x" * 300: d["cameras"]["front"]}), "is a folder's name; use 1 to 100"),
        (lambda d: d["cameras"].update({"a/../../b": d["cameras"]["front"]}), "is a folder's name; use 1 to 100"),
        (lambda d: d["cameras"]["front"].update(height=10**9), "whole pixels, 1 to 32768; they are 1000000000"),
        (lambda d: d["cameras"]["front"].update(width=True), "should be whole pixels"),
        (lambda d: d["cameras"]["front"]["intrinsics"][0].__setitem__(0, 1e300), "3 rows of 3 finite numbers"),
        (lambda d: d["cameras"]["front"]["intrinsics"][0].__setitem__(0, 1e8), "is longer than any lens has"),
        (lambda d: d["cameras"]["front"]["intrinsics"][0].__setitem__(2, 1e8), "principal point is far outside"),
        (lambda d: d["cameras"]["front"].update(intrinsics=[[0] * 3] * 3), "the focal lengths should be above 0"),
        (lambda d: d["cameras"]["front"]["world_to_camera"][0].__setitem__(3, 1e300), "4 rows of 4 finite numbers"),
    ],
)
def test_values_of_other_kinds_and_sizes_are_named(tiny, describe, edit, sentence):
    describe(edit)
    faults = validate(tiny)
    assert any(sentence in fault for fault in faults), faults
    assert max(map(len, faults)) < 700
    with pytest.raises(TwofoldError):
        read_capture(tiny)


def test_a_million_times_take_no_time(tiny, describe):
    describe(lambda d: d["splits"]["novel_pose"].append({"camera": "back", "times": list(range(7, 2_000_000, 2))}))
    begun = time.process_time()
    said = only(validate(tiny))
    assert time.process_time() - begun < 20
    assert "shows times 7, 9, 11, 13, 15, 17, 19, 21, 23, 25, 27, 29 and 999985 more, motion.npz ends at 5" in said


def test_few_numbers_are_all_named_and_many_are_counted():
    assert spans([3, 1, 2, 9]) == "1-3, 9"
    assert spans(range(0, 100, 2)) == "0, 2, 4, 6, 8, 10, 12, 14, 16, 18, 20, 22 and 38 more"


@pytest.mark.skipif(os.name == "nt", reason="needs pipes and devices")
@pytest.mark.parametrize(
    "name", ["capture.json", "body.npz", "motion.npz", "images/front/000001.png", "meshes/000001.npz"]
)
@pytest.mark.parametrize("kind", ["pipe", "device"])
def test_pipes_and_devices_are_no_files_of_a_capture(tiny, name, kind):
    (tiny / name).unlink()
    if kind == "pipe":
        os.mkfifo(tiny / name)
    else:
        (tiny / name).symlink_to("/dev/zero")
    assert any(f"is a {kind}, expected a file" in fault for fault in validate(tiny))


@pytest.mark.skipif(os.name == "nt", reason="needs devices")
def test_a_device_is_not_copied_into_a_capture(tmp_path):
    (tmp_path / "a.png").symlink_to("/dev/zero")

    def copied():
        with CaptureWriter(tmp_path / "out") as writer:
            writer.image_file("cam", 0, tmp_path / "a.png")

    with pytest.raises(TwofoldError, match="is a device"):
        copied()
    assert not (tmp_path / "out").exists()


def test_an_image_whose_pixels_are_missing_is_damaged_though_its_checksums_are_right(tiny):
    path = tiny / "images/front/000001.png"
    raw = path.read_bytes()
    start = raw.index(b"IDAT") - 4
    path.write_bytes(raw[:start] + raw[raw.index(b"IEND") - 4 :])
    assert "images/front/000001.png is damaged" in only(validate(tiny))
    frame = read_capture(tiny).train[1]
    with pytest.raises(TwofoldError, match=r"000001\.png is damaged"):
        frame.image()


def test_a_postscript_file_called_png_is_not_opened(tiny):
    (tiny / "images/front/000001.png").write_bytes(b"%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 8 8\nshowpage\n")
    assert "is no image of a known kind" in only(validate(tiny))


@pytest.mark.parametrize(
    "arrays",
    [
        {"vertices": np.zeros((4, 3))},
        {"vertices": np.zeros((4, 2)), "faces": np.zeros((1, 3), int)},
        {"vertices": np.full((4, 3), np.inf), "faces": np.zeros((1, 3), int)},
        {"vertices": np.full((4, 3), 1e300), "faces": np.zeros((1, 3), int)},
        {"vertices": np.full((4, 3), "a"), "faces": np.zeros((1, 3), int)},
        {"vertices": np.zeros((4, 3)), "faces": np.full((1, 3), 4)},
        {"vertices": np.zeros((4, 3)), "faces": np.full((1, 3), -1)},
        {"vertices": np.zeros((4, 3)), "faces": np.zeros((1, 3))},
        {"vertices": np.zeros(()), "faces": np.zeros(())},
    ],
)
def test_a_mesh_that_is_none_is_one_sentence(tmp_path, arrays):
    np.savez(tmp_path / "m.npz", **arrays)
    with pytest.raises(TwofoldError, match=r"m\.npz"):
        read_mesh(tmp_path / "m.npz")


def test_half_a_character_in_the_name_is_refused(tiny):
    text = json.loads((tiny / "capture.json").read_text()) | {"name": "NAME"}
    (tiny / "capture.json").write_text(json.dumps(text).replace("NAME", r"\ud83d"))
    assert "holds half a character" in only(validate(tiny))


def test_a_path_that_is_too_long_is_no_capture():
    with pytest.raises(TwofoldError, match="does not exist"):
        read_capture("x" * 5000)
