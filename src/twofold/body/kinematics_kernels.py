"""Compiled forward kinematics and its reverse pass, for CPUs; `skeleton` has the twin in PyTorch.

Numbers come and go in single precision and are worked out in double.
"""

# pyright: reportMissingParameterType=false

import numpy as np

from twofold.kernels.parallel import compiled


@compiled
def rotations(vectors, out):  # noqa: ANN001, ANN201
    r"""out[N 3 3] = rotation matrices of axis-angle vectors [N 3], radians: `axis_angle_to_matrix`.

    \[ R = I + a K + b K^2, \qquad a = \frac{\sin \theta}{\theta}, \quad b = \frac{1 - \cos \theta}{\theta^2} \]
    """
    for n in range(vectors.shape[0]):
        x, y, z = np.float64(vectors[n, 0]), np.float64(vectors[n, 1]), np.float64(vectors[n, 2])
        squared = x * x + y * y + z * z
        first, second = 1 - squared / 6, 0.5
        if squared >= 1e-8:
            angle = np.sqrt(squared)
            first, half = np.sin(angle) / angle, np.sin(angle / 2) / angle
            second = 2 * half * half
        own = 1 - second * squared
        out[n, 0, 0], out[n, 1, 1], out[n, 2, 2] = own + second * x * x, own + second * y * y, own + second * z * z
        out[n, 0, 1], out[n, 1, 0] = second * x * y - first * z, second * x * y + first * z
        out[n, 2, 0], out[n, 0, 2] = second * x * z - first * y, second * x * z + first * y
        out[n, 1, 2], out[n, 2, 1] = second * y * z - first * x, second * y * z + first * x


@compiled
def rotations_backward(vectors, by_matrix, out):  # noqa: ANN001, ANN201
    r"""out[N 3] = cotangent of the vectors [N 3] from that of their matrices, G [N 3 3].

    \[ \bar v = a w + b \big( (G + G^\top) v - 2 \, \mathrm{tr}(G) \, v \big)
    + 2 v \, \big( a' \, w^\top v + b' \, (v^\top G v - \theta^2 \, \mathrm{tr}(G)) \big), \qquad
    a' = \frac{da}{d\theta^2} = \frac{\cos \theta - a}{2 \theta^2}, \quad
    b' = \frac{db}{d\theta^2} = \frac{a - 2 b}{2 \theta^2} \]

    with w the axis of the antisymmetric part, $w_x = G_{zy} - G_{yz}$ and so on.
    """
    for n in range(vectors.shape[0]):
        x, y, z = np.float64(vectors[n, 0]), np.float64(vectors[n, 1]), np.float64(vectors[n, 2])
        squared = x * x + y * y + z * z
        first, second, by_first, by_second = 1 - squared / 6, 0.5, -1 / 6, 0.0
        if squared >= 1e-8:
            angle = np.sqrt(squared)
            first, half = np.sin(angle) / angle, np.sin(angle / 2) / angle
            second = 2 * half * half
            by_first = (np.cos(angle) - first) / (2 * squared)
            by_second = (first - 2 * second) / (2 * squared)
        g = by_matrix[n]
        trace = g[0, 0] + g[1, 1] + g[2, 2]
        u, v, w = g[2, 1] - g[1, 2], g[0, 2] - g[2, 0], g[1, 0] - g[0, 1]
        sx = 2 * g[0, 0] * x + (g[0, 1] + g[1, 0]) * y + (g[0, 2] + g[2, 0]) * z
        sy = (g[1, 0] + g[0, 1]) * x + 2 * g[1, 1] * y + (g[1, 2] + g[2, 1]) * z
        sz = (g[2, 0] + g[0, 2]) * x + (g[2, 1] + g[1, 2]) * y + 2 * g[2, 2] * z
        quadratic = 0.5 * (sx * x + sy * y + sz * z) - squared * trace
        along = 2 * (by_first * (u * x + v * y + w * z) + by_second * quadratic) - 2 * second * trace
        out[n, 0] = first * u + second * sx + along * x
        out[n, 1] = first * v + second * sy + along * y
        out[n, 2] = first * w + second * sz + along * z


