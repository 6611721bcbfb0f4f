import pytest
import torch

from twofold.viewer.body_pose import BodyPose
from twofold.viewer.timeline import Timeline


def test_the_first_frame_of_the_first_split_is_shown(state, person):
    version, shown = state.shown()
    assert version == 0
    assert shown.pose is state.timelines["capture: train"].poses[0]
    assert not state.edited
    assert len(state.timeline) == len({frame.frame_index for frame in person.train})


def test_each_change_raises_the_version_and_is_told(state):
    calls = []
    state.on_change(lambda: calls.append(state.version))
    state.show(part="base")
    state.show(quantity="depth", still=False)
    state.scrub(2)
    state.set_joint(4, torch.tensor([0.5, 0, 0]))
    state.show_space("canonical")
    assert calls == [1, 2, 3, 4, 5]
    _, shown = state.shown()
    assert (shown.part, shown.quantity, shown.still) == ("base", "depth", False)


def test_scrubbing_stays_within_the_timeline(state):
    state.scrub(10_000)
    assert state.frame == len(state.timeline) - 1
    state.scrub(-3)
    assert state.frame == 0


def test_an_edited_pose_is_kept_until_reset(state):
    before = state.pose
    state.set_joint(18, torch.tensor([0.0, -1.0, 0.0]))
    assert state.edited
    assert state.pose.pose[18].tolist() == [0.0, -1.0, 0.0]
    state.reset_joint(18)
    assert torch.equal(state.pose.pose, before.pose)
    state.set_joint(18, torch.tensor([0.0, -1.0, 0.0]))
    state.reset_pose()
    assert state.pose is before
    assert not state.edited


def test_canonical_space_shows_the_canonical_pose_and_keeps_the_edited_one(state):
    state.set_joint(18, torch.tensor([0.0, -1.0, 0.0]))
    state.show_space("canonical")
    assert state.shown()[1].pose.pose[18].abs().sum() == 0
    state.show_space("posed")
    assert state.shown()[1].pose.pose[18, 1] == -1


def test_t_pose_has_straight_legs(state):
    state.rest_pose()
    assert state.pose.pose[1:].abs().max() == 0


def test_playing_shows_the_frame_that_is_due_over_and_over_again(state):
    poses = tuple(BodyPose(torch.full((24, 3), 0.01 * k), torch.zeros(3)) for k in range(4))
    state.choose_timeline(Timeline("four", poses, 10.0))
    state.play(100.0)
    assert not state.tick(100.05)
    assert state.tick(100.11)
    assert state.frame == 1
    assert state.tick(100.45)
    assert state.frame == 0
    state.scrub(3)
    state.play(200.0)
    state.tick(200.01)
    assert state.frame == 3, "it goes on from where it stood"
    state.set_joint(4, torch.tensor([0.5, 0, 0]))
    assert not state.playing
    assert not state.tick(300.0)


def test_skinning_weights_are_never_asked_of_the_field(state):
    assert state.shown()[1].wants_field
    state.show(quantity="skinning weights")
    assert not state.shown()[1].wants_field


def test_a_chosen_timeline_can_be_chosen_again(state):
    line = Timeline("one", (BodyPose(torch.zeros(24, 3), torch.zeros(3)),), 30.0)
    state.choose_timeline(line)
    assert state.timelines["one"] is line
    assert state.pose is line.poses[0]
    with pytest.raises(AttributeError):
        state.frame = 3
