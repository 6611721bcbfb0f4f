from dataclasses import replace

import numpy as np
import pytest
import torch

from twofold.errors import TwofoldError
from twofold.methods.base import Avatar
from twofold.methods.subject import Subject


@pytest.fixture(scope="module")
def subject(person):
    return Subject.of(person)


def test_subject_has_every_training_frame_once_and_in_order(person):
    doubled = replace(person, splits={**person.splits, "train": person.train[::-1] + person.train[:2]})
    subject = Subject.of(doubled)
    assert subject.times.tolist() == [0, 1, 2, 3, 4]
    for row, frame in enumerate(person.train):
        torch.testing.assert_close(subject.poses[row], frame.pose, rtol=0, atol=0)
        torch.testing.assert_close(subject.translations[row], frame.translation, rtol=0, atol=0)


def test_subject_knows_nothing_of_test_frames(person, subject):
    without = replace(person, splits={"train": person.train, "novel_view": (), "novel_pose": ()})
    again = Subject.of(without).arrays()
    assert all(np.array_equal(array, again[name]) for name, array in subject.arrays().items())


def test_scene_scale_puts_the_furthest_camera_just_inside_a_sphere_of_radius_three(person, subject):
    pelvis = torch.stack([frame.translation for frame in person.train]).mean(0) + person.body.joints[0]
    furthest = max(float((frame.camera.center - pelvis).norm()) for frame in person.train)
    assert subject.scene_scale * furthest == pytest.approx(3 / 1.1, rel=1e-6)


def test_subject_reads_back_bit_for_bit(subject):
    arrays = subject.arrays()
    again = Subject.from_arrays(arrays, "here").arrays()
    assert arrays.keys() == again.keys()
    assert all(np.array_equal(arrays[name], again[name]) and arrays[name].dtype == again[name].dtype for name in arrays)


@pytest.mark.parametrize(
    ("name", "value", "words"),
    [
        ("poses", None, "lacks poses"),
        ("poses", np.zeros((4, 24, 3), np.float32), "poses"),
        ("poses", np.full((5, 24, 3), np.nan, np.float32), "finite"),
        ("times", np.zeros((5, 1), np.int64), "times"),
        ("translations", np.zeros((5, 2), np.float32), "translations"),
        ("scene_scale", np.zeros(2), "scene_scale"),
        ("betas", np.array(["a"]), "betas"),
        ("body_joints", np.zeros((23, 3), np.float32), "joints"),
        ("body_template", None, "template"),
    ],
)
def test_damaged_subject_is_named_by_place_and_part(subject, name, value, words):
    arrays = {**subject.arrays(), name: value}
    if value is None:
        del arrays[name]
    with pytest.raises(TwofoldError, match=words) as error:
        Subject.from_arrays(arrays, "somewhere/subject.npz")
    assert "somewhere/subject.npz" in str(error.value)


def test_avatar_alone_cannot_be_built():
    with pytest.raises(TypeError, match="abstract"):
        Avatar()  # pyright: ignore[reportAbstractUsage]
