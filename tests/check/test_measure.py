"""The whole check: facts of a folder, the page, the numbers, the command with its exit codes."""

import json
import shutil
from html.parser import HTMLParser

import numpy as np
import pytest
import torch
from filmed import describe, each_mask, move

from twofold.capture.folder import read_capture
from twofold.capture.validate import validate
from twofold.check.check_report import numbers, write_check
from twofold.check.frame_measures import mirrored_pose
from twofold.check.measure import alike, measure_capture, spread
from twofold.check.rules import judge
from twofold.cli.main import main
from twofold.errors import TwofoldError


def checked(capsys, folder, *options):
    """Exit code and what was said."""
    try:
        main(["check", str(folder), *map(str, options)])
        code = 0
    except SystemExit as ended:
        code = ended.code
    said = capsys.readouterr().err
    assert "Traceback" not in said
    return code, " ".join(said.split())


def topics(folder, **options):
    return {f.topic: f for f in judge(measure_capture(folder, **options)[0]).findings}


def test_a_good_capture_ends_well_and_leaves_page_and_numbers(turner, capsys):
    code, said = checked(capsys, turner, "--most", 12)
    assert code == 0
    assert str(turner / "check" / "index.html") in said
    assert f"twofold train {turner}" in said
    read = json.loads((turner / "check" / "check.json").read_text())
    assert read["verdict"] == "good"
    assert len(read["frames"]) == 12
    assert {f["split"] for f in read["frames"]} == {"train", "novel_view", "novel_pose"}
    assert sum(f["split"] == "train" for f in read["frames"]) == 8
    # What was written is no part of the capture and harms it in no way.
    assert validate(turner) == []


def test_a_capture_that_is_not_trainable_ends_with_one(turner, capsys, tmp_path):
    each_mask(turner, lambda mask, time: 255 - mask)
    code, said = checked(capsys, turner, "--out", tmp_path / "page", "--most", 8)
    assert code == 1
    assert "fault: 8 masks inverted" in said
    assert "Not trainable as it is" in said
    assert f"twofold train {turner}" not in said
    assert not (turner / "check").exists()
    assert "Not trainable" in (tmp_path / "page" / "index.html").read_text()


def test_empty_masks_and_whatever_else_is_wrong_are_listed(turner, capsys):
    each_mask(turner, lambda mask, time: mask * (time not in (3, 4)))
    next((turner / "images" / "front").iterdir()).unlink()
    code, said = checked(capsys, turner)
    assert code == 2
    assert "all black" in said
    assert "The same at times 4." in said
    assert "images/front lacks" in said
    assert not (turner / "check").exists()


def test_what_stands_elsewhere_is_refused_with_the_convention_that_mends_it(turner, capsys):
    def opengl(description):
        for camera in description["cameras"].values():
            for row in (1, 2):
                camera["world_to_camera"][row] = [-v for v in camera["world_to_camera"][row]]

    describe(turner, opengl)
    code, said = checked(capsys, turner)
    assert code == 2
    assert "behind it" in said
    assert "OpenGL" in said
    assert "rows of world_to_camera by -1" in said.replace("second and third row of", "rows of")


def test_a_folder_that_is_none_and_a_number_too_small_are_refused(turner, tmp_path, capsys):
    assert checked(capsys, tmp_path / "none")[0] == 2
    code, said = checked(capsys, turner, "--most", 1)
    assert code == 2
    assert "--max-images" in said


def test_a_page_cannot_take_the_place_of_a_file(turner, tmp_path, capsys):
    (tmp_path / "file").write_text("mine")
    code, said = checked(capsys, turner, "--out", tmp_path / "file", "--most", 2)
    assert code == 2
    assert str(tmp_path / "file") in said
    assert (tmp_path / "file").read_text() == "mine"


def test_sides_exchanged_in_some_frames_are_named(turner):
    def exchange(arrays):
        poses = torch.from_numpy(arrays["poses"])
        return {"poses": torch.stack([mirrored_pose(p) if t in (6, 7, 8) else p for t, p in enumerate(poses)]).numpy()}

    move(turner, exchange)
    found = topics(turner)
    assert found["sides"].level == "warning"
    assert found["sides"].where == "camera front at 6-8; camera side at 8"


def test_splits_are_written_without_what_should_be_left_out(turner, capsys):
    def exchange(arrays):
        poses = torch.from_numpy(arrays["poses"])
        return {"poses": torch.stack([mirrored_pose(p) if t in (6, 7, 8) else p for t, p in enumerate(poses)]).numpy()}

    move(turner, exchange)
    code, said = checked(capsys, turner, "--write-splits")
    assert code == 0
    assert "left out of the splits" in said
    assert "camera front at 6-8" in said
    shown = {(f.camera_name, f.frame_index) for frames in read_capture(turner).splits.values() for f in frames}
    assert {("front", 6), ("front", 7), ("front", 8)}.isdisjoint(shown)
    assert "the splits stay as they are" in checked(capsys, turner, "--write-splits")[1]


