"""Which feet stand: by still landmarks for long enough, not by slow ones for a moment."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from acting import acted, landmarks, standing_camera, the_body

from twofold.body.skeleton import JOINT_NAMES
from twofold.prepare.fitting import footing
from twofold.prepare.fitting.observations import Evidence, gather

RIGHT = [30, 32]


def seen(frames=24, change=None, noise=0.0):
    """A body that stands still before a camera, its landmarks changed."""
    body = the_body()
    track = landmarks(body, acted(body, 1), standing_camera())
    pixels = np.repeat(track.pixels, frames, 0)
    visibility = np.repeat(track.visibility, frames, 0)
    pixels += noise * np.random.default_rng(0).standard_normal(pixels.shape).astype(np.float32)
    if change is not None:
        change(pixels, visibility)
    whole = replace(track, pixels=pixels, visibility=visibility, world=np.repeat(track.world, frames, 0))
    return gather([Evidence(standing_camera(), whole)], [None], None)


def meters(seen):
    """Pixels of one metre of a person of 1.7 m."""
    return float(seen.size[0]) / footing.HEIGHT


@pytest.mark.parametrize("fps", [10.0, 30.0])
def test_feet_that_stay_stand_and_noise_of_a_centimetre_does_not_move_them(fps):
    assert footing.standing(seen(), fps).min() == 1
    one = meters(seen())
    assert footing.standing(seen(noise=0.004 * one), fps).mean() > 0.9


def test_a_foot_that_moves_does_not_stand_and_the_other_does():
    def slide(pixels, visibility):
        # A fifth of the person's height in a second.
        pixels[:, RIGHT, 0] += np.arange(24)[:, None] * 20 / 10

    stands = footing.standing(seen(change=slide), 10.0)
    assert stands[:, 0].min() == 1
    assert stands[:, 1].max() == 0


def test_a_moment_of_rest_between_two_swings_is_no_stand():
    """A foot that swings turns back, and is slow there: acted in the air."""
    body = the_body()
    motion = acted(body, 24)
    joints = [JOINT_NAMES.index(name) - 1 for name in ("left_hip", "right_hip")]
    pose = motion.pose.clone()
    pose[:, joints, 0] *= 2
    track = landmarks(body, replace(motion, pose=pose), standing_camera(1.2))
    stands = footing.standing(gather([Evidence(standing_camera(1.2), track)], [None], None), 10.0)
    assert not footing.tells_the_vertical(stands, 10.0)


def test_what_is_hardly_seen_does_not_stand():
    def hide(pixels, visibility):
        visibility[:, RIGHT] = 0.3

    assert footing.standing(seen(change=hide), 10.0)[:, 1].max() == 0


def test_a_clip_shorter_than_a_rest_tells_nothing():
    stands = footing.standing(seen(frames=3), 30.0)
    assert stands.max() == 0
    assert not footing.tells_the_vertical(stands, 30.0)


def test_the_vertical_is_told_by_a_fair_part_of_the_clip_only():
    stands = torch.zeros(60, 2)
    stands[:12, 0] = 1
    assert not footing.tells_the_vertical(stands, 10.0)
    stands[:20, 0] = 1
    assert footing.tells_the_vertical(stands, 10.0)
    assert not footing.tells_the_vertical(stands, 60.0)


def test_bent_and_lifted_legs_do_not_carry():
    joints = the_body().joints[None].repeat(4, 1, 1).clone()
    stands = torch.ones(4, 2)
    knees, ankles = [JOINT_NAMES.index(f"{s}_knee") for s in ("left", "right")], [7, 8]
    length = float((joints[0, ankles[0]] - joints[0, knees[0]]).norm())
    # Frame 1: both shins level behind; frame 2: the left one only; frame 3: the left one, and the right foot lifted.
    for frame, sides in ((1, (0, 1)), (2, (0,)), (3, (0,))):
        for side in sides:
            joints[frame, ankles[side]] = joints[frame, knees[side]] + torch.tensor([0.0, 0.0, -length])
    stands[3, 1] = 0
    assert footing.carrying(joints, stands).tolist() == pytest.approx([1, 0, 1, 0], abs=0.05)


def test_the_floor_is_where_most_soles_are():
    heights, stands = torch.zeros(10, 2, 2), torch.ones(10, 2)
    heights[:3, 1] = 0.4
    floor, uneven = footing.floor_of(heights, stands)
    assert float(floor) == pytest.approx(0, abs=0.01)
    assert float(uneven) < 0.01
    heights[::2] = 0.3
    assert float(footing.floor_of(heights, stands)[1]) > footing.MAX_UNEVEN
    nothing = footing.floor_of(heights, torch.zeros(10, 2))
    assert [float(n) for n in nothing] == [0, 0]
