"""Corrections of poses: where they apply, what learns, and how large they say they are."""

import math
from types import SimpleNamespace

import pytest
import torch

from twofold.deform.pose_refinement import PoseRefinement

ALL = ("root", "body", "translation", "shape")
TIMES = torch.tensor([3, 7, 20])


def refinement(parts=ALL, filled=True):
    module = PoseRefinement(TIMES, 4, parts)
    if filled:
        with torch.no_grad():
            for table in module.parameters():
                table.copy_(torch.randn(table.shape))
    return module


def some_pose():
    generator = torch.Generator().manual_seed(1)
    return torch.randn(24, 3, generator=generator), torch.randn(3, generator=generator)


def test_it_starts_by_changing_nothing():
    pose, translation = some_pose()
    module = refinement(filled=False)
    for time in TIMES.tolist():
        corrected, moved = module(time, pose, translation)
        assert torch.equal(corrected, pose)
        assert torch.equal(moved, translation)
    assert not module.shape.any()
    assert set(module.change().values()) == {0}


@pytest.mark.parametrize("row", range(3))
def test_each_frame_gets_its_own_correction(row):
    (pose, translation), module = some_pose(), refinement()
    corrected, moved = module(int(TIMES[row]), pose, translation)
    torch.testing.assert_close(corrected[0], pose[0] + module.root[row, 0])
    for joint in range(1, 24):
        torch.testing.assert_close(corrected[joint], pose[joint] + module.body[row, joint - 1])
    torch.testing.assert_close(moved, translation + module.translation[row])


def test_unknown_frames_stay_as_they_are():
    pose, translation = some_pose()
    corrected, moved = refinement()(4, pose, translation)
    assert corrected is pose
    assert moved is translation


def test_without_parts_nothing_is_corrected():
    pose, translation = some_pose()
    assert refinement(())(3, pose, translation)[0] is pose


@pytest.mark.parametrize("parts", [ALL, ("root",), ("body", "translation"), ("shape",), ()])
def test_only_the_named_parts_learn(parts):
    module = refinement(parts)
    assert {name for name, table in module.named_parameters() if table.requires_grad} == set(parts)


def test_gradient_reaches_the_frame_alone():
    (pose, translation), module = some_pose(), refinement()
    corrected, moved = module(7, pose, translation)
    ((2 * corrected).sum() + (3 * moved).sum()).backward()
    for table, slope in ((module.root, 2), (module.body, 2), (module.translation, 3)):
        expected = torch.zeros_like(table)
        expected[1] = slope
        assert torch.equal(table.grad, expected)


def test_change_is_the_root_mean_square():
    module = refinement()
    tables = {"root": module.root, "body": module.body, "translation": module.translation}
    for name, table in tables.items():
        vectors = table.detach().reshape(-1, 3).tolist()
        expected = math.sqrt(sum(x * x + y * y + z * z for x, y, z in vectors) / len(vectors))
        assert module.change()[name] == pytest.approx(expected, rel=1e-5)
    expected = math.sqrt(sum(b * b for b in module.shape.tolist()))
    assert module.change()["shape"] == pytest.approx(expected, rel=1e-5)


def test_neighbours_count_by_when_they_were_taken():
    refinement = PoseRefinement(torch.tensor([0, 4]), 10, ("translation",))
    refinement.translation.data[1].fill_(1.0)
    known = SimpleNamespace(times=torch.tensor([0, 4]), poses=torch.zeros(2, 24, 3), translations=torch.zeros(2, 3))
    given = torch.zeros(24, 3), torch.zeros(3)

    def moved(max_gap, seconds):
        return refinement.at(1, *given, known, max_gap, seconds.__getitem__)[1].tolist()

    late = (0.0, 0.75, 0.8, 0.9, 1.0)
    assert moved(1.0, late) == pytest.approx([0.75] * 3)
    assert moved(0.9, late) == [0.0] * 3, "they are a second apart"
