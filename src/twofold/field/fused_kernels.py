"""The two-branch grid field in one compiled loop over tiles of samples, for CPUs.

`factorized_grid` holds the same in PyTorch, for GPUs, for the ablations, and as the slow twin.

Legend: S samples, T samples of a tile; a grid is (table, rows, place, shape) as in `grid_kernels`; a net is the weight
and bias of its three layers, (w1, b1, w2, b2, w3, b3), the pose's part of the first bias included; `tape` holds a
net's two hidden layers, [T w] each; `by_net` sums a net's gradients in the order of the net. `u` are cotangents.
"""

# pyright: reportMissingParameterType=false

import numpy as np

from twofold.field.grid_kernels import interpolate, pull, push
from twofold.kernels.parallel import compiled

TILE = 128
"""Samples whose hidden layers fit into a core's own cache."""
_TENTH = np.float32(0.1)
_ONE = np.float32(1)
_ZERO = np.float32(0)


@compiled
def _net_forward(x, net, tape, out):  # noqa: ANN001, ANN202
    """Both hidden layers go to the tape, the answer to `out`."""
    _layer(x, net[0], net[1], tape[0], True)
    _layer(tape[0], net[2], net[3], tape[1], True)
    _layer(tape[1], net[4], net[5], out, False)


@compiled
def _layer(x, weight, bias, out, rectify):  # noqa: ANN001, ANN202
    np.dot(x, weight.T, out)
    for s in range(out.shape[0]):
        for c in range(out.shape[1]):
            value = out[s, c] + bias[c]
            out[s, c] = max(value, _ZERO) if rectify else value


@compiled
def _net_pullback(u, net, tape, hidden, by_x):  # noqa: ANN001, ANN202
    """`by_x` = J^T u; the cotangents of the hidden layers stay in `hidden`."""
    np.dot(u, net[4], hidden[1])
    _where_active(hidden[1], tape[1])
    np.dot(hidden[1], net[2], hidden[0])
    _where_active(hidden[0], tape[0])
    np.dot(hidden[0], net[0], by_x)


@compiled
def _where_active(u, activation):  # noqa: ANN001, ANN202
    for s in range(u.shape[0]):
        for c in range(u.shape[1]):
            if activation[s, c] <= _ZERO:
                u[s, c] = _ZERO


@compiled
def _net_gradients(x, u, tape, hidden, by_net):  # noqa: ANN001, ANN202
    """Adds the gradients by weights and biases, after `_net_pullback`."""
    _outer(hidden[0], x, by_net[0])
    _outer(hidden[1], tape[0], by_net[2])
    _outer(u, tape[1], by_net[4])
    _column_sums(hidden[0], by_net[1])
    _column_sums(hidden[1], by_net[3])
    _column_sums(u, by_net[5])


@compiled
def _slope_gradients(pushed, u, net, tape, hidden, by_net, layers, out):  # noqa: ANN001, ANN202
    """Adds the derivative of <pushed, J^T u> by the weights, after `_net_pullback`; `out` = J pushed.

    With the masks of the rectifiers fixed, J is a product of matrices: each one's gradient is what arrives from above
    (`hidden`) times what arrives from below (`layers`).
    """
    _outer(hidden[0], pushed, by_net[0])
    np.dot(pushed, net[0].T, layers[0])
    _where_active(layers[0], tape[0])
    _outer(hidden[1], layers[0], by_net[2])
    np.dot(layers[0], net[2].T, layers[1])
    _where_active(layers[1], tape[1])
    _outer(u, layers[1], by_net[4])
    np.dot(layers[1], net[4].T, out)


@compiled
def _outer(u, x, total):  # noqa: ANN001, ANN202
    total += np.dot(u.T, x)


@compiled
def _column_sums(u, total):  # noqa: ANN001, ANN202
    for s in range(u.shape[0]):
        for c in range(u.shape[1]):
            total[c] += u[s, c]


