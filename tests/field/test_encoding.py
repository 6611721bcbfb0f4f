import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from twofold.field.encoding import encoding_pullback, encoding_size, fourier_encoding, hann_encoding, open_hann_bands


def literal_encoding(x, octaves, include_pi):
    """Point by point, as the formula is printed."""
    rows = []
    for point in x.tolist():
        row = list(point)
        for k in range(octaves):
            frequency = 2**k * (math.pi if include_pi else 1)
            row += [math.sin(frequency * p) for p in point] + [math.cos(frequency * p) for p in point]
        rows.append(row)
    return torch.tensor(rows, dtype=x.dtype)


@pytest.mark.parametrize("include_pi", [False, True])
@pytest.mark.parametrize("octaves", [0, 1, 5, 10])
def test_encoding_is_the_printed_formula(octaves, include_pi):
    x = torch.randn(7, 3, dtype=torch.float64)
    encoded = fourier_encoding(x, octaves, include_pi)
    assert encoded.shape[-1] == encoding_size(octaves)
    torch.testing.assert_close(encoded, literal_encoding(x, octaves, include_pi))


def test_sizes_are_those_of_the_table():
    assert [encoding_size(octaves) for octaves in (4, 5, 6, 8, 10)] == [27, 33, 39, 51, 63]


@pytest.mark.parametrize("include_pi", [False, True])
@settings(max_examples=15, deadline=None)
@given(octaves=st.integers(0, 8), seed=st.integers(0, 10_000))
def test_pullback_is_the_transposed_jacobian(include_pi, octaves, seed):
    generator = torch.Generator().manual_seed(seed)
    x = torch.randn(4, 3, dtype=torch.float64, generator=generator).requires_grad_()
    encoded = fourier_encoding(x, octaves, include_pi)
    cotangent = torch.randn(encoded.shape, dtype=torch.float64, generator=generator)
    (automatic,) = torch.autograd.grad(encoded, x, cotangent)
    torch.testing.assert_close(encoding_pullback(encoded, cotangent, include_pi), automatic)


def test_pullback_is_itself_differentiable():
    x = torch.randn(3, 3, dtype=torch.float64, requires_grad=True)
    cotangent = torch.randn(3, 15, dtype=torch.float64, requires_grad=True)

    def pulled(x, cotangent):
        return encoding_pullback(fourier_encoding(x, 2, True), cotangent, True)

    assert torch.autograd.gradcheck(pulled, (x, cotangent))


def test_rows_of_other_sizes_are_encoded_alike():
    x = torch.rand(2, 7, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    encoded = fourier_encoding(x, 3, include_pi=False)
    expected = torch.cat([x] + [wave(2**k * x) for k in range(3) for wave in (torch.sin, torch.cos)], 1)
    torch.testing.assert_close(encoded, expected)
    assert encoded.shape[1] == encoding_size(3, 7)


@pytest.mark.parametrize("open_bands", [0.0, 0.3, 2.0, 2.6, 4.0])
def test_hann_windows_open_one_after_the_other(open_bands):
    x = torch.rand(5, 3, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    columns = []
    for k in range(4):
        window = (1 - math.cos(math.pi * min(max(open_bands - k, 0), 1))) / 2
        columns += [window * torch.sin(2**k * x), window * torch.cos(2**k * x)]
    torch.testing.assert_close(hann_encoding(x, 4, open_bands), torch.cat(columns, 1))


def test_bands_open_linearly_between_two_steps():
    assert open_hann_bands(0, 10, 50, 6) == 0
    assert open_hann_bands(10, 10, 50, 6) == 0
    assert open_hann_bands(50, 10, 50, 6) == 6