@compiled
def transforms(joints, turns, translation, parents, out):  # noqa: ANN001, ANN201
    r"""out[B J 4 4] = `joint_transforms_of_rotations` of joints [J 3], rotations [B J 3 3] and translations [B 3].

    With the rotation W and the shift q of a joint j below p, both relative to the rest joint x_j,

    \[ W_j = W_p R_j, \qquad q_j = q_p + (W_p - W_j) x_j \]

    Above the root stand the identity and the translation. A parent comes before its children; the root's is -1.
    """
    count = joints.shape[0]
    world, shift = np.empty((count, 3, 3)), np.empty((count, 3))
    for b in range(turns.shape[0]):
        for j in range(count):
            p = parents[j]
            for r in range(3):
                moved = np.float64(translation[b, r]) if p < 0 else shift[p, r]
                for c in range(3):
                    above = np.float64(r == c) if p < 0 else world[p, r, c]
                    turned = np.float64(turns[b, j, r, c])
                    if p >= 0:
                        turned = 0.0
                        for k in range(3):
                            turned += world[p, r, k] * turns[b, j, k, c]
                    world[j, r, c] = turned
                    moved += (above - turned) * joints[j, c]
                    out[b, j, r, c] = turned
                    out[b, j, 3, c] = 0
                shift[j, r] = moved
                out[b, j, r, 3] = moved
            out[b, j, 3, 3] = 1


@compiled
def transforms_backward(joints, turns, parents, placed, given, wanted, by_joints, by_turns, by_translation):  # noqa: ANN001, ANN201
    r"""Cotangents of what `transforms` took, from that of its result; each is written only where it is wanted.

    With $\bar W$ and $\bar q$ those of a joint's rotation and shift, from the last joint to the first,

    \[ \bar x_j = (W_p - W_j)^\top \bar q_j, \qquad \bar W_j \mathrel{-}= \bar q_j x_j^\top, \qquad
    \bar R_j = W_p^\top \bar W_j, \]
    \[ \bar W_p \mathrel{+}= \bar q_j x_j^\top + \bar W_j R_j^\top, \qquad \bar q_p \mathrel{+}= \bar q_j \]

    Args:
        joints: x [J 3], rest joints, metres.
        turns: R [B J 3 3].
        parents: of each joint [J].
        placed: what `transforms` gave [B J 4 4].
        given: its cotangent [B J 4 4].
        wanted: whether by joints, by turns, by translation.
        by_joints: [J 3], summed over the bodies in their order.
        by_turns: [B J 3 3].
        by_translation: [B 3].
    """
    count = joints.shape[0]
    by_world, by_shift = np.empty((count, 3, 3)), np.empty((count, 3))
    total = np.zeros((count, 3))
    for b in range(turns.shape[0]):
        for j in range(count):
            for r in range(3):
                for c in range(3):
                    by_world[j, r, c] = given[b, j, r, c]
                by_shift[j, r] = given[b, j, r, 3]
        for j in range(count - 1, -1, -1):
            p = parents[j]
            if wanted[0]:
                for r in range(3):
                    for c in range(3):
                        above = np.float64(r == c) if p < 0 else np.float64(placed[b, p, r, c])
                        total[j, c] += (above - placed[b, j, r, c]) * by_shift[j, r]
            if wanted[1]:
                for r in range(3):
                    for c in range(3):
                        outer = by_shift[j, r] * joints[j, c]
                        by_world[j, r, c] -= outer
                        if p >= 0:
                            by_world[p, r, c] += outer
                for r in range(3):
                    for c in range(3):
                        if p < 0:
                            by_turns[b, j, r, c] = by_world[j, r, c]
                            continue
                        own, back = 0.0, 0.0
                        for k in range(3):
                            own += placed[b, p, k, r] * by_world[j, k, c]
                            back += by_world[j, r, k] * turns[b, j, c, k]
                        by_turns[b, j, r, c] = own
                        by_world[p, r, c] += back
            for r in range(3):
                if p >= 0:
                    by_shift[p, r] += by_shift[j, r]
                elif wanted[2]:
                    by_translation[b, r] = by_shift[j, r]
    if wanted[0]:
        by_joints[:] = total