@compiled
def _buffers(nets, columns):  # noqa: ANN001, ANN202
    """For each net: input, two hidden layers, answer."""
    width = nets[0][1].shape[0]
    inputs = (
        np.zeros((TILE, columns[0]), np.float32), np.zeros((TILE, columns[1]), np.float32),
        np.zeros((TILE, columns[2]), np.float32), np.zeros((TILE, columns[3]), np.float32),
    )  # fmt: skip
    hidden = np.zeros((4, 2, TILE, width), np.float32)
    answers = (
        np.zeros((TILE, nets[0][5].shape[0]), np.float32), np.zeros((TILE, nets[1][5].shape[0]), np.float32),
        np.zeros((TILE, nets[2][5].shape[0]), np.float32), np.zeros((TILE, nets[3][5].shape[0]), np.float32),
    )  # fmt: skip
    return inputs, hidden, answers


@compiled
def _columns(nets):  # noqa: ANN001, ANN202
    return nets[0][0].shape[1], nets[1][0].shape[1], nets[2][0].shape[1], nets[3][0].shape[1]


@compiled
def _geometry(x, count, grids, nets, gate_width, inputs, tape, answers, prior, gate):  # noqa: ANN001, ANN202
    """Features, both distance networks, the prior's distance and the gate of `count` points, [T 3]."""
    low, _, high, _ = inputs
    interpolate(x, grids[0][0], grids[0][1], grids[0][2], grids[0][3], prior, 0, count)
    interpolate(x, grids[1][0], grids[1][1], grids[1][2], grids[1][3], low, 0, count)
    interpolate(x, grids[2][0], grids[2][1], grids[2][2], grids[2][3], high, 0, count)
    _net_forward(low, nets[0], tape[0], answers[0])
    own = high.shape[1] - answers[0].shape[1] + 1
    for s in range(count):
        for c in range(answers[0].shape[1] - 1):
            high[s, own + c] = answers[0][s, 1 + c]
        ratio = (prior[s, 0] + _TENTH * answers[0][s, 0]) / gate_width
        square = ratio * ratio
        gate[s] = _ONE / (_ONE + square * square)
        if prior.shape[1] > 1:  # how well the surface there was observed
            gate[s] *= prior[s, 1]
    _net_forward(high, nets[2], tape[2], answers[2])


@compiled
def _colors(count, nets, inputs, tape, answers):  # noqa: ANN001, ANN202
    """Both colour networks, after `_geometry`; the base branch's first three answers become colours."""
    low, low_color, high, high_color = inputs
    shared = answers[0].shape[1] - 1
    own_low, own_high = low.shape[1], high.shape[1] - shared
    for s in range(count):
        for c in range(own_low):
            low_color[s, c] = low[s, c]
        for c in range(shared):
            low_color[s, own_low + c] = answers[0][s, 1 + c]
    _net_forward(low_color, nets[1], tape[1], answers[1])
    for s in range(count):
        for c in range(3):
            answers[1][s, c] = _ONE / (_ONE + np.exp(-answers[1][s, c]))
        for c in range(own_high):
            high_color[s, c] = high[s, c]
        for c in range(shared):
            high_color[s, own_high + c] = answers[2][s, 1 + c]
            high_color[s, own_high + shared + c] = max(answers[1][s, 3 + c], _ZERO)
    _net_forward(high_color, nets[3], tape[3], answers[3])


@compiled
def _harmonics(gradient, turn, out):  # noqa: ANN001, ANN202
    """The nine polynomials of a normal, from the canonical gradient and the matrix that turns it."""
    length = np.float32(1e-12)
    for i in range(3):
        out[i] = turn[i, 0] * gradient[0] + turn[i, 1] * gradient[1] + turn[i, 2] * gradient[2]
    length = max(np.sqrt(out[0] * out[0] + out[1] * out[1] + out[2] * out[2]), length)
    for i in range(3):
        out[i] /= length
    for i in range(3):
        out[3 + i] = out[i] * out[i]
        out[6 + i] = out[i] * out[(i + 2) % 3]


@compiled
def _light(harmonics, law, out):  # noqa: ANN001, ANN202
    for c in range(3):
        total = _ZERO
        for k in range(9):
            total += law[c, k] * harmonics[k]
        out[c] = np.exp(total)


