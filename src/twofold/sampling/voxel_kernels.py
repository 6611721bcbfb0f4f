"""Compiled loops that build a shell: which voxels lie near a body, and which vertices are nearest to each.

Legend: `low` corner of the voxel grid, `voxel` edge of a voxel, `reach` metres; `begin`, `end` the slabs of voxels that
a call fills. Every vertex visits the voxels around it, line by line, as that is quicker than to ask for each voxel.
"""

# pyright: reportMissingParameterType=false

import numpy as np

from twofold.kernels.lanes import insert, insert_beside, load, store
from twofold.kernels.parallel import compiled, compiled_part

_HALF = np.float32(0.5)


@compiled_part
def _span(middle, wide, first, end):  # noqa: ANN001, ANN202
    """Whole numbers within `wide` of the middle, of those from `first` to `end`."""
    return max(first, int(np.ceil(middle - wide))), min(end, int(np.floor(middle + wide)) + 1)


@compiled
def mark(vertices, low, voxel, reach, inside, begin, end):  # noqa: ANN001, ANN201
    """inside[X Y Z] = whether a vertex lies within `reach` of the voxel's centre; false before."""
    edge, limit = np.float32(voxel), np.float32(reach * reach)
    for v in range(vertices.shape[0]):
        x, y = (vertices[v, 0] - low[0]) / edge - _HALF, (vertices[v, 1] - low[1]) / edge - _HALF
        z = (vertices[v, 2] - low[2]) / edge - _HALF
        first, last = _span(x, np.float32(reach / voxel), begin, end)
        for a in range(first, last):
            left = limit - (a - x) * (a - x) * edge * edge
            if left < 0:
                continue
            near, far = _span(y, np.sqrt(left) / edge, 0, inside.shape[1])
            for b in range(near, far):
                rest = left - (b - y) * (b - y) * edge * edge
                if rest < 0:
                    continue
                bottom, top = _span(z, np.sqrt(rest) / edge, 0, inside.shape[2])
                for c in range(bottom, top):
                    inside[a, b, c] = True


@compiled
def number(inside, row, blocks):  # noqa: ANN001, ANN201
    """row[X Y Z] = numbers of the voxels that are inside, else -1; blocks of two by two by two with one are false.

    Returns:
        how many voxels are inside.
    """
    count = 0
    for a in range(inside.shape[0]):
        for b in range(inside.shape[1]):
            for c in range(inside.shape[2]):
                row[a, b, c] = -1
                if inside[a, b, c]:
                    row[a, b, c] = count
                    blocks[a // 2, b // 2, c // 2] = False
                    count += 1
    return count


@compiled
def tell_distance(row, away):  # noqa: ANN001, ANN201
    """row[X Y Z] = -k for voxels outside, none inside being closer than k - 1 voxels.

    `away` are distances from block to block, in blocks; two voxels may be closer by a diagonal of both halves.
    """
    diagonal = np.sqrt(3.0) + 0.01
    for a in range(row.shape[0]):
        for b in range(row.shape[1]):
            for c in range(row.shape[2]):
                if row[a, b, c] < 0:
                    row[a, b, c] = -1 - int(max(2 * away[a // 2, b // 2, c // 2] - diagonal, 0.0))


@compiled
def list_vertices(vertices, low, voxel, reach, row, count, numbers, squares, begin, end):  # noqa: ANN001, ANN201
    """squares[N 16], numbers[N 16] = the first `count` of the vertices nearest to each voxel's centre, within `reach`.

    `squares` are infinite before. Numbers are exact as floats up to sixteen million.
    """
    edge, limit = np.float32(voxel), np.float32(reach * reach)
    for v in range(vertices.shape[0]):
        x, y = (vertices[v, 0] - low[0]) / edge - _HALF, (vertices[v, 1] - low[1]) / edge - _HALF
        z = (vertices[v, 2] - low[2]) / edge - _HALF
        first, last = _span(x, np.float32(reach / voxel), begin, end)
        for a in range(first, last):
            left = limit - (a - x) * (a - x) * edge * edge
            if left < 0:
                continue
            near, far = _span(y, np.sqrt(left) / edge, 0, row.shape[1])
            for b in range(near, far):
                rest = left - (b - y) * (b - y) * edge * edge
                if rest < 0:
                    continue
                bottom, top = _span(z, np.sqrt(rest) / edge, 0, row.shape[2])
                for c in range(bottom, top):
                    n = row[a, b, c]
                    if n < 0:
                        continue
                    dx, dy, dz = (a - x) * edge, (b - y) * edge, (c - z) * edge
                    square = np.float32(dx * dx + dy * dy + dz * dz)
                    if square < squares[n, count - 1]:
                        old = load(squares, n, 0)
                        store(numbers, n, 0, insert_beside(old, square, load(numbers, n, 0), np.float32(v)))
                        store(squares, n, 0, insert(old, square))
