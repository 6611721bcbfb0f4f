"""A capture folder reads back as it was written, or is not written at all."""

import json
import os
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from tiny_capture import SPLITS, stick_body, tiny_cameras, tiny_motion, write_tiny

from twofold.capture.folder import CaptureWriter, read_capture, read_true_motion
from twofold.capture.layout import read_contents
from twofold.capture.validate import joint_positions
from twofold.errors import TwofoldError
from twofold.geometry.cameras import project


def every_file(folder):
    return {p.relative_to(folder).as_posix(): p.read_bytes() for p in sorted(folder.rglob("*")) if p.is_file()}


def test_a_capture_reads_back_as_it_was_written(tiny):
    capture = read_capture(tiny)
    assert (capture.name, capture.fps, capture.background, capture.credit) == ("tiny", 10.0, (0.1, 0.2, 0.3), "nobody")
    assert capture.folder == tiny
    assert torch.equal(capture.betas, torch.tensor([0.5]))
    for name, array in stick_body().arrays().items():
        np.testing.assert_array_equal(capture.body.arrays()[name], array)
    poses, translations = tiny_motion()
    for split, cameras in SPLITS.items():
        images = [(camera, time) for camera, times in cameras.items() for time in times]
        assert [(f.camera_name, f.frame_index) for f in capture.splits[split]] == images
        for frame in capture.splits[split]:
            assert torch.equal(frame.pose, poses[frame.frame_index])
            assert torch.equal(frame.translation, translations[frame.frame_index])
            camera = tiny_cameras()[frame.camera_name]
            assert torch.equal(frame.camera.world_to_camera, camera.world_to_camera)
            assert torch.equal(frame.camera.intrinsics, camera.intrinsics)
            assert frame.image()[0, 0, 0] * 255 == 30 + frame.frame_index
    assert sorted(capture.meshes) == list(range(6))
    with np.load(capture.meshes[3]) as mesh:
        assert mesh["vertices"].shape == (96, 3)
        assert mesh["faces"].shape == (96, 3)


def test_the_description_is_readable_by_hand(tiny):
    text = (tiny / "capture.json").read_text()
    assert "        [50.0, 0.0, 23.5],\n" in text
    assert '"times": [0, 1, 2, 3]' in text
    assert len(text.splitlines()) < 100


def test_the_documented_example_is_faultless(tiny):
    page = (Path(__file__).parents[2] / "docs" / "captures.md").read_text(encoding="utf-8")
    (tiny / "capture.json").write_text(page.split("```json\n")[1].split("```")[0])
    contents, faults = read_contents(tiny)
    assert faults == []
    assert contents.images == {"front": [0, 1, 2, 3, 4, 5], "side": [0, 2, 4, 5]}
    joints = joint_positions(contents)
    assert joints is not None
    for camera in contents.cameras.values():
        pixels, depths = project(camera, joints)
        assert (depths > 2).all()
        assert ((pixels > 0) & (pixels < 256)).all()


def test_cameras_keep_every_bit_in_short_decimals(tmp_path):
    cameras = tiny_cameras()
    cameras["front"].intrinsics[0, 0] = 50.1
    write_tiny(tmp_path / "a", cameras=cameras)
    assert "[50.1, 0.0, 23.5]" in (tmp_path / "a" / "capture.json").read_text()
    assert torch.equal(read_capture(tmp_path / "a").train[0].camera.intrinsics, cameras["front"].intrinsics)


def test_the_same_input_gives_the_same_bytes(tiny, tmp_path):
    assert every_file(write_tiny(tmp_path / "again")) == every_file(tiny)


