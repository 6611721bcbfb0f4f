"""Nearest triangles by a tree of boxes, compiled, for CPUs."""

# pyright: reportMissingParameterType=false

import numpy as np
from jaxtyping import Float, Int

from twofold.kernels.parallel import compiled, in_parts

_LEAF = 4
"""Triangles in a box that is not divided any more."""
_DEPTH = 128
"""Boxes that wait at most; each division halves a box's triangles, so it is far less."""


def nearest_triangles(
    points: Float[np.ndarray, "n 3"], corners: Float[np.ndarray, "F 3 3"]
) -> tuple[Float[np.ndarray, "n"], Int[np.ndarray, "n"], Float[np.ndarray, "n 3"]]:
    """Distance from each point to the nearest of at least one triangle, which one that is, and the nearest point on it.

    >>> corners = np.array([[[0.0, 0, 0], [1, 0, 0], [0, 1, 0]], [[0, 0, 5], [1, 0, 5], [0, 1, 5]]])
    >>> distance, triangle, nearest = nearest_triangles(np.array([[0.25, 0.25, 4.0]]), corners)
    >>> distance.tolist(), triangle.tolist(), nearest.tolist()
    ([1.0], [1], [[0.25, 0.25, 5.0]])
    """
    points, corners = points.astype(np.float64), np.ascontiguousarray(corners, dtype=np.float64)
    tree = _build(corners, _LEAF)
    distance, triangle, nearest = np.empty(len(points)), np.empty(len(points), np.int64), np.empty((len(points), 3))
    in_parts(
        len(points), lambda begin, end: _search(points, corners, *tree, distance, triangle, nearest, begin, end), 256
    )
    return distance, triangle, nearest


@compiled
def _build(corners, leaf):  # noqa: ANN001, ANN202
    """Boxes with their first child (the second follows; -1 for none) and their part of the order of triangles."""
    count = corners.shape[0]
    middles = (corners[:, 0] + corners[:, 1] + corners[:, 2]) / 3
    order = np.arange(count)
    most = 2 * count + 1
    low, high = np.empty((most, 3)), np.empty((most, 3))
    child, first, last = np.full(most, -1), np.zeros(most, np.int64), np.zeros(most, np.int64)
    last[0] = count
    nodes = 1
    node = 0
    while node < nodes:
        begin, end = first[node], last[node]
        spread_axis, spread = 0, -1.0
        for axis in range(3):
            a, b = np.inf, -np.inf
            c, d = np.inf, -np.inf
            for i in range(begin, end):
                t = order[i]
                for corner in range(3):
                    value = corners[t, corner, axis]
                    a, b = min(a, value), max(b, value)
                c, d = min(c, middles[t, axis]), max(d, middles[t, axis])
            low[node, axis], high[node, axis] = a, b
            if d - c > spread:
                spread_axis, spread = axis, d - c
        if end - begin > leaf:
            part = order[begin:end]
            keys = np.empty(end - begin)
            for i in range(end - begin):
                keys[i] = middles[part[i], spread_axis]
            order[begin:end] = part[np.argsort(keys)]
            middle = (begin + end) // 2
            child[node] = nodes
            first[nodes], last[nodes] = begin, middle
            first[nodes + 1], last[nodes + 1] = middle, end
            nodes += 2
        node += 1
    return low[:nodes], high[:nodes], child[:nodes], first[:nodes], last[:nodes], order


@compiled
def _search(points, corners, low, high, child, first, last, order, distance, triangle, nearest, begin, end):  # noqa: ANN001, ANN202
    """Fills distance, triangle and nearest point of points begin..end."""
    waiting, away = np.empty(_DEPTH, np.int64), np.empty(_DEPTH)
    foot, best_foot = np.empty(3), np.empty(3)
    for p in range(begin, end):
        point = points[p]
        best, which = np.inf, -1
        waiting[0], away[0] = 0, 0.0
        count = 1
        while count:
            count -= 1
            node = waiting[count]
            if away[count] >= best:
                continue
            if child[node] < 0:
                for i in range(first[node], last[node]):
                    square = _closest(point, corners[order[i]], foot)
                    if square < best:
                        best, which = square, order[i]
                        best_foot[:] = foot
                continue
            left = child[node]
            one, two = _to_box(point, low[left], high[left]), _to_box(point, low[left + 1], high[left + 1])
            near, far = (left, left + 1) if one <= two else (left + 1, left)
            # The nearer one lies on top, so that it is searched first.
            waiting[count], away[count] = far, max(one, two)
            waiting[count + 1], away[count + 1] = near, min(one, two)
            count += 2
        distance[p], triangle[p] = np.sqrt(best), which
        nearest[p] = best_foot


@compiled
def _to_box(point, low, high):  # noqa: ANN001, ANN202
    """Squared distance to a box, zero inside."""
    total = 0.0
    for axis in range(3):
        outside = max(low[axis] - point[axis], point[axis] - high[axis], 0.0)
        total += outside * outside
    return total


@compiled
def _closest(point, corners, foot):  # noqa: ANN001, ANN202
    """Squared distance to a triangle; its point nearest to `point` goes into `foot`."""
    aa, bb, mixed, p, q = 0.0, 0.0, 0.0, 0.0, 0.0
    for axis in range(3):
        ab, ac = corners[1, axis] - corners[0, axis], corners[2, axis] - corners[0, axis]
        ap = point[axis] - corners[0, axis]
        aa += ab * ab
        bb += ac * ac
        mixed += ab * ac
        p += ap * ab
        q += ap * ac
    determinant = aa * bb - mixed * mixed
    if determinant > 1e-20:
        v, w = (bb * p - mixed * q) / determinant, (aa * q - mixed * p) / determinant
        if v >= 0 and w >= 0 and v + w <= 1:
            square = 0.0
            for axis in range(3):
                a = corners[0, axis]
                foot[axis] = a + v * (corners[1, axis] - a) + w * (corners[2, axis] - a)
                square += (point[axis] - foot[axis]) ** 2
            return square
    best = np.inf
    for edge in range(3):
        start, end = corners[edge], corners[(edge + 1) % 3]
        along, length = 0.0, 0.0
        for axis in range(3):
            along += (point[axis] - start[axis]) * (end[axis] - start[axis])
            length += (end[axis] - start[axis]) ** 2
        share = min(max(along / max(length, 1e-20), 0.0), 1.0)
        square = 0.0
        for axis in range(3):
            square += (point[axis] - start[axis] - share * (end[axis] - start[axis])) ** 2
        if square < best:
            best = square
            for axis in range(3):
                foot[axis] = start[axis] + share * (end[axis] - start[axis])
    return best
