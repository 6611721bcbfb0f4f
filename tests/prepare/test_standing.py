"""How bodies stand: motions whose faults are known."""

import numpy as np
import pytest
import torch
from little_body import little_body

from twofold.body.skeleton import JOINT_NAMES, shape_body
from twofold.prepare import standing
from twofold.prepare.standing import standing_facts, standing_faults


def measured(poses=None, translations=None, fps=10.0, frames=20, counted=None):
    body = little_body()
    joints = shape_body(body, torch.zeros(body.shape_basis.shape[-1])).joints
    poses = torch.zeros(frames, 24, 3) if poses is None else poses
    translations = torch.zeros(frames, 3) if translations is None else translations
    return standing_facts(poses, translations, joints, np.arange(len(poses)) / fps, counted)


def topics(facts):
    return [fault.topic for fault in standing_faults(facts)]


def bent(**angles):
    """Poses whose joints are turned about x, radians."""
    poses = torch.zeros(20, 24, 3)
    for name, angle in angles.items():
        poses[:, JOINT_NAMES.index(name), 0] = angle
    return poses


def test_a_body_that_stands_still_is_in_order():
    found = measured()
    assert found.on_legs == 20
    assert found.upright > 0.95
    assert found.off_balance < 0.15
    assert found.lean < 8
    assert found.knees < 10
    assert found.floating == pytest.approx(0, abs=1e-6)
    assert found.sliding == pytest.approx(0, abs=1e-6)
    assert topics(found) == []


@pytest.mark.parametrize("degrees", [-35.0, -20.0, 20.0, 35.0])
def test_a_body_that_is_turned_over_as_a_whole_leans_by_as_much_and_would_fall(degrees):
    found = measured(bent(pelvis=np.radians(degrees)))
    assert found.lean == pytest.approx(abs(degrees), abs=6)
    assert topics(found) == ["lean"]
    assert f"leans by {found.lean:.0f} degrees" in standing_faults(found)[0].what
    assert f"leans by {found.lean:.0f} degrees" in found.sentence()


def test_somebody_who_bows_over_their_feet_does_not_lean():
    """The hips go back as the trunk goes forward."""
    found = measured(bent(pelvis=0.25, spine1=0.5, spine2=0.4, left_hip=-0.25, right_hip=-0.25))
    assert topics(found) == []


def test_somebody_who_sits_is_not_on_their_legs():
    seated = bent(left_hip=-1.5, right_hip=-1.5, left_knee=1.5, right_knee=1.5)
    found = measured(seated)
    assert found.on_legs == 0
    assert found.leaning_most == -1
    assert topics(found) == []
    assert "Hardly any frame" in found.sentence()


def test_how_far_knees_are_bent_is_that_of_the_straighter_one():
    assert measured(bent(left_knee=0.5, right_knee=0.8)).knees == pytest.approx(np.degrees(0.5), abs=6)


def test_feet_that_slide_and_feet_in_the_air_are_measured():
    slides = torch.zeros(20, 3)
    slides[:, 0] = 0.05 * torch.arange(20)
    found = measured(translations=slides)
    assert found.sliding == pytest.approx(0.5, abs=1e-3)
    assert topics(found) == ["sliding"]
    floats = torch.zeros(20, 3)
    floats[10:, 1] = 0.4
    found = measured(translations=floats)
    assert found.floating == pytest.approx(0.4, abs=1e-3)
    assert topics(found) == ["floating"]
    assert standing_faults(found)[0].doubtful


def test_one_frame_that_leans_is_named_and_no_fault():
    poses = torch.zeros(20, 24, 3)
    poses[13, 0, 0] = 0.7
    found = measured(poses)
    assert found.leaning_most == 13
    assert topics(found) == []


def test_frames_that_are_left_out_do_not_count():
    poses, translations = torch.zeros(20, 24, 3), torch.zeros(20, 3)
    poses[:12, 0, 0], translations[:12, 1], translations[:12, 0] = 0.7, 3.0, 0.1 * torch.arange(12)
    kept = range(12, 20)
    assert topics(measured(poses, translations)) != []
    found = measured(poses, translations, counted=kept)
    assert topics(found) == []
    assert found.leaning_most in kept
    # From one frame that counts to the next is no step where others lie between.
    apart = torch.zeros(20, 3)
    apart[10:, 0] = 5.0
    assert measured(translations=apart, counted=[*range(9), *range(11, 20)]).sliding == 0


def test_where_y_is_not_up_nothing_is_said():
    found = measured(bent(pelvis=1.5))
    assert found.upright < standing.UPRIGHT
    assert topics(found) == []
    assert "does not stand along" in found.sentence()


def test_feet_slide_by_the_time_between_frames():
    translations = torch.tensor([[0.1, 0.0, 0.0]]) * torch.arange(20)[:, None]
    body = little_body()
    joints = shape_body(body, torch.zeros(body.shape_basis.shape[-1])).joints
    slow = standing_facts(torch.zeros(20, 24, 3), translations, joints, 0.5 * np.arange(20))
    assert slow.sliding == pytest.approx(0.2, rel=1e-4)
    assert measured(translations=translations).sliding == pytest.approx(1.0, rel=1e-4)
