"""The two-branch grid field in one compiled loop over tiles of samples, for CPUs.

`factorized_grid` holds the same in PyTorch, for GPUs, for the ablations, and as the slow twin.

Legend: S samples, T samples of a tile; a grid is (table, rows, place, shape) as in `grid_kernels`; a net is the weight
and bias of its three layers, (w1, b1, w2, b2, w3, b3), the pose's part of the first bias included; nets and answers
come in the order low distance, low colour, high distance, high colour. `u` and `by_` are cotangents.
"""

# pyright: reportMissingParameterType=false

import numpy as np

from twofold.field.fused_layer_kernels import (
    FRESH,
    MASK,
    MORE,
    PLAIN,
    START,
    add_products,
    add_scaled,
    add_upper_gradients,
    multiply,
    pull_down,
    pull_first,
    take_active,
    unpadded,
    zeros_like,
)
from twofold.field.fused_lookup_kernels import pulled
from twofold.field.fused_tile_kernels import (
    COLORS,
    FEATURES,
    ONE,
    TENTH,
    TILE,
    WITH_SLOPES,
    WITHOUT_SLOPES,
    all_ready,
    find_colors,
    find_geometry,
    find_light,
    gradient_at,
    new_cotangents,
    new_tile,
    pull_whole,
    sdf_at,
)
from twofold.kernels.lanes import LANES
from twofold.kernels.parallel import compiled, compiled_part


@compiled
def distances(x, grids, nets, gate_width, sdf, begin, end):  # noqa: ANN001, ANN201
    """sdf[S] = the whole field's signed distance."""
    own = all_ready(nets)
    t, shared = new_tile(grids, own), nets[0][5].shape[0] - 1
    for first in range(begin, end, TILE):
        count = min(TILE, end - first)
        find_geometry(x[first : first + count], count, grids, own, gate_width, shared, WITHOUT_SLOPES, t)
        for s in range(count):
            sdf[first + s] = sdf_at(s, t)[1]


@compiled
def forward(  # noqa: ANN201
    x, grids, nets, gate_width, turn, law, sdf, low_sdf, color, low_color, gradient, low_gradient, begin, end  # noqa: ANN001
):  # fmt: skip
    """Distances, colours and canonical gradients of the whole and of the low branch; `turn` [S 3 3], `law` [3 9]."""
    own = all_ready(nets)
    t, u, shared = new_tile(grids, own), new_cotangents(own), nets[0][5].shape[0] - 1
    for first in range(begin, end, TILE):
        count = min(TILE, end - first)
        find_geometry(x[first : first + count], count, grids, own, gate_width, shared, WITH_SLOPES, t)
        find_colors(count, own, shared, t)
        pull_whole(count, own, shared, t, u)
        for s in range(count):
            low_sdf[first + s], sdf[first + s] = sdf_at(s, t)
            gradient_at(s, t, u, gradient[first + s])
        find_light(gradient, turn, law, first, count, t)
        for s in range(count):
            for c in range(3):
                plain = t.answers[1][s, c] + t.gate[s] * t.answers[3][s, c]
                color[first + s, c] = plain * t.light[c, s]
        pull_first(TENTH, own[0], t.tape[0], u.hidden[0], u.inputs[0], count)
        for s in range(count):
            for i in range(3):
                slope = pulled(t.low_slopes, u.inputs[0], s, i, t.low.shape[1])
                low_gradient[first + s, i] = t.prior_slopes[s, i] + slope
        find_light(low_gradient, turn, law, first, count, t)
        for s in range(count):
            for c in range(3):
                low_color[first + s, c] = t.answers[1][s, c] * t.light[c, s]


