"""Accelerations at even and uneven times."""

import torch
from hypothesis import given
from hypothesis import strategies as st

from twofold.geometry.accelerations import SHORTEST, accelerations


@given(st.lists(st.floats(0.05, 0.19), min_size=4, max_size=12), st.integers(1, 2), st.integers(0, 2**31))
def test_a_parabola_has_its_own_acceleration_whatever_the_times(gaps: list[float], reach: int, seed: int) -> None:
    if len(gaps) < 2 * reach:
        return
    seconds = torch.cat([torch.zeros(1), torch.tensor(gaps).cumsum(0)]).double()
    generator = torch.Generator().manual_seed(seed)
    start, speed, bend = torch.randn(3, 2, 3, generator=generator, dtype=torch.float64)
    at = seconds[:, None, None]
    found = accelerations(start + speed * at + bend * at**2, len(gaps) / float(seconds[-1]), seconds, reach)
    assert found.shape == (len(gaps) + 1 - 2 * reach, 2, 3)
    assert torch.allclose(found, (2 * bend).expand_as(found), atol=1e-5)


def test_even_times_give_the_usual_second_difference(generator: torch.Generator) -> None:
    values = torch.randn(9, 4, generator=generator, dtype=torch.float64)
    for reach in (1, 3):
        even = accelerations(values, 12.5, None, reach)
        expected = (values[2 * reach :] - 2 * values[reach:-reach] + values[: -2 * reach]) * (12.5 / reach) ** 2
        assert torch.allclose(even, expected)
        assert torch.allclose(accelerations(values, 12.5, torch.arange(9).double() / 12.5, reach), expected)


def test_equal_time_stamps_do_not_make_it_infinite() -> None:
    values = torch.tensor([0.0, 1.0, 2.0])
    assert accelerations(values, 10.0, torch.tensor([0.0, 0.0, 0.1])).abs().max() <= 1 / (SHORTEST / 10) ** 2