def test_image_files_are_taken_over_as_they_are(tmp_path, tiny):
    source = tmp_path / "source.JPG"
    Image.new("RGB", (48, 40), (90, 90, 90)).save(source, "JPEG")
    (tiny / "images/front/000001.png").unlink()
    with CaptureWriter(tmp_path / "new") as writer:
        writer.image_file("front", 1, source)
        for time in (0, 1):
            writer.mask_file("front", time, tiny / f"masks/front/{time:06d}.png")
        writer.image_file("front", 0, tiny / "images/front/000000.png")
        poses, translations = tiny_motion()
        writer.finish(
            name="new", body=stick_body(), betas=torch.zeros(1), poses=poses, translations=translations,
            cameras=tiny_cameras(), splits={"train": {"front": [0, 1]}}, fps=1.0,
        )  # fmt: skip
    assert (tmp_path / "new/images/front/000001.jpg").read_bytes() == source.read_bytes()
    frames = read_capture(tmp_path / "new").train
    assert frames[1].image_file.suffix == ".jpg"
    assert (frames[1].image() * 255).round().unique().tolist() == [90]


def test_true_motion_is_kept_beside_a_disturbed_one(tmp_path, tiny):
    assert read_true_motion(tiny) is None
    poses, translations = tiny_motion()
    write_tiny(tmp_path / "noisy", poses=poses + 0.01, true_poses=poses, true_translations=translations)
    assert torch.equal(read_capture(tmp_path / "noisy").train[0].pose, poses[0] + 0.01)
    truth = read_true_motion(tmp_path / "noisy")
    assert truth is not None
    assert torch.equal(truth[0], poses)
    assert torch.equal(truth[1], translations)


def test_times_of_frames_are_kept_where_the_rate_varies(tmp_path, tiny):
    assert read_capture(tiny).seconds is None
    assert read_capture(tiny).seconds_of([0, 3]).tolist() == [0.0, 3 / read_capture(tiny).fps]
    seconds = torch.tensor([0.0, 0.1, 0.2, 0.7, 0.8, 1 / 3 + 1], dtype=torch.float64)
    write_tiny(tmp_path / "uneven", seconds=seconds)
    assert read_capture(tmp_path / "uneven").seconds_of([3, 5]).tolist() == [0.7, 1 / 3 + 1]
    write_tiny(tmp_path / "clock", seconds=1764288000 + seconds)
    assert read_capture(tmp_path / "clock").second(3) == pytest.approx(0.7, abs=1e-6), "counted from the first frame"


def test_notes_are_kept_and_disturb_nothing(tmp_path):
    write_tiny(tmp_path / "a", notes={"left_out": [7, 8]})
    assert json.loads((tmp_path / "a" / "capture.json").read_text())["notes"] == {"left_out": [7, 8]}
    assert read_capture(tmp_path / "a").name == "tiny"


@pytest.mark.parametrize(
    "changes",
    [
        {"splits": {"train": {}}},
        {"splits": {"train": {"front": [0, 99]}}},
        {"poses": torch.full((6, 24, 3), torch.nan)},
        {"background": (2.0, 0.0, 0.0)},
    ],
)
def test_a_faulty_capture_is_not_written(tmp_path, changes):
    with pytest.raises(TwofoldError, match=r"The capture .*tiny cannot be used"):
        write_tiny(tmp_path / "tiny", **changes)
    assert os.listdir(tmp_path) == []


def test_an_interrupted_or_unfinished_capture_leaves_nothing(tmp_path):
    def interrupted():
        with CaptureWriter(tmp_path / "tiny") as writer:
            writer.mask("front", 0, np.zeros((4, 4), np.uint8))
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        interrupted()
    with pytest.raises(RuntimeError, match="finish"), CaptureWriter(tmp_path / "tiny"):
        pass
    assert os.listdir(tmp_path) == []


def test_a_capture_is_overwritten_only_on_request(tiny):
    before = every_file(tiny)
    with pytest.raises(TwofoldError, match="already holds a capture; choose another name or remove that one first"):
        write_tiny(tiny)
    assert every_file(tiny) == before
    write_tiny(tiny, overwrite=True, name="second")
    assert read_capture(tiny).name == "second"


def test_a_failed_overwriting_keeps_the_old_capture(tiny):
    before = every_file(tiny)
    with pytest.raises(TwofoldError, match="fps"):
        write_tiny(tiny, overwrite=True, fps=-1.0)
    assert every_file(tiny) == before
    assert os.listdir(tiny.parent) == ["tiny"]