def test_images_of_other_frames_are_named(turner):
    for kind in ("images", "masks"):
        one, other = (turner / kind / "front" / f"0000{t:02d}.png" for t in (3, 14))
        one.rename(turner / "x.png")
        other.rename(one)
        (turner / "x.png").rename(other)
    found = topics(turner)
    assert found["exchanged images"].where == "camera front at 3, 14"
    assert "3 shows the pose of 14, 14 shows the pose of 3" in found["exchanged images"].what
    assert "bad frames" not in found


def test_one_camera_that_is_wrong_is_named(turner):
    def far(description):
        matrix = description["cameras"]["side"]["intrinsics"]
        matrix[0][0], matrix[1][1] = 2 * matrix[0][0], 2 * matrix[1][1]

    describe(turner, far)
    found = topics(turner, most=14)
    assert found["convention"].where == "camera side"
    assert "focal length is 2 times" in found["convention"].what


def test_a_motion_that_is_late_is_named(turner):
    move(turner, lambda arrays: {k: np.roll(arrays[k], 2, 0) for k in ("poses", "translations")})
    found = topics(turner, most=20)
    assert "2 frames later" in found["delay"].what
    assert "bad frames" not in found


def test_the_same_image_in_two_splits_or_twice_is_named(turner):
    images = turner / "images" / "front"
    for source, target in ((2, 21), (8, 9)):
        shutil.copy(images / f"0000{source:02d}.png", images / f"0000{target:02d}.png")
    found = topics(turner, most=2)
    assert found["overlap"].where == "camera front at 21"
    assert found["repeated images"].where == "times 9"


def test_numbers_are_plain_and_say_the_verdict(measured):
    facts, _ = measured
    read = json.loads(json.dumps(numbers(facts, judge(facts)), allow_nan=False))
    assert read["verdict"] == "good"
    assert read["stature"] == pytest.approx(facts.stature, abs=1e-4)
    assert {f["camera"] for f in read["frames"]} == {"front", "side"}
    assert read["doubts"][0]["diagnosis"]["conventions"] == []


class Page(HTMLParser):
    """Tags that must close do, and everything that a page could fetch."""

    def __init__(self, text):
        super().__init__()
        self.open, self.fetched, self.text = [], [], []
        self.feed(text)
        assert self.open == []

    def handle_starttag(self, tag, attrs):
        # A drawing's mark is used again within the page: an address that begins with "#".
        self.fetched += [value for name, value in attrs if name in ("src", "href") and not value.startswith("#")]
        if tag not in {"meta", "img"}:
            self.open.append(tag)

    def handle_startendtag(self, tag, attrs):
        pass

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        self.text.append(data)


def test_the_page_stands_alone_and_no_name_breaks_it(turner, tmp_path):
    describe(turner, lambda description: description.update(name="<script>x</script>", credit="A & B"))
    facts, capture = measure_capture(turner, most=8)
    page = write_check(facts, capture, judge(facts), tmp_path / "deep" / "page").read_text()
    parsed = Page(page)
    assert parsed.fetched
    assert all(address.startswith("data:image/") for address in parsed.fetched)
    assert "<script" not in page
    text = " ".join(" ".join(parsed.text).split())
    assert "<script>x</script>" in text
    assert "A & B" in text
    assert "8 of 31 images checked" in text
    assert len(parsed.fetched) == 21, "eight overlays, four frames from three sides, the map of the coverage"
    assert "the body leans by" in text


def test_faults_that_differ_in_their_frame_are_one():
    faults = ["masks/a/000001.png is bad.", "masks/a/000003.png is bad.", "masks/b/000003.png is bad.", "x lacks y."]
    assert alike(faults) == [
        "masks/a/000001.png is bad. (The same at times 3.)", "masks/b/000003.png is bad.", "x lacks y.",
    ]  # fmt: skip


def test_items_are_spread_from_end_to_end():
    assert spread(range(10), 4) == [0, 3, 6, 9]
    assert spread(range(3), 10) == [0, 1, 2]
    assert spread([], 3) == spread(range(3), 0) == []


def test_progress_ends_at_one(turner):
    seen = []
    measure_capture(turner, most=4, progress=seen.append)
    assert seen == sorted(seen)
    assert seen[-1] == 1.0


def test_faults_come_as_one_error(turner):
    (turner / "motion.npz").unlink()
    with pytest.raises(TwofoldError, match=r"motion\.npz is missing"):
        measure_capture(turner)
