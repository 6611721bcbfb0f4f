"""The image of a coverage."""

import dataclasses

import numpy as np
import torch

from twofold.capture.coverage import coverage_of
from twofold.capture.coverage_map import coverage_map


def test_front_is_blue_and_back_orange_of_a_person_filmed_from_the_front(person):
    image = coverage_map(person, coverage_of(person), 120).astype(int)
    assert image.shape == (120, 240, 3)
    front, back = image[:, :120], image[:, 120:]
    bluer = [int((half[..., 2] > half[..., 0] + 30).sum()) for half in (front, back)]
    redder = [int((half[..., 0] > half[..., 2] + 30).sum()) for half in (front, back)]
    assert bluer[0] > 3 * redder[0]
    assert redder[1] > 3 * bluer[1]
    assert (image[0] == 255).all(), "nothing but background in the corners"


def test_silhouettes_of_both_sides_mirror_each_other(person):
    coverage = dataclasses.replace(coverage_of(person), weight=torch.ones_like(coverage_of(person).weight))
    image = coverage_map(person, coverage, 120)
    shape = (image != 255).any(-1)
    assert 0.05 < shape.mean() < 0.5
    assert np.mean(shape[:, :120] == shape[:, 120:][:, ::-1]) > 0.98
