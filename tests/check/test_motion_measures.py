"""Motion without images: jumps, coverage, ranges."""

import itertools
import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from filmed import FPS, MOMENTS, motion
from hypothesis import given
from hypothesis import strategies as st
from tiny_person import ring_camera

from twofold.body.skeleton import JOINT_NAMES
from twofold.check.frame_measures import turned_round
from twofold.check.motion_measures import LIMBS, motion_facts
from twofold.prepare.turning import SEEN_FROM, arc, sides_seen


@pytest.fixture
def facts(turner_read, turner_shaped):
    """A function that measures poses and translations, the filmed ones unless given."""

    def measure(poses=None, translations=None, splits=None, fps=FPS, seconds=None):
        given_poses, given_translations = motion()
        taken = np.arange(MOMENTS) / fps if seconds is None else seconds
        return motion_facts(
            given_poses if poses is None else poses,
            given_translations if translations is None else translations,
            turner_shaped.joints, splits or turner_read.splits, taken,
        )  # fmt: skip

    return measure


def test_a_smooth_motion_has_no_jumps(facts):
    found = facts()
    assert found.jumps == ()
    assert found.jitter < 0.03
    assert found.frames == tuple(range(MOMENTS))
    assert found.up > 0.99


def test_a_frame_with_other_limbs_is_a_jump_and_its_neighbours_are_none(facts):
    poses, translations = motion()
    poses[7, 16:20] += 1.5
    assert facts(poses).jumps == (7,)
    translations[11, 0] += 1.0
    assert facts(poses, translations).jumps == (7, 11)


def test_a_body_turned_round_jumps_there_and_back(facts):
    poses, _ = motion()
    for moment in (5, 6, 7):
        poses[moment] = turned_round(poses[moment])
    found = facts(poses).jumps
    assert 5 in found
    assert 8 in found
    assert not set(found) - {4, 5, 7, 8}


def test_the_same_motion_at_many_frames_a_second_is_too_fast(facts):
    assert len(facts(fps=240.0).jumps) > 10


def test_a_cut_before_a_block_of_novel_poses_is_no_jump(facts, turner_read):
    poses, _ = motion()
    poses[20:, 0, 1] += 2.0
    assert facts(poses).jumps == ()
    scattered = {"train": turner_read.train + turner_read.splits["novel_pose"]}
    assert facts(poses, splits=scattered).jumps


def test_trembling_is_measured_in_metres(facts, generator):
    _, translations = motion()
    noise = 0.05 * torch.randn(translations.shape, generator=generator)
    assert facts(translations=translations + noise).jitter == pytest.approx(facts().jitter, abs=0.02)
    poses, _ = motion()
    noise = 0.25 * torch.randn(poses.shape, generator=generator)
    noise[:, 0] = 0
    assert facts(poses + noise).jitter > 2 * facts().jitter


@given(st.lists(st.floats(-720, 720), min_size=1, max_size=12))
def test_the_arc_is_the_smallest_that_holds_all(azimuths):
    found = arc(azimuths)
    starts = [
        max((b - a) % 360 if (b - a) % 360 < 360 - 1e-9 else 0.0 for b in azimuths)
        for a in azimuths
    ]  # fmt: skip
    assert found == pytest.approx(min(starts), abs=1e-6)


@given(st.lists(st.floats(-7, 7), min_size=1, max_size=6))
def test_a_side_is_seen_from_up_to_sixty_degrees(azimuths):
    found = sides_seen(np.array(azimuths))
    for degree in range(0, 360, 7):
        normal = math.radians(degree + 0.5)
        cosine = max(math.cos(normal - a) for a in azimuths)
        if abs(cosine - math.cos(SEEN_FROM)) > 1e-6:
            assert found[degree] == (cosine > math.cos(SEEN_FROM))


@pytest.mark.parametrize(("angle", "side", "unseen"), [(0.0, 0.0, "back"), (math.pi / 2, 90.0, "right side")])
def test_a_camera_at_the_left_hand_sees_the_left_side(facts, turner_read, angle, side, unseen):
    poses = torch.zeros(MOMENTS, 24, 3)
    frames = tuple(replace(f, camera=ring_camera(angle), pose=poses[0]) for f in turner_read.train)
    found = facts(poses, torch.zeros(MOMENTS, 3), {"train": frames})
    assert all(abs(a - side) < 8 for a in found.azimuths)
    assert found.turned < 0.1
    assert found.seen == pytest.approx(120, abs=1)
    assert found.unseen == unseen


def test_a_body_that_turns_to_its_left_shows_its_right(facts, turner_read):
    poses = torch.zeros(MOMENTS, 24, 3)
    poses[:, 0, 1] = torch.linspace(0, math.pi / 2, MOMENTS)  # from +z to +x, where its left hand was
    found = facts(poses, torch.zeros(MOMENTS, 3), {"train": turner_read.train})
    assert found.azimuths[0] == pytest.approx(0, abs=3)
    assert -80 < found.azimuths[-1] < -60


def test_turning_once_round_shows_all_sides(facts):
    found = facts()
    assert found.seen == 360
    assert found.unseen == ""
    assert found.turned > 270


def test_ranges_are_the_largest_turns_between_any_two_training_frames(facts):
    poses, _ = motion()
    found = dict(zip((name for name, _ in LIMBS), facts().ranges, strict=True))
    for limb, joint, axis in (("left shoulder", "left_shoulder", 2), ("right knee", "right_knee", 0)):
        angles = poses[:20, JOINT_NAMES.index(joint), axis]
        assert found[limb] == pytest.approx(math.degrees(float(angles.max() - angles.min())), abs=0.1)
    assert found["head"] < 0.1


def test_poses_count_once_until_a_joint_turns_by_thirty_degrees(facts, turner_read):
    poses = torch.zeros(MOMENTS, 24, 3)
    assert facts(poses, splits={"train": turner_read.train}).poses == 1
    poses[:, 16, 2] = torch.linspace(0, 2.0, MOMENTS)
    count = sum(1 for _ in itertools.takewhile(lambda a: a < 2.0 * 19 / 23, itertools.count(0, 7 * 2.0 / 23)))
    assert facts(poses, splits={"train": turner_read.train}).poses == count


def test_novelty_is_how_far_test_poses_are_from_all_training_poses(facts):
    poses, _ = motion()
    poses[20:] = poses[3:7]
    assert facts(poses).novelty == pytest.approx(0, abs=0.1)
    poses[20:, 18, 1] += math.radians(50)
    assert 20 < facts(poses).novelty < 51


def test_a_body_that_turns_is_no_jump_where_two_time_stamps_are_close(facts):
    poses, translations = motion()
    poses = poses.clone()
    poses[:, 0] = torch.tensor([0.0, 1, 0]) * (torch.arange(MOMENTS) / FPS)[:, None]
    seconds = np.arange(MOMENTS) / FPS
    seconds[MOMENTS // 2 :] -= 1 / FPS - 0.002
    assert facts(poses, translations, seconds=seconds).jumps == facts(poses, translations).jumps == ()


def test_a_frame_that_was_taken_late_may_be_far_from_the_one_before(facts):
    poses, translations = motion()
    pause = MOMENTS // 2
    moved = translations + 0.8 * (torch.arange(MOMENTS) >= pause)[:, None] * torch.tensor([1.0, 0, 0])
    assert pause in facts(poses, moved).jumps
    assert facts(poses, moved, seconds=np.arange(MOMENTS) / FPS + 2.0 * (np.arange(MOMENTS) >= pause)).jumps == ()
