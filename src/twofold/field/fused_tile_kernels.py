"""What is known about a tile of samples of the two-branch grid field; `fused_kernels` has the passes over all samples.

Legend: T samples of a tile, of which the first `count` are real; `grids` are prior, low and high one; `nets` are
`fused_layer_kernels.Net` in the order low distance, low colour, high distance, high colour; `t` is a `Tile`, `u` its
`Cotangents`.
"""

# pyright: reportMissingParameterType=false

from typing import Any, NamedTuple

import numpy as np

from twofold.field.fused_layer_kernels import (
    FRESH,
    MORE,
    PLAIN,
    RECTIFY,
    START,
    add_scaled,
    exponentials,
    multiply,
    pull_down,
    pull_first,
    ready,
    take_active,
    upper_layers,
)
from twofold.field.fused_lookup_kernels import lookup, lookup_prior, lookup_with_slopes, pulled
from twofold.kernels.lanes import LANES, apart
from twofold.kernels.parallel import compiled_part

TILE = 64
"""Samples whose hidden layers fit into a core's own cache."""
TENTH = np.float32(0.1)
ONE = np.float32(1)
_TINY = np.float32(1e-12)
FEATURES, COLORS = np.int64(1), np.int64(3)
"""Where the features begin in the answers of distance and of colour networks, which is how many colours there are."""
WITH_SLOPES, WITHOUT_SLOPES = np.bool_(True), np.bool_(False)
"""Whether the derivatives of the features are wanted."""


class Tile(NamedTuple):
    """What is known about the samples of a tile.

    Attributes:
        prior, low, high: interpolated numbers of the three grids.
        prior_slopes: [T 3]; low_slopes, high_slopes: [3 T LC].
        gate: [T].
        tape: hidden layers, [net 2 T width].
        answers: of the four nets.
        harmonics: polynomials of the normals, [T 9] and zeros.
        light: [3 T].
    """

    prior: Any
    low: Any
    high: Any
    prior_slopes: Any
    low_slopes: Any
    high_slopes: Any
    gate: Any
    tape: Any
    answers: Any
    harmonics: Any
    light: Any


class Cotangents(NamedTuple):
    """Cotangents of the nets of a tile: of the answers, of the hidden layers [net 2 T width], of the inputs."""

    answers: Any
    hidden: Any
    inputs: Any


@compiled_part
def new_tile(grids, nets):  # noqa: ANN001, ANN201
    """Room for a tile, all zeros, so that what stands behind the last sample is finite."""
    apart()
    low = grids[1][0].shape[1] * grids[1][2].shape[0]
    high = grids[2][0].shape[1] * grids[2][2].shape[0]
    return Tile(
        np.zeros((TILE, grids[0][0].shape[1]), np.float32), np.zeros((TILE, low), np.float32),
        np.zeros((TILE, high), np.float32), np.zeros((TILE, 3), np.float32), np.zeros((3, TILE, low), np.float32),
        np.zeros((3, TILE, high), np.float32), np.zeros(TILE, np.float32),
        np.zeros((4, 2, TILE, nets[0].up2.shape[1]), np.float32), _answers(nets),
        np.zeros((TILE, LANES), np.float32), np.zeros((3, TILE), np.float32),
    )  # fmt: skip


@compiled_part
def new_cotangents(nets):  # noqa: ANN001, ANN201
    """Room for the cotangents of a tile."""
    apart()
    inputs = (
        np.zeros((TILE, nets[0].down1.shape[1]), np.float32), np.zeros((TILE, nets[1].down1.shape[1]), np.float32),
        np.zeros((TILE, nets[2].down1.shape[1]), np.float32), np.zeros((TILE, nets[3].down1.shape[1]), np.float32),
    )  # fmt: skip
    return Cotangents(_answers(nets), np.zeros((4, 2, TILE, nets[0].up2.shape[1]), np.float32), inputs)


@compiled_part
def _answers(nets):  # noqa: ANN001, ANN202
    return (
        np.zeros((TILE, nets[0].up3.shape[1]), np.float32), np.zeros((TILE, nets[1].up3.shape[1]), np.float32),
        np.zeros((TILE, nets[2].up3.shape[1]), np.float32), np.zeros((TILE, nets[3].up3.shape[1]), np.float32),
    )  # fmt: skip


@compiled_part
def all_ready(nets):  # noqa: ANN001, ANN201
    """The four nets, from their weights and biases."""
    apart()
    return ready(nets[0]), ready(nets[1]), ready(nets[2]), ready(nets[3])


@compiled_part
def find_geometry(x, count, grids, nets, gate_width, shared, slopes, t):  # noqa: ANN001, ANN201
    """Features, both distance networks, the prior's distance and the gate of `count` points, [T 3]."""
    apart()
    lookup_prior(x, count, grids[0], t.prior, t.prior_slopes)
    if slopes:
        lookup_with_slopes(x, count, grids[1], t.low, t.low_slopes)
        lookup_with_slopes(x, count, grids[2], t.high, t.high_slopes)
    else:
        lookup(x, count, grids[1], t.low)
        lookup(x, count, grids[2], t.high)
    low = t.low.shape[1]
    multiply(t.low, START, low, nets[0].up1, START, nets[0].bias1, FRESH, RECTIFY, t.tape[0, 0], t.tape[0, 0], count)
    upper_layers(nets[0], t.tape[0], t.answers[0], count)
    for s in range(count):
        ratio = (t.prior[s, 0] + TENTH * t.answers[0][s, 0]) / gate_width
        square = ratio * ratio
        t.gate[s] = ONE / (ONE + square * square)
        if t.prior.shape[1] > 1:  # how well the surface there was observed
            t.gate[s] *= t.prior[s, 1]
    _first_layer(t.high, t.high.shape[1], t.answers[0], FEATURES, shared, nets[2], t.tape[2, 0], count)
    upper_layers(nets[2], t.tape[2], t.answers[2], count)


