"""Epochs of a training: how long they are, which images they show, when rates fall."""

from dataclasses import replace

import pytest
import torch

from twofold.methods.factorized_recipes import quick, released
from twofold.recipe import TrainingConfig
from twofold.training.loop import epoch_steps, frame_order, mixed, rate_factor


def shuffled(seed, epoch, frames):
    generator = torch.Generator().manual_seed(mixed(seed, 7, epoch))
    return torch.randperm(frames, generator=generator).tolist()


@pytest.mark.parametrize("frames", [1, 2, 4, 5, 379])
def test_released_epochs_are_whole_steps_that_fill_up_with_the_first_images_again(frames):
    recipe = released()
    length = (frames + 1) // 2
    assert epoch_steps(recipe.training, frames) == length
    shown = [frame for step in range(3 * length) for frame in frame_order(recipe.training, recipe.seed, frames, step)]
    for epoch in range(3):
        order = shuffled(0, epoch, frames)
        expected = order + order[: 2 * length - frames]
        assert shown[2 * length * epoch : 2 * length * (epoch + 1)] == expected


def test_epochs_by_images_show_each_exactly_once_across_steps():
    recipe = replace(quick(), training=replace(quick().training, images_per_step=2))
    shown = [frame for step in range(15) for frame in frame_order(recipe.training, recipe.seed, 5, step)]
    assert shown == [frame for epoch in range(6) for frame in shuffled(0, epoch, 5)]
    assert epoch_steps(recipe.training, 5) == 2.5


@pytest.mark.parametrize(("frames", "length"), [(379, 190), (378, 189)])
def test_released_rates_halve_at_200_and_400_epochs_of_whole_steps(frames, length):
    config = released().training
    factors = [rate_factor(config, step, frames) for step in range(401 * length)]
    expected = [1.0] * (200 * length) + [0.5] * (200 * length) + [0.25] * length
    assert factors == expected


def test_rates_by_images_halve_wherever_in_a_step_the_epoch_ends():
    config = TrainingConfig(milestones=(1,))
    assert [rate_factor(config, step, 5) for step in range(4)] == [1, 1, 1, 0.5]