@compiled
def distances(x, grids, nets, gate_width, sdf, begin, end):  # noqa: ANN001, ANN201
    """sdf[S] = the whole field's signed distance."""
    inputs, tape, answers = _buffers(nets, _columns(nets))
    prior, gate = np.zeros((TILE, grids[0][0].shape[1]), np.float32), np.zeros(TILE, np.float32)
    for first in range(begin, end, TILE):
        count = min(TILE, end - first)
        _geometry(x[first : first + count], count, grids, nets, gate_width, inputs, tape, answers, prior, gate)
        for s in range(count):
            sdf[first + s] = (prior[s, 0] + _TENTH * answers[0][s, 0]) + gate[s] * (_TENTH * answers[2][s, 0])


@compiled
def _gradients(x, count, grids, nets, tape, gate, heads, hidden, by_input, pulled):  # noqa: ANN001, ANN202
    """pulled[0, 1, 2] = gradients [T 3] of the prior, of the low branch's own distance, and what the high one adds.

    `by_input` are the cotangents of the nets' inputs: (low branch's own, all of the low features, high branch's).
    `heads` are cotangents of the answers: (low branch's distance, what the whole needs of it, high branch's distance).
    """
    shared = heads[0].shape[1] - 1
    own = by_input[2].shape[1] - shared
    _net_pullback(heads[2], nets[2], tape[2], hidden[2], by_input[2])
    for s in range(count):
        for c in range(shared):
            heads[1][s, 1 + c] = gate[s] * by_input[2][s, own + c]
    _net_pullback(heads[1], nets[0], tape[0], hidden[1], by_input[1])
    ones = np.zeros((count, grids[0][0].shape[1]), np.float32)
    ones[:, 0] = _ONE
    high = np.empty((count, own), np.float32)
    for s in range(count):
        for c in range(own):
            high[s, c] = gate[s] * by_input[2][s, c]
    pull(x, grids[0][0], ones, grids[0][1], grids[0][2], grids[0][3], pulled[0], 0, count)
    pull(x, grids[1][0], by_input[1], grids[1][1], grids[1][2], grids[1][3], pulled[1], 0, count)
    pull(x, grids[2][0], high, grids[2][1], grids[2][2], grids[2][3], pulled[2], 0, count)


@compiled
def _slope_buffers(nets):  # noqa: ANN001, ANN202
    """Heads, hidden cotangents, input cotangents and pulled gradients, see `_gradients`."""
    answers, low, high = nets[0][5].shape[0], nets[0][0].shape[1], nets[2][0].shape[1]
    width = nets[0][1].shape[0]
    heads = np.zeros((3, TILE, answers), np.float32)
    heads[:, :, 0] = _TENTH
    by_input = (
        np.zeros((TILE, low), np.float32), np.zeros((TILE, low), np.float32), np.zeros((TILE, high), np.float32)
    )  # fmt: skip
    return heads, np.zeros((3, 2, TILE, width), np.float32), by_input, np.zeros((3, TILE, 3), np.float32)


@compiled
def forward(  # noqa: ANN201
    x, grids, nets, gate_width, turn, law, sdf, low_sdf, color, low_color, gradient, low_gradient, begin, end  # noqa: ANN001
):  # fmt: skip
    """Distances, colours and canonical gradients of the whole and of the low branch; `turn` [S 3 3], `law` [3 9]."""
    inputs, tape, answers = _buffers(nets, _columns(nets))
    prior, gate = np.zeros((TILE, grids[0][0].shape[1]), np.float32), np.zeros(TILE, np.float32)
    heads, hidden, by_input, pulled = _slope_buffers(nets)
    harmonics, light = np.empty(9, np.float32), np.empty(3, np.float32)
    for first in range(begin, end, TILE):
        count = min(TILE, end - first)
        part = x[first : first + count]
        _geometry(part, count, grids, nets, gate_width, inputs, tape, answers, prior, gate)
        _colors(count, nets, inputs, tape, answers)
        _gradients(part, count, grids, nets, tape, gate, heads, hidden, by_input, pulled)
        _net_pullback(heads[0], nets[0], tape[0], hidden[0], by_input[0])
        for s in range(count):
            for i in range(3):
                gradient[first + s, i] = pulled[0, s, i] + pulled[1, s, i] + pulled[2, s, i]
        pull(part, grids[1][0], by_input[0], grids[1][1], grids[1][2], grids[1][3], pulled[1], 0, count)
        for s in range(count):
            at = first + s
            low_sdf[at] = prior[s, 0] + _TENTH * answers[0][s, 0]
            sdf[at] = low_sdf[at] + gate[s] * (_TENTH * answers[2][s, 0])
            for i in range(3):
                low_gradient[at, i] = pulled[0, s, i] + pulled[1, s, i]
            _harmonics(low_gradient[at], turn[at], harmonics)
            _light(harmonics, law, light)
            for c in range(3):
                low_color[at, c] = answers[1][s, c] * light[c]
            _harmonics(gradient[at], turn[at], harmonics)
            _light(harmonics, law, light)
            for c in range(3):
                color[at, c] = (answers[1][s, c] + gate[s] * answers[3][s, c]) * light[c]


