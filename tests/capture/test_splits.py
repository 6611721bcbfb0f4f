"""Images are taken out of the splits, and nothing else of a capture changes."""

import json

import pytest
from tiny_capture import write_tiny

from twofold.capture.folder import read_capture
from twofold.capture.splits import leave_out
from twofold.errors import TwofoldError


def test_images_leave_every_split_and_the_rest_stays(tmp_path):
    folder = write_tiny(tmp_path / "tiny")
    before = json.loads((folder / "capture.json").read_text())
    assert leave_out(folder, [("front", 2), ("back", 4), ("side", 9)]) == [("back", 2), ("back", 4), ("front", 2)]
    capture = read_capture(folder)
    shown = {split: [(f.camera_name, f.frame_index) for f in frames] for split, frames in capture.splits.items()}
    assert shown == {
        "train": [("front", 0), ("front", 1), ("front", 3)],
        "novel_view": [("back", 0)],  # The other frame is not trained on any more
        "novel_pose": [("front", 4), ("front", 5)],
    }
    after = json.loads((folder / "capture.json").read_text())
    assert after["notes"].pop("left_out_by_check") == [["back", 2], ["back", 4], ["front", 2]]
    assert {k: v for k, v in after.items() if k not in ("splits", "notes")} == {
        k: v for k, v in before.items() if k not in ("splits", "notes")
    }
    assert leave_out(folder, [("front", 5)]) == [("front", 5)]
    assert len(json.loads((folder / "capture.json").read_text())["notes"]["left_out_by_check"]) == 4


def test_what_would_leave_nothing_to_train_on_is_refused(tmp_path):
    folder = write_tiny(tmp_path / "tiny")
    before = (folder / "capture.json").read_bytes()
    with pytest.raises(TwofoldError, match="would train on 1 frames; two are needed"):
        leave_out(folder, [("front", time) for time in (0, 1, 2)])
    assert (folder / "capture.json").read_bytes() == before