@compiled
def backward(  # noqa: ANN201
    x, grids, nets, gate_width, turn, law, gradient, low_gradient, by_sdf, by_low_sdf, by_color, by_low_color,  # noqa: ANN001
    by_low_features, by_high_features, by_x, wanted, by_nets, by_law, begin, end,  # noqa: ANN001
):  # fmt: skip
    """The reverse pass of `forward`, with its gradients taken as constants.

    Cotangents of the interpolated features [S LC] and, where `wanted`, of the points [S 3] are stored; those of nets
    and law are added up.
    """
    own = all_ready(nets)
    t, u, shared = new_tile(grids, own), new_cotangents(own), nets[0][5].shape[0] - 1
    totals = zeros_like(own[0]), zeros_like(own[1]), zeros_like(own[2]), zeros_like(own[3])
    by_exponent, laws = np.zeros((TILE, 3), np.float32), np.zeros((3, LANES), np.float32)
    low, high = t.low.shape[1], t.high.shape[1]
    for first in range(begin, end, TILE):
        count = min(TILE, end - first)
        find_geometry(x[first : first + count], count, grids, own, gate_width, shared, wanted, t)
        find_colors(count, own, shared, t)
        find_light(gradient, turn, law, first, count, t)
        for s in range(count):
            for c in range(3):
                # By the colour before the light, then by the light's exponent.
                by_plain = by_color[first + s, c] * t.light[c, s]
                u.answers[3][s, c] = t.gate[s] * by_plain
                u.answers[1][s, c] = by_plain
                by_exponent[s, c] = by_plain * (t.answers[1][s, c] + t.gate[s] * t.answers[3][s, c])
        add_products(by_exponent, START, COLORS, t.harmonics, laws, START, count)
        find_light(low_gradient, turn, law, first, count, t)
        for s in range(count):
            for c in range(3):
                base = t.answers[1][s, c]
                by_plain = by_low_color[first + s, c] * t.light[c, s]
                by_exponent[s, c] = by_plain * base
                u.answers[1][s, c] = (u.answers[1][s, c] + by_plain) * base * (ONE - base)
        add_products(by_exponent, START, COLORS, t.harmonics, laws, START, count)
        pull_down(u.answers[3], COLORS, own[3], t.tape[3], u.hidden[3], u.inputs[3], count)
        add_products(t.high, START, high, u.hidden[3, 0], totals[3][0], START, count)
        add_products(t.answers[2], FEATURES, shared, u.hidden[3, 0], totals[3][0], high, count)
        add_products(t.answers[1], COLORS, shared, u.hidden[3, 0], totals[3][0], high + shared, count)
        add_upper_gradients(u.answers[3], t.tape[3], u.hidden[3], totals[3], count)
        for s in range(count):
            u.answers[2][s, 0] = TENTH * t.gate[s] * by_sdf[first + s]
            add_scaled(ONE, u.inputs[3], s, high, u.answers[2], FEATURES, shared, FRESH)
            take_active(t.answers[1], s, COLORS, u.inputs[3], high + shared, u.answers[1], shared)
        pull_down(u.answers[2], 1 + shared, own[2], t.tape[2], u.hidden[2], u.inputs[2], count)
        add_products(t.high, START, high, u.hidden[2, 0], totals[2][0], START, count)
        add_products(t.answers[0], FEATURES, shared, u.hidden[2, 0], totals[2][0], high, count)
        add_upper_gradients(u.answers[2], t.tape[2], u.hidden[2], totals[2], count)
        pull_down(u.answers[1], 3 + shared, own[1], t.tape[1], u.hidden[1], u.inputs[1], count)
        add_products(t.low, START, low, u.hidden[1, 0], totals[1][0], START, count)
        add_products(t.answers[0], FEATURES, shared, u.hidden[1, 0], totals[1][0], low, count)
        add_upper_gradients(u.answers[1], t.tape[1], u.hidden[1], totals[1], count)
        for s in range(count):
            u.answers[0][s, 0] = TENTH * (by_sdf[first + s] + by_low_sdf[first + s])
            add_scaled(ONE, u.inputs[2], s, high, u.answers[0], FEATURES, shared, FRESH)
            add_scaled(ONE, u.inputs[1], s, low, u.answers[0], FEATURES, shared, MORE)
        pull_down(u.answers[0], 1 + shared, own[0], t.tape[0], u.hidden[0], u.inputs[0], count)
        add_products(t.low, START, low, u.hidden[0, 0], totals[0][0], START, count)
        add_upper_gradients(u.answers[0], t.tape[0], u.hidden[0], totals[0], count)
        for s in range(count):
            at = first + s
            for c in range(low):
                u.inputs[0][s, c] += u.inputs[1][s, c]
                by_low_features[at, c] = u.inputs[0][s, c]
            for c in range(high):
                u.inputs[2][s, c] += u.inputs[3][s, c]
                by_high_features[at, c] = u.inputs[2][s, c]
            if wanted:
                for i in range(3):
                    by_x[at, i] = t.prior_slopes[s, i] * (by_sdf[at] + by_low_sdf[at])
                    by_x[at, i] += pulled(t.low_slopes, u.inputs[0], s, i, low)
                    by_x[at, i] += pulled(t.high_slopes, u.inputs[2], s, i, high)
    for k in range(4):
        unpadded(totals[k], by_nets[k])
    by_law += laws[:, :9]


