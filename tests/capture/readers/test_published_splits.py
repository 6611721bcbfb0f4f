"""The frame ranges of the papers, subject by subject, against their published tables."""

import numpy as np
import pytest
import torch

from twofold.capture.readers.published_splits import (
    PROTOCOLS,
    count_images,
    default_protocol,
    needed_frames,
    ordered,
    split,
)
from twofold.capture.readers.sequence import Sequence3D, SourceCamera, SourceImage
from twofold.errors import TwofoldError

# subject: frames of the recording, cameras, train end, novel poses, test images of novel views and of novel poses
PAPER = {
    "313": (1470, 21, 799, (800, 999), 540, 140), "315": (2185, 21, 1599, (1600, 1999), 1080, 280),
    "377": (617, 23, 455, (456, 569), 352, 88), "386": (646, 23, 431, (432, 539), 330, 88),
    "387": (654, 23, 431, (432, 539), 330, 88), "390": (1171, 23, 936, (937, 1169), 704, 176),
    "392": (556, 23, 444, (445, 554), 330, 88), "393": (658, 23, 526, (527, 656), 396, 110),
    "394": (859, 23, 379, (380, 474), 286, 88),
}  # fmt: skip


def recording(subject, frames, cameras=23, keep=lambda camera, frame: True):
    camera = SourceCamera(np.eye(3), None, np.eye(4))
    image = SourceImage("", lambda: (np.zeros((1, 1, 3), np.uint8), np.zeros((1, 1), np.uint8)))
    return Sequence3D(
        name=subject, reader="zju", betas=torch.zeros(10), poses=torch.zeros(frames, 24, 3),
        translations=torch.zeros(frames, 3), cameras={f"c{i}": camera for i in range(cameras)},
        images={(f"c{i}", t): image for i in range(cameras) for t in range(frames) if keep(i, t)}, subject=subject,
    )  # fmt: skip


@pytest.mark.parametrize("subject", PAPER)
def test_the_papers_split(subject):
    frames, cameras, end, (first, last), views, poses = PAPER[subject]
    used = needed_frames("paper", subject) or frames
    chosen = split("paper", recording(subject, min(frames, used), cameras), 10)
    assert chosen["train"] == {"c0": list(range(end + 1))}
    counts = count_images(chosen)
    assert (counts["novel_view"], counts["novel_pose"]) == (views, poses)
    tested = chosen["novel_pose"]["c1"]
    assert tested[0] == first
    assert tested[-1] <= last
    assert set(np.diff(tested)) <= {30}
    assert "c0" not in chosen["novel_view"]
    assert "c0" not in chosen["novel_pose"]


def test_monohuman_tests_poses_on_the_training_camera_too():
    chosen = split("monohuman", recording("377", 570), 10)
    assert chosen["train"] == {"c0": list(range(456))}
    assert set(chosen["novel_pose"]) == {f"c{i}" for i in range(23)}
    assert chosen["novel_pose"]["c0"] == [456, 486, 516, 546]


def test_humannerf_trains_on_all_kept_frames():
    chosen = split("humannerf", recording("387", 540), 10)
    assert chosen["train"] == {"c0": list(range(540))}
    assert chosen["novel_view"]["c22"] == list(range(0, 511, 30))
    assert not chosen["novel_pose"]


@pytest.mark.parametrize(
    ("subject", "frames", "trained", "tested"),
    [
        ("313", 1470, range(60), range(60, 1060)), ("315", 2185, range(400), range(400, 1400)),
        ("390", 1171, range(700, 1000), range(700)), ("377", 617, range(300), range(300, 617)),
    ],
)  # fmt: skip
def test_neuralbody_trains_on_four_cameras(subject, frames, trained, tested):
    used = needed_frames("neuralbody", subject) or frames
    assert used >= max(trained.stop, tested.stop) or frames == used
    chosen = split("neuralbody", recording(subject, min(frames, used)), 10)
    assert chosen["train"] == {c: list(trained) for c in ("c0", "c6", "c12", "c18")}
    assert set(chosen["novel_view"]) == {f"c{i}" for i in range(23)} - set(chosen["train"])
    assert chosen["novel_pose"]["c1"] == list(tested)[::30]


def test_neuralbody_needs_its_cameras():
    with pytest.raises(TwofoldError, match="cameras 0, 6, 12 and 18, and 377 has 3 cameras"):
        split("neuralbody", recording("377", 20, 3), 10)


def test_held_out_frames_lie_between_trained_ones():
    chosen = split("every_nth", recording("", 25, 1), 10)
    assert chosen["novel_pose"] == {"c0": [5, 15]}
    assert sorted(chosen["train"]["c0"] + [5, 15]) == list(range(25))
    assert default_protocol(recording("", 25, 1)) == "every_nth"
    assert default_protocol(recording("", 25, 2)) == "paper"


@pytest.mark.parametrize("protocol", PROTOCOLS)
def test_images_that_are_not_there_are_in_no_split(protocol):
    there = recording("", 400, 20, keep=lambda c, t: t % 7 and (c != 3))
    chosen = split(protocol, there, 10)
    assert set(ordered(chosen)) <= set(there.images)
    trained = {frame for frames in chosen["train"].values() for frame in frames}
    assert not trained & {f for frames in chosen["novel_pose"].values() for f in frames}


def test_too_little_to_train_on_is_said():
    with pytest.raises(TwofoldError, match="fewer than two training images"):
        split("paper", recording("", 20, 2, keep=lambda c, t: c == 1), 10)