@compiled
def backward(  # noqa: ANN201
    x, grids, nets, gate_width, turn, law, gradient, low_gradient, by_sdf, by_low_sdf, by_color, by_low_color,  # noqa: ANN001
    by_low_features, by_high_features, by_prior, by_nets, by_law, begin, end,  # noqa: ANN001
):  # fmt: skip
    """The reverse pass of `forward`, with its gradients taken as constants.

    Cotangents of the interpolated features [S LC] and of the prior [S] are stored; those of nets and law are added up.
    """
    inputs, tape, answers = _buffers(nets, _columns(nets))
    prior, gate = np.zeros((TILE, grids[0][0].shape[1]), np.float32), np.zeros(TILE, np.float32)
    by_inputs, hidden, by_answers = _buffers(nets, _columns(nets))
    harmonics, light = np.empty(9, np.float32), np.empty(3, np.float32)
    shared = nets[0][5].shape[0] - 1
    own_low, own_high = nets[0][0].shape[1], nets[2][0].shape[1] - shared
    for first in range(begin, end, TILE):
        count = min(TILE, end - first)
        part = x[first : first + count]
        _geometry(part, count, grids, nets, gate_width, inputs, tape, answers, prior, gate)
        _colors(count, nets, inputs, tape, answers)
        for k in range(4):
            by_answers[k][count:] = _ZERO
        for s in range(count):
            at = first + s
            _harmonics(gradient[at], turn[at], harmonics)
            _light(harmonics, law, light)
            for c in range(3):
                # By the colour before the light, then by the light's exponent.
                by_plain = by_color[at, c] * light[c]
                by_answers[3][s, c] = gate[s] * by_plain
                by_answers[1][s, c] = by_plain
                by_exponent = by_plain * (answers[1][s, c] + gate[s] * answers[3][s, c])
                for k in range(9):
                    by_law[c, k] += by_exponent * harmonics[k]
            _harmonics(low_gradient[at], turn[at], harmonics)
            _light(harmonics, law, light)
            for c in range(3):
                base = answers[1][s, c]
                by_plain = by_low_color[at, c] * light[c]
                by_exponent = by_plain * base
                for k in range(9):
                    by_law[c, k] += by_exponent * harmonics[k]
                by_answers[1][s, c] = (by_answers[1][s, c] + by_plain) * base * (_ONE - base)
        _net_pullback(by_answers[3], nets[3], tape[3], hidden[3], by_inputs[3])
        _net_gradients(inputs[3], by_answers[3], tape[3], hidden[3], by_nets[3])
        for s in range(count):
            by_answers[2][s, 0] = _TENTH * gate[s] * by_sdf[first + s]
            for c in range(shared):
                by_answers[2][s, 1 + c] = by_inputs[3][s, own_high + c]
                live = answers[1][s, 3 + c] > _ZERO
                by_answers[1][s, 3 + c] = by_inputs[3][s, own_high + shared + c] if live else _ZERO
        _net_pullback(by_answers[2], nets[2], tape[2], hidden[2], by_inputs[2])
        _net_gradients(inputs[2], by_answers[2], tape[2], hidden[2], by_nets[2])
        _net_pullback(by_answers[1], nets[1], tape[1], hidden[1], by_inputs[1])
        _net_gradients(inputs[1], by_answers[1], tape[1], hidden[1], by_nets[1])
        for s in range(count):
            by_prior[first + s] = by_sdf[first + s] + by_low_sdf[first + s]
            by_answers[0][s, 0] = _TENTH * by_prior[first + s]
            for c in range(shared):
                by_answers[0][s, 1 + c] = by_inputs[2][s, own_high + c] + by_inputs[1][s, own_low + c]
        _net_pullback(by_answers[0], nets[0], tape[0], hidden[0], by_inputs[0])
        _net_gradients(inputs[0], by_answers[0], tape[0], hidden[0], by_nets[0])
        for s in range(count):
            for c in range(own_low):
                by_low_features[first + s, c] = by_inputs[0][s, c] + by_inputs[1][s, c]
            for c in range(own_high):
                by_high_features[first + s, c] = by_inputs[2][s, c] + by_inputs[3][s, c]


