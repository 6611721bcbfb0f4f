"""HumanNeRF's recipes, and that a training of it resumes to the same numbers."""

import math
from dataclasses import replace

import pytest
import torch
from small_recipes import CASES

from twofold.config import to_dict
from twofold.methods.humannerf import humannerf, humannerf_fast
from twofold.methods.subject import Subject
from twofold.methods.table import recipe_from_dict, recipe_to_dict
from twofold.training.loop import rate_factor, train
from twofold.training.run import read_checkpoint


def test_recipe_has_the_authors_numbers():
    recipe = humannerf()
    training, pixels, skeletal, rates = (
        recipe.training,
        recipe.training.pixels,
        recipe.method.skeletal,
        recipe.method.rates,
    )
    assert (training.steps, training.images_per_step, training.clip, training.adam_betas) == (
        400_000,
        1,
        0,
        (0.9, 0.999),
    )
    assert (pixels.rays, pixels.patches, pixels.patch_size, pixels.patch_on_subject) == (0, 6, 32, 0.8)
    assert (rates.networks, rates.volume, rates.motion, rates.pose) == (5e-4, 5e-5, 5e-5, 5e-5)
    assert (skeletal.samples, skeletal.lpips, skeletal.squared_error) == (128, 1.0, 0.2)
    assert (skeletal.correct_from, skeletal.motion_from, skeletal.motion_full) == (0, 10_000, 50_000)
    assert skeletal.guard_frames == 16
    for step in (0, 1000, 399_999):
        assert rate_factor(training, step, 10) == pytest.approx(0.1 ** (step / 500_000))


def test_fast_recipe_changes_no_equation():
    """Numbers of samples, steps and rates differ, the unit of the density, and which samples are left out.

    See docs/methods/humannerf.md; that a unit changes nothing else, test_skeletal.py shows.
    """
    first, second = (to_dict(recipe().method.skeletal) for recipe in (humannerf, humannerf_fast))
    assert {name for name in first if first[name] != second[name]} == {
        "samples", "min_likelihood", "min_weight", "hidden_dtype", "volume_every", "density_unit", "motion_from",
        "motion_full", "guard_steps", "guard_frames", "guard_size",
    }  # fmt: skip


@pytest.mark.parametrize("recipe", [humannerf, humannerf_fast])
def test_recipes_are_stored_and_read_back(recipe):
    assert recipe_from_dict(recipe_to_dict(recipe()), "recipe.json") == recipe()


@pytest.mark.slow
def test_parameters_are_as_many_as_the_authors(person):
    avatar = humannerf().method.build(Subject.of(person), 0)
    assert sum(p.numel() for p in avatar.parameters()) == 64_417_381


@pytest.mark.slow
def test_interrupted_training_resumes_to_the_same_numbers(person, tmp_path):
    start = CASES["humannerf_fast"]
    skeletal = replace(start.method.skeletal, motion_from=1, motion_full=5, volume_every=3, guard_steps=(2,))
    training = replace(start.training, steps=6, checkpoint_every=4, preview_every=0)
    recipe = replace(start, method=replace(start.method, skeletal=skeletal), training=training)
    cpu = torch.device("cpu")
    train(person, recipe, tmp_path / "whole", cpu)

    def interrupt(progress):
        if progress.step == 5:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        train(person, recipe, tmp_path / "parts", cpu, progress=interrupt)
    train(person, recipe, tmp_path / "parts", cpu, resume=True)
    whole, parts = (read_checkpoint(tmp_path / name)[0] for name in ("whole", "parts"))
    assert set(whole) == set(parts)
    assert all(torch.equal(whole[name], parts[name]) for name in whole)
    assert math.isclose(float(whole["avatar.trained_step"]), 5)