@compiled
def distance_and_gradient(x, grids, nets, gate_width, sdf, gradient, begin, end):  # noqa: ANN001, ANN201
    """The whole field's signed distance [S] and its canonical gradient [S 3]."""
    own = all_ready(nets)
    t, u, shared = new_tile(grids, own), new_cotangents(own), nets[0][5].shape[0] - 1
    for first in range(begin, end, TILE):
        count = min(TILE, end - first)
        find_geometry(x[first : first + count], count, grids, own, gate_width, shared, WITH_SLOPES, t)
        pull_whole(count, own, shared, t, u)
        for s in range(count):
            sdf[first + s] = sdf_at(s, t)[1]
            gradient_at(s, t, u, gradient[first + s])


@compiled_part
def _slope_gradients(pushed, u, columns, net, tape, hidden, total, layers, out, count):  # noqa: ANN001, ANN202
    """Adds the derivative of <pushed, J^T u> by the weights, after `pull_down`; `out` = J pushed.

    With the masks of the rectifiers fixed, J is a product of matrices: each one's gradient is what arrives from above
    (`hidden`) times what arrives from below (`layers`).
    """
    add_products(pushed, START, columns, hidden[0], total[0], START, count)
    multiply(pushed, START, columns, net.up1, START, net.zeros, FRESH, MASK, tape[0], layers[0], count)
    add_products(layers[0], START, net.up2.shape[0], hidden[1], total[1], START, count)
    multiply(layers[0], START, net.up2.shape[0], net.up2, START, net.zeros, FRESH, MASK, tape[1], layers[1], count)
    add_products(layers[1], START, net.up3.shape[0], u, total[2], START, count)
    multiply(layers[1], START, net.up3.shape[0], net.up3, START, net.zeros, FRESH, PLAIN, out, out, count)


@compiled
def gradient_backward(  # noqa: ANN201
    x, grids, nets, gate_width, by_gradient, low_cotangents, high_cotangents, high_pushed, by_nets, begin, end  # noqa: ANN001
):  # fmt: skip
    """Derivative of <by_gradient, gradient of the distance> by the nets, added to `by_nets`.

    That by the grids is `grid_kernels.pull_scatter` of the cotangents [S LC] that are stored: with `by_gradient` for
    the low grid, and with `high_pushed` [S 3], which the gate has weakened, for the high one.
    """
    own = all_ready(nets)
    t, u, shared = new_tile(grids, own), new_cotangents(own), nets[0][5].shape[0] - 1
    low_total, high_total = zeros_like(own[0]), zeros_like(own[2])
    low, high = t.low.shape[1], t.high.shape[1]
    low_in, high_in = np.zeros((TILE, low), np.float32), np.zeros((TILE, high + shared), np.float32)
    layers, out = np.zeros((2, TILE, own[0].up2.shape[1]), np.float32), np.zeros_like(t.answers[0])
    head = np.zeros_like(t.answers[2])
    head[:, 0] = TENTH
    for first in range(begin, end, TILE):
        count = min(TILE, end - first)
        find_geometry(x[first : first + count], count, grids, own, gate_width, shared, WITH_SLOPES, t)
        pull_whole(count, own, shared, t, u)
        for s in range(count):
            at = first + s
            for i in range(3):
                high_pushed[at, i] = t.gate[s] * by_gradient[at, i]
            for c in range(low):
                low_cotangents[at, c] = u.inputs[0][s, c]
                low_in[s, c] = _pushed(t.low_slopes, s, c, by_gradient[at])
            for c in range(high):
                high_cotangents[at, c] = u.inputs[2][s, c]
                high_in[s, c] = _pushed(t.high_slopes, s, c, high_pushed[at])
        _slope_gradients(low_in, u.answers[0], low, own[0], t.tape[0], u.hidden[0], low_total, layers, out, count)
        for s in range(count):
            for c in range(shared):
                high_in[s, high + c] = t.gate[s] * out[s, 1 + c]
        _slope_gradients(high_in, head, high + shared, own[2], t.tape[2], u.hidden[2], high_total, layers, out, count)
    unpadded(low_total, by_nets[0])
    unpadded(high_total, by_nets[2])


@compiled_part
def _pushed(slopes, s, c, direction):  # noqa: ANN001, ANN202
    """A feature's derivative along a direction."""
    return slopes[0, s, c] * direction[0] + slopes[1, s, c] * direction[1] + slopes[2, s, c] * direction[2]