@compiled
def distance_and_gradient(x, grids, nets, gate_width, sdf, gradient, begin, end):  # noqa: ANN001, ANN201
    """The whole field's signed distance [S] and its canonical gradient [S 3]."""
    inputs, tape, answers = _buffers(nets, _columns(nets))
    prior, gate = np.zeros((TILE, grids[0][0].shape[1]), np.float32), np.zeros(TILE, np.float32)
    heads, hidden, by_input, pulled = _slope_buffers(nets)
    for first in range(begin, end, TILE):
        count = min(TILE, end - first)
        part = x[first : first + count]
        _geometry(part, count, grids, nets, gate_width, inputs, tape, answers, prior, gate)
        _gradients(part, count, grids, nets, tape, gate, heads, hidden, by_input, pulled)
        for s in range(count):
            sdf[first + s] = (prior[s, 0] + _TENTH * answers[0][s, 0]) + gate[s] * (_TENTH * answers[2][s, 0])
            for i in range(3):
                gradient[first + s, i] = pulled[0, s, i] + pulled[1, s, i] + pulled[2, s, i]


@compiled
def gradient_backward(  # noqa: ANN201
    x, grids, nets, gate_width, by_gradient, low_cotangents, high_cotangents, high_pushed, by_nets, begin, end  # noqa: ANN001
):  # fmt: skip
    """Derivative of <by_gradient, gradient of the distance> by the nets, added to `by_nets`.

    That by the grids is `grid_kernels.pull_scatter` of the cotangents [S LC] that are stored: with `by_gradient` for
    the low grid, and with `high_pushed` [S 3], which the gate has weakened, for the high one.
    """
    inputs, tape, answers = _buffers(nets, _columns(nets))
    prior, gate = np.zeros((TILE, grids[0][0].shape[1]), np.float32), np.zeros(TILE, np.float32)
    heads, hidden, by_input, pulled = _slope_buffers(nets)
    low_in, high_in = np.zeros((TILE, nets[0][0].shape[1]), np.float32), np.zeros_like(inputs[2])
    layers = np.zeros((2, TILE, nets[0][1].shape[0]), np.float32)
    out = np.zeros((TILE, nets[0][5].shape[0]), np.float32)
    shared = nets[0][5].shape[0] - 1
    own_low, own_high = nets[0][0].shape[1], nets[2][0].shape[1] - shared
    for first in range(begin, end, TILE):
        count = min(TILE, end - first)
        part = x[first : first + count]
        _geometry(part, count, grids, nets, gate_width, inputs, tape, answers, prior, gate)
        _gradients(part, count, grids, nets, tape, gate, heads, hidden, by_input, pulled)
        for s in range(count):
            for i in range(3):
                high_pushed[first + s, i] = gate[s] * by_gradient[first + s, i]
            for c in range(own_low):
                low_cotangents[first + s, c] = by_input[1][s, c]
            for c in range(own_high):
                high_cotangents[first + s, c] = by_input[2][s, c]
        low_in[count:] = _ZERO
        high_in[count:] = _ZERO
        push(part, grids[1][0], by_gradient[first : first + count], grids[1][1], grids[1][2], grids[1][3], low_in, 0,
             count)  # fmt: skip
        _slope_gradients(low_in, heads[1], nets[0], tape[0], hidden[1], by_nets[0], layers, out)
        push(part, grids[2][0], high_pushed[first : first + count], grids[2][1], grids[2][2], grids[2][3], high_in, 0,
             count)  # fmt: skip
        for s in range(count):
            for c in range(shared):
                high_in[s, own_high + c] = gate[s] * out[s, 1 + c]
        _slope_gradients(high_in, heads[2], nets[2], tape[2], hidden[2], by_nets[2], layers, out)
