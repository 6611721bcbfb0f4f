"""Estimators see the person that is meant, and nobody else."""

import numpy as np
import pytest
from made_clips import grey
from PIL import Image

from twofold.errors import TwofoldError
from twofold.prepare.detect.people import Person
from twofold.prepare.detect.person import (
    GREY,
    JOINT_LINES,
    around_lines,
    around_mask,
    around_person,
    chosen_person,
    following,
    only,
)


def person(column, row=50.0, size=40.0):
    return Person(np.array([float(column), row]), np.array([column, row - 0.4 * size]), float(size), 0.9)


def test_only_the_region_is_shown():
    image = grey(10, 20, 30)
    region = np.zeros((20, 30), bool)
    region[5:10, 5:10] = True
    shown = only(image, region)
    assert (shown[region] == 10).all()
    assert (shown[~region] == GREY).all()
    assert only(image, None) is image


def test_a_masks_region_holds_it_with_room_and_no_more():
    mask = np.zeros((400, 600), np.uint8)
    mask[100:300, 100:160] = 255
    region = around_mask(mask)
    assert region[mask > 0].all()
    assert region[90, 130]
    assert region[200, 175]
    assert not region[200, 200:].any()
    assert not around_mask(np.zeros((40, 60), np.uint8)).any()


def test_the_region_of_joints_is_a_thick_skeleton():
    points = np.full((24, 2), np.nan)
    points[[0, 3, 6]] = [[100, 100], [100, 80], [100, 60]]
    region = around_lines(points, JOINT_LINES, 200, 200)
    assert region[60:101, 100].all()
    assert not region[:, 130:].any()
    assert around_lines(np.full((24, 2), np.nan), JOINT_LINES, 200, 200) is None


def test_the_largest_or_the_one_from_the_left_is_chosen():
    people = [person(200.0, size=50), person(20.0), person(110.0, size=45), person(150.0, size=10)]
    assert chosen_person(people, "largest", "clip") is people[0]
    assert [chosen_person(people, n, "clip") for n in (1, 2, 3)] == [people[1], people[2], people[0]]
    with pytest.raises(TwofoldError, match=r"--person 4 was asked for, and the first image of clip .* has 3"):
        chosen_person(people, 4, "clip")
    assert chosen_person([], 2, "clip") is None


def test_one_person_is_followed_past_another_and_through_a_gap():
    seen = [[person(40 + 4 * t), person(160 - 4 * t, size=44)] for t in range(20)]
    seen[9] = []
    region = following(1, lambda image: seen[int(image[0, 0, 0])], "clip")
    for time in range(20):
        found = region(grey(time, 100, 200))
        assert found[50, 40 + 4 * min(time, 19)] or time == 9
        other = round(160 - 4 * time)
        if abs(other - 40 - 4 * time) > 30 and time != 9:
            assert not found[50, other]


def test_what_is_nearer_to_somebody_else_is_theirs():
    region = around_person(person(80.0), [person(110.0)], 100, 200)
    assert region[50, 80]
    assert not region[50, 97:].any()
    assert around_person(person(80.0), [], 100, 200)[50, 100]


def test_a_mask_of_one_of_two_people_points_at_this_one(tmp_path):
    """Its region leaves nothing of a second person a body's width away."""
    mask = np.zeros((200, 300), np.uint8)
    mask[40:180, 60:100] = 255
    image = np.asarray(Image.new("RGB", (300, 200), (9, 9, 9)))
    shown = only(image, around_mask(mask))
    assert (shown[40:180, 140:180] == GREY).all()
