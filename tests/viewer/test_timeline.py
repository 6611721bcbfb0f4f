"""A timeline shows the frame that is due, also where frames were not taken at one rate."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from twofold.capture.folder import read_capture
from twofold.viewer.body_pose import BodyPose
from twofold.viewer.timeline import Timeline, split_timelines

POSES = (BodyPose(torch.zeros(24, 3), torch.zeros(3)),) * 4


@pytest.mark.parametrize(
    "line", [Timeline("even", POSES, 10.0), Timeline("timed", POSES, 10.0, (), (0.0, 0.1, 0.2, 0.3))]
)
def test_frames_follow_each_other_at_the_rate_over_and_over_again(line):
    assert [line.at(seconds) for seconds in (0.0, 0.05, 0.11, 0.35, 0.41, 0.55)] == [0, 0, 1, 3, 0, 1]
    assert [line.begins(frame) for frame in range(4)] == pytest.approx([0, 0.1, 0.2, 0.3])


def test_a_frame_is_shown_until_the_next_one_was_taken():
    line = Timeline("pause", POSES, 10.0, (), (0.0, 0.1, 2.1, 2.2))
    assert [line.at(seconds) for seconds in (0.15, 2.0, 2.15, 2.25, 2.35)] == [1, 1, 2, 3, 0]
    assert line.begins(2) == 2.1


def test_timelines_of_a_capture_begin_with_their_first_frame(person_folder):
    capture = read_capture(person_folder)
    for line in split_timelines(capture, None):
        indices = np.array([int(label) for label in line.labels])
        assert line.seconds == pytest.approx((indices - indices[0]) / capture.fps)
    last = max(frame.frame_index for frames in capture.splits.values() for frame in frames)
    capture = replace(capture, seconds=5 + torch.arange(last + 1, dtype=torch.float64) ** 2)
    line = split_timelines(capture, None)[0]
    times = sorted({frame.frame_index for frame in capture.train})
    assert line.seconds == pytest.approx([time**2 - times[0] ** 2 for time in times])
