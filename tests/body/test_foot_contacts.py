import dataclasses

import numpy as np
import pytest
import torch
from motion_rigs import stick_body

from twofold.body.builtin_motions import BUILTIN_MOTIONS
from twofold.body.foot_contacts import kept_contacts, resting
from twofold.body.motion import joint_frames, leg_length

STANDING_SPEED = 0.05


def toes_of(body, motion):
    return joint_frames(body.joints, motion)[1][:, [10, 11]]


def slide_of_standing_feet(source, moved, body, motion):
    """How far a foot moves at most, while the source's stands (moves less than 5 cm a second), metres."""
    theirs, ours = toes_of(source, moved), toes_of(body, motion)
    speeds = torch.gradient(theirs, dim=0)[0].norm(dim=-1) * moved.fps
    worst = 0.0
    for side in (0, 1):
        stands = (speeds[:, side] < STANDING_SPEED).numpy()
        starts = np.flatnonzero(np.diff(np.concatenate([[0], stands.astype(int), [0]])))
        for first, end in zip(starts[::2], starts[1::2], strict=True):
            places = ours[first:end, side]
            worst = max(worst, float((places[:, None] - places).norm(dim=-1).max()))
    return worst


def test_a_foot_rests_while_it_is_slow_and_gaps_and_blinks_do_not_count():
    toes = torch.zeros(60, 2, 3, dtype=torch.float64)
    toes[20:40, 0, 0] = torch.arange(20) * 0.05
    toes[40:, 0, 0] = 19 * 0.05
    toes[30, 1, 1] = 0.02  # one frame of noise
    rests = resting(toes, 30.0)
    assert rests[:19, 0].all()
    assert not rests[22:38, 0].any()
    assert rests[42:, 0].all()
    assert rests[:, 1].all()


def copied(source, motion, body):
    """The motion joint by joint on another body, its path scaled: what slides."""
    scale = leg_length(body.joints) / leg_length(source.joints)
    path = (motion.translations + source.joints[0].double()) * scale - body.joints[0].double()
    return dataclasses.replace(motion, translations=path), toes_of(source, motion) * scale


@pytest.mark.parametrize("name", ["walk", "dance"])
def test_contacts_are_kept_where_copied_joints_let_them_slide(name):
    source, body = stick_body(size=1.05), stick_body(thigh=0.9, shin=1.05, hips=0.85, size=0.9)
    motion = BUILTIN_MOTIONS[name](source)
    start, toes = copied(source, motion, body)
    kept = kept_contacts(start, body.joints.double(), float(body.vertices[:, 1].min()), toes)
    assert slide_of_standing_feet(source, motion, body, start) > 0.012
    assert slide_of_standing_feet(source, motion, body, kept) < 0.01
    lowest = toes_of(body, kept)[..., 1].min() - (body.joints[10, 1] - body.vertices[:, 1].min())
    assert abs(float(lowest)) < 0.005


def test_kept_contacts_do_not_shake():
    source, body = stick_body(size=1.05), stick_body(thigh=0.93, shin=1.05, hips=0.9, size=0.9)
    motion = BUILTIN_MOTIONS["walk"](source)
    start, toes = copied(source, motion, body)
    kept = kept_contacts(start, body.joints.double(), float(body.vertices[:, 1].min()), toes)
    acceleration = [torch.diff(joint_frames(body.joints, m)[1], n=2, dim=0).norm(dim=-1).max() for m in (start, kept)]
    assert acceleration[1] < 1.5 * acceleration[0] + 0.005


def test_a_body_with_the_sources_own_legs_keeps_its_poses():
    source = stick_body()
    motion = BUILTIN_MOTIONS["dance"](source)
    kept = kept_contacts(motion, source.joints.double(), float(source.vertices[:, 1].min()), toes_of(source, motion))
    before, after = (joint_frames(source.joints, m)[1] for m in (motion, kept))
    assert (before - after).norm(dim=-1).max() < 0.003


def test_without_any_contact_nothing_changes():
    source = stick_body()
    motion = BUILTIN_MOTIONS["walk"](source)
    flying = toes_of(source, motion) + torch.arange(len(motion))[:, None, None] * 0.1
    assert kept_contacts(motion, source.joints.double(), -1.17, flying) is motion
