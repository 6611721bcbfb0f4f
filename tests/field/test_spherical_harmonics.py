import math

import numpy as np
import torch
from scipy.special import sph_harm_y

from twofold.field.spherical_harmonics import spherical_harmonics


def test_functions_are_the_real_harmonics_of_scipy(generator):
    x = torch.nn.functional.normalize(torch.randn(20, 3, generator=generator, dtype=torch.float64), dim=1)
    found = spherical_harmonics(x)
    polar, azimuth = torch.arccos(x[:, 2]).numpy(), torch.atan2(x[:, 1], x[:, 0]).numpy()
    for degree in range(4):
        for order in range(-degree, degree + 1):
            complex_value = sph_harm_y(degree, abs(order), polar, azimuth)  # with (-1)^m inside
            if order == 0:
                expected = complex_value.real
            else:
                expected = math.sqrt(2) * (complex_value.real if order > 0 else complex_value.imag)
            np.testing.assert_allclose(found[:, degree * degree + degree + order], expected, atol=1e-12)


def test_functions_are_orthonormal_on_the_sphere():
    heights, weights = np.polynomial.legendre.leggauss(8)
    turns = torch.arange(16, dtype=torch.float64) * 2 * math.pi / 16
    z = torch.from_numpy(heights)[:, None].expand(8, 16)
    side = (1 - z**2).sqrt()
    values = spherical_harmonics(torch.stack([side * turns.cos(), side * turns.sin(), z], -1)).flatten(0, 1)
    share = torch.from_numpy(weights)[:, None].expand(8, 16).flatten() * 2 * math.pi / 16
    torch.testing.assert_close(values.T @ (share[:, None] * values), torch.eye(16, dtype=torch.float64))