def test_nothing_but_a_capture_is_ever_overwritten(tiny, tmp_path):
    (tmp_path / "thesis").mkdir()
    (tmp_path / "thesis" / "capture.txt").write_text("mine")
    (tiny / "thesis.txt").write_text("mine")
    with pytest.raises(TwofoldError, match=r"capture\.txt, which is no part of a capture; choose another name"):
        write_tiny(tmp_path / "thesis", overwrite=True)
    with pytest.raises(TwofoldError, match=r"thesis\.txt, which is no part of a capture"):
        write_tiny(tiny, overwrite=True)
    assert (tmp_path / "thesis" / "capture.txt").read_text() == "mine"
    assert (tiny / "thesis.txt").read_text() == "mine"


def test_reading_opens_no_pixels(tiny, monkeypatch):
    def no_pixels(*_):
        raise AssertionError("an image was decoded")

    monkeypatch.setattr("PIL.ImageFile.ImageFile.load", no_pixels)
    assert read_capture(tiny).name == "tiny"


def test_many_faults_are_listed_shortly(tiny, move):
    for path in (tiny / "masks/front").iterdir():
        Image.new("L", (3, 4)).save(path)
    for path in (tiny / "images/back").iterdir():
        path.unlink()
    move(poses=np.full((6, 24, 3), np.nan), betas=np.array([np.inf]))
    with pytest.raises(TwofoldError) as caught:
        read_capture(tiny)
    lines = str(caught.value).splitlines()
    assert lines[0] == f"The capture {tiny} cannot be used, it has 9 faults:"
    assert all(line.startswith("  - ") for line in lines[1:9])
    assert lines[9:] == ["  and 1 more."]


def test_one_fault_is_one_line(tiny):
    (tiny / "masks/front/000002.png").unlink()
    with pytest.raises(TwofoldError, match="lacks the images of times 2;") as caught:
        read_capture(tiny)
    assert len(str(caught.value).splitlines()) == 1


@pytest.mark.parametrize(
    ("make", "sentence"),
    [
        (lambda folder: None, "does not exist"),
        (lambda folder: folder.mkdir(), "is empty, so it is no capture folder"),
        (lambda folder: folder.write_text("x"), "is a file, expected a capture folder"),
        (lambda folder: (folder.mkdir(), (folder / "x").touch()), r"lacks capture\.json"),
        (lambda folder: (folder.mkdir(), (folder / "capture.json").write_text("{")), "not valid JSON at line 1"),
        (lambda folder: (folder.mkdir(), (folder / "capture.json").write_text("[]")), "describes something else"),
        (lambda folder: (folder.mkdir(), (folder / "capture.json").mkdir()), "is a folder, expected a file"),
        (
            lambda folder: (
                folder.mkdir(),
                (folder / "capture.json").write_text('{"format": "twofold-capture", "version": 9}'),
            ),
            "has version 9, this program reads version 1",
        ),
    ],
)
def test_what_is_no_capture_gets_one_sentence(tmp_path, make, sentence):
    make(tmp_path / "a")
    with pytest.raises(TwofoldError, match=sentence) as caught:
        read_capture(tmp_path / "a")
    assert len(str(caught.value).splitlines()) == 1


def test_ignored_pixels_are_written_and_give_way_with_the_rest(tmp_path):
    layer = np.zeros((40, 48), np.uint8)
    layer[4:9, 7:11] = 255
    write_tiny(tmp_path / "plain")
    folder = write_tiny(tmp_path / "hidden", ignored={("front", 2): layer})
    frames = {frame.frame_index: frame for frame in read_capture(folder).train}
    np.testing.assert_array_equal(frames[2].ignored().numpy(), layer > 0)
    assert frames[1].ignored_file is None
    files = every_file(folder)
    assert set(files) - set(every_file(tmp_path / "plain")) == {"ignored/front/000002.png"}
    write_tiny(folder, overwrite=True)
    assert every_file(folder) == every_file(tmp_path / "plain")
