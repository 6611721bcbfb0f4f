import itertools
import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from twofold.sampling.importance import blurred_weights, importance_depths


def literal_depths(depths, weights, count):
    """Quantiles of the piecewise constant density, by walking along the sections."""
    middles = [(a + b) / 2 for a, b in itertools.pairwise(depths)]
    blurred = [
        (max(weights[i - 1], weights[i]) + max(weights[i], weights[i + 1])) / 2 + 0.01
        for i in range(1, len(weights) - 1)
    ]
    found = []
    for k in range(count):
        left = k / (count - 1) * sum(blurred)
        for low, high, w in zip(middles[:-1], middles[1:], blurred, strict=True):
            if left <= w + 1e-12:
                found.append(low + min(left / w, 1) * (high - low))
                break
            left -= w
    return found


@given(st.lists(st.floats(0, 1), min_size=4, max_size=12))
def test_depths_are_the_quantiles_of_the_blurred_weights(weights):
    depths = [0.5 + 0.1 * i + 0.02 * math.sin(i) for i in range(len(weights))]
    tensors = (torch.tensor([row], dtype=torch.float64) for row in (depths, weights))
    found = importance_depths(*tensors, 7)[0].tolist()
    assert found == pytest.approx(literal_depths(depths, weights, 7), abs=1e-9)


def test_more_depths_go_where_the_weight_is(generator):
    depths = torch.linspace(0, 1, 21)[None]
    weights = torch.zeros(1, 21)
    weights[0, 10] = 1
    for source in (None, generator):
        found = importance_depths(depths, weights, 400, source)
        assert ((found - 0.5).abs() < 0.08).float().mean() > 0.85
        assert found.min() >= 0.02
        assert found.max() <= 0.98


def test_blurring_reaches_one_sample_to_each_side():
    weights = torch.tensor([[0.0, 0, 0, 1, 0, 0, 0]])
    assert blurred_weights(weights)[0].tolist() == pytest.approx([0.01, 0.51, 1.01, 0.51, 0.01])
