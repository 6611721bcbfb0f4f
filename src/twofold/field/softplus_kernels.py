"""The rounded rectifier of `softplus`, and its reverse pass, in one compiled loop each, for CPUs.

Arrays are [1 n] with n at least 16, of single precision or, as 16-bit integers, of bfloat16 (see `kernels.lanes`).
"""

# pyright: reportMissingParameterType=false

import numpy as np

from twofold.kernels.lanes import (
    LANES,
    exponential,
    fill,
    larger,
    load,
    minus,
    plus,
    quotient,
    scaled,
    store,
    times_plus,
    where_positive,
)
from twofold.kernels.parallel import compiled

_LOGARITHM = tuple(
    np.float32(c)
    for c in (
        0.005186113803, -0.029210865641, 0.077541657207, -0.135840824508, 0.190560424486, -0.248256788296,
        0.333160162999, -0.499992563826, 0.999999921004,
    )
)  # fmt: skip
"""Of log(1 + e) / e for e in 0..1, the highest power first: Chebyshev interpolation, 6e-8 off."""
_ZERO, _ONE = np.float32(0), np.float32(1)
_DEEP = np.float32(69)
"""Below minus this many e-foldings the result counts as zero, so that nothing denormal arises."""
_FLAT = np.float32(6e-8)
"""Slopes below this count as zero, too."""


@compiled
def softplus(z, sharpness, value, slope, begin, end):  # noqa: ANN001, ANN201
    """value = log(1 + e^(b z)) / b, slope = 1 / (1 + e^(-b z)) with the sharpness b."""
    last, one, flat = z.shape[1] - LANES, fill(_ONE), fill(_ONE / sharpness)
    for first in range(begin, end, LANES):
        i = min(first, last)
        x = load(z, 0, i)
        v = scaled(sharpness, x)
        below = minus(fill(_ZERO), larger(v, minus(fill(_ZERO), v)))
        e = where_positive(plus(below, fill(_DEEP)), exponential(below))
        log = fill(_LOGARITHM[0])
        for c in range(1, len(_LOGARITHM)):
            log = times_plus(log, e, fill(_LOGARITHM[c]))
        # x - x, so that what is no number stays none.
        bent = times_plus(times_plus(log, e, fill(_ZERO)), flat, minus(x, x))
        store(value, 0, i, plus(bent, larger(x, fill(_ZERO))))
        above = quotient(one, plus(one, e))
        under = times_plus(e, above, fill(_ZERO))
        share = plus(minus(under, where_positive(v, under)), where_positive(v, above))
        store(slope, 0, i, where_positive(minus(share, fill(_FLAT)), share))


@compiled
def softplus_backward(by_value, by_slope, slope, sharpness, out, begin, end):  # noqa: ANN001, ANN201
    """out = (by_value + by_slope b (1 - slope)) slope."""
    last, one = slope.shape[1] - LANES, fill(_ONE)
    for first in range(begin, end, LANES):
        i = min(first, last)
        share = load(slope, 0, i)
        bent = times_plus(scaled(sharpness, load(by_slope, 0, i)), minus(one, share), load(by_value, 0, i))
        store(out, 0, i, times_plus(bent, share, fill(_ZERO)))
