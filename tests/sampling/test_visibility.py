import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from packed_samples import packed
from torch import Tensor

from twofold.sampling.visibility import possible_samples, seen_samples
from twofold.volume.rendering import composite_weights
from twofold.volume.samples import Samples

COUNTS = st.lists(st.integers(0, 6), min_size=1, max_size=6)


@pytest.mark.parametrize("least", [1e-3, 0.05])
def test_following_rays_from_the_front_finds_the_samples_that_count(least: float) -> None:
    generator = torch.Generator().manual_seed(3)
    counts = torch.tensor([0, 40, 1, 7, 25, 0, 60])
    ray_index = torch.repeat_interleave(torch.arange(7), counts)
    depth = torch.cat([torch.linspace(1.0, 2.0, int(n)) for n in counts])
    samples = Samples(ray_index, depth, torch.full_like(depth, 0.01))
    density = torch.rand(len(depth), generator=generator).pow(4) * 400
    asked = torch.zeros(len(depth), dtype=torch.long)

    def answer(index: Tensor) -> Tensor:
        asked[index] += 1
        return density[index]

    seen = seen_samples(samples, answer, 7, least)
    assert torch.equal(seen, composite_weights(density, samples) > least)
    assert asked.max() == 1
    assert asked.sum() < len(depth)


def test_compiled_bookkeeping_is_that_of_the_twin() -> None:
    samples, density = packed([3, 0, 60, 25, 1], 4)
    double = Samples(samples.ray_index, samples.depth.double(), samples.delta.double())
    asked: list[list[int]] = []

    def answer(index: Tensor) -> Tensor:
        asked.append(sorted(index.tolist()))
        return density[index]

    first = seen_samples(samples, answer, 5, 0.01)
    stretches, asked = asked, []
    second = seen_samples(double, lambda index: answer(index).double(), 5, 0.01)
    assert torch.equal(first, second)
    assert stretches == asked


@given(counts=COUNTS, seed=st.integers(0, 1000), doubt=st.floats(0, 1), least=st.sampled_from([1e-3, 0.05, 0.3]))
def test_samples_that_count_are_possible_however_little_is_known_of_the_densities(counts, seed, doubt, least):
    samples, density = packed(counts, seed)
    fewest, most = density * (1 - doubt), density * (1 + 3 * doubt)
    possible = possible_samples(samples, fewest, most, least)
    assert (possible | (composite_weights(density, samples) <= least)).all()


@given(counts=COUNTS, seed=st.integers(0, 1000))
def test_with_known_densities_only_samples_that_count_are_possible(counts, seed):
    samples, density = packed(counts, seed)
    assert torch.equal(possible_samples(samples, density, density, 0.05), composite_weights(density, samples) > 0.05)


def test_behind_what_is_surely_opaque_nothing_is_possible():
    samples = Samples(torch.zeros(4, dtype=torch.long), torch.arange(4.0), torch.ones(4))
    fewest, most = torch.tensor([0.0, 20.0, 0.0, 0.0]), torch.tensor([0.0, torch.inf, torch.inf, 5.0])
    assert possible_samples(samples, fewest, most, 1e-3).tolist() == [False, True, False, False]