@compiled_part
def _first_layer(own, own_columns, handed, at, handed_columns, net, out, count):  # noqa: ANN001, ANN202
    """A first hidden layer of a tile's own features and of what another net hands over, from a column on."""
    multiply(own, START, own_columns, net.up1, START, net.bias1, FRESH, PLAIN, out, out, count)
    multiply(handed, at, handed_columns, net.up1, own_columns, net.bias1, MORE, RECTIFY, out, out, count)


@compiled_part
def find_colors(count, nets, shared, t):  # noqa: ANN001, ANN201
    """Both colour networks, after `find_geometry`; the base branch's first three answers become colours."""
    apart()
    _first_layer(t.low, t.low.shape[1], t.answers[0], FEATURES, shared, nets[1], t.tape[1, 0], count)
    upper_layers(nets[1], t.tape[1], t.answers[1], count)
    for s in range(count):
        take_active(t.answers[1], s, COLORS, t.answers[1], COLORS, t.answers[1], shared)
        for c in range(3):
            t.light[c, s] = t.answers[1][s, c]
    exponentials(t.light, -ONE)
    for s in range(count):
        for c in range(3):
            t.answers[1][s, c] = ONE / (ONE + t.light[c, s])
    own, net, out = t.high.shape[1], nets[3], t.tape[3, 0]
    multiply(t.high, START, own, net.up1, START, net.bias1, FRESH, PLAIN, out, out, count)
    multiply(t.answers[2], FEATURES, shared, net.up1, own, net.bias1, MORE, PLAIN, out, out, count)
    multiply(t.answers[1], COLORS, shared, net.up1, own + shared, net.bias1, MORE, RECTIFY, out, out, count)
    upper_layers(net, t.tape[3], t.answers[3], count)


@compiled_part
def find_light(gradient, turn, law, first, count, t):  # noqa: ANN001, ANN201
    """Harmonics of a tile's normals, and their light by the law [3 9]; gradients are canonical, of all samples."""
    apart()
    for s in range(count):
        at = first + s
        x, y, z = gradient[at, 0], gradient[at, 1], gradient[at, 2]
        a = turn[at, 0, 0] * x + turn[at, 0, 1] * y + turn[at, 0, 2] * z
        b = turn[at, 1, 0] * x + turn[at, 1, 1] * y + turn[at, 1, 2] * z
        c = turn[at, 2, 0] * x + turn[at, 2, 1] * y + turn[at, 2, 2] * z
        scale = ONE / max(np.sqrt(a * a + b * b + c * c), _TINY)
        a, b, c, h = a * scale, b * scale, c * scale, t.harmonics
        h[s, 0], h[s, 1], h[s, 2] = a, b, c
        h[s, 3], h[s, 4], h[s, 5] = a * a, b * b, c * c
        h[s, 6], h[s, 7], h[s, 8] = a * c, b * a, c * b
        for k in range(3):
            total = law[k, 0] * a + law[k, 1] * b + law[k, 2] * c
            total += law[k, 3] * (a * a) + law[k, 4] * (b * b) + law[k, 5] * (c * c)
            t.light[k, s] = total + law[k, 6] * (a * c) + law[k, 7] * (b * a) + law[k, 8] * (c * b)
    exponentials(t.light, ONE)


@compiled_part
def sdf_at(s, t):  # noqa: ANN001, ANN201
    """Signed distance of the low branch and of the whole."""
    low = t.prior[s, 0] + TENTH * t.answers[0][s, 0]
    return low, low + t.gate[s] * (TENTH * t.answers[2][s, 0])


@compiled_part
def pull_whole(count, nets, shared, t, u):  # noqa: ANN001, ANN201
    """Cotangents of the features by the whole distance, after `find_geometry` with slopes.

    Those of the low ones are in `u.inputs[0]`, what the distance asks of the low net in `u.answers[0]`; those of the
    high ones, before the gate, in `u.inputs[2]`.
    """
    apart()
    own = t.high.shape[1]
    pull_first(TENTH, nets[2], t.tape[2], u.hidden[2], u.inputs[2], count)
    for s in range(count):
        u.answers[0][s, 0] = TENTH
        add_scaled(t.gate[s], u.inputs[2], s, own, u.answers[0], FEATURES, shared, FRESH)
    pull_down(u.answers[0], 1 + shared, nets[0], t.tape[0], u.hidden[0], u.inputs[0], count)


@compiled_part
def gradient_at(s, t, u, out):  # noqa: ANN001, ANN201
    """Canonical gradient of the whole distance at a sample, after `pull_whole`."""
    low, high = t.low.shape[1], t.high.shape[1]
    for i in range(3):
        own = pulled(t.low_slopes, u.inputs[0], s, i, low)
        out[i] = t.prior_slopes[s, i] + own + t.gate[s] * pulled(t.high_slopes, u.inputs[2], s, i, high)
