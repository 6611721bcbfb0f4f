"""The compiled walk of rays through a shell, for CPUs; `shell` holds its twin in PyTorch, for GPUs and for tests."""

# pyright: reportMissingParameterType=false

import numpy as np

from twofold.kernels.parallel import compiled


@compiled
def walk(origins, directions, near, far, start, step, low, voxel, row, nearest, vertices, limit, k, begin, end):  # noqa: ANN001, ANN201
    """Samples of rays begin..end within `limit` metres of their nearest listed vertex.

    `row` gives the row of `nearest` for each voxel, or -k where no voxel of the shell is closer than k - 1 voxels, so
    that empty space is crossed in leaps.

    Returns:
        ray, depth, k nearest vertices and their squared distances of each sample.
    """
    room = (end - begin) * 24 + 64
    ray_of, depth_of = np.empty(room, np.int64), np.empty(room, np.float32)
    vertex_of, square_of = np.empty((room, k), np.int64), np.empty((room, k), np.float32)
    found, squares = np.empty(k, np.int64), np.empty(k, np.float32)
    count = 0
    inverse = np.float32(1 / voxel)
    limit_square = np.float32(limit * limit)
    for r in range(begin, end):
        steps = int(np.ceil((far[r] - near[r]) / step))
        i = 0
        while i < steps:
            depth = np.float32(near[r] + step * (i + start[r]))
            if depth >= far[r]:
                break
            x = origins[r, 0] + depth * directions[r, 0]
            y = origins[r, 1] + depth * directions[r, 1]
            z = origins[r, 2] + depth * directions[r, 2]
            a = int(np.floor((x - low[0]) * inverse))
            b = int(np.floor((y - low[1]) * inverse))
            c = int(np.floor((z - low[2]) * inverse))
            i += 1
            if a < 0 or b < 0 or c < 0 or a >= row.shape[0] or b >= row.shape[1] or c >= row.shape[2]:
                continue
            at = row[a, b, c]
            if at < 0:
                # Nothing of the shell within -at - 1 voxels of this one's centre; a diagonal is kept in hand.
                leap = int((-at - 3) * voxel / step)
                if leap > 0:
                    i += leap
                continue
            _nearest_listed(x, y, z, nearest[at], vertices, found, squares)
            if squares[0] >= limit_square:
                continue
            if count == room:
                room *= 2
                ray_of, depth_of = _grown(ray_of, room), _grown(depth_of, room)
                vertex_of, square_of = _grown_rows(vertex_of, room), _grown_rows(square_of, room)
            ray_of[count], depth_of[count] = r, depth
            vertex_of[count], square_of[count] = found, squares
            count += 1
    return ray_of[:count], depth_of[:count], vertex_of[:count], square_of[:count]


@compiled
def _grown(old, room):  # noqa: ANN001, ANN202
    new = np.empty(room, old.dtype)
    new[: old.shape[0]] = old
    return new


@compiled
def _grown_rows(old, room):  # noqa: ANN001, ANN202
    new = np.empty((room, old.shape[1]), old.dtype)
    new[: old.shape[0]] = old
    return new


@compiled
def _nearest_listed(x, y, z, listed, vertices, found, squares):  # noqa: ANN001, ANN202
    """The nearest of the listed vertices, as many as `found` holds, and their squared distances, nearest first."""
    k = found.shape[0]
    squares[:] = np.float32(np.inf)
    for c in range(listed.shape[0]):
        v = listed[c]
        dx, dy, dz = x - vertices[v, 0], y - vertices[v, 1], z - vertices[v, 2]
        square = dx * dx + dy * dy + dz * dz
        if square < squares[k - 1]:
            place = k - 1
            while place > 0 and squares[place - 1] > square:
                squares[place], found[place] = squares[place - 1], found[place - 1]
                place -= 1
            squares[place], found[place] = square, v


@compiled
def miswarped(x_posed, x_canonical, first, posed, low, voxel, row, nearest, vertices, slack, out, begin, end):  # noqa: ANN001, ANN201
    """out[S] = whether the canonical point is closer to the canonical body than the posed one, `slack` granted.

    `first` [S] is each sample's nearest vertex, `posed` [V 3] the posed vertices; the rest is the canonical shell.
    """
    inverse = np.float32(1 / voxel)
    found, squares = np.empty(1, np.int64), np.empty(1, np.float32)
    for s in range(begin, end):
        out[s] = False
        total = np.float32(0)
        for i in range(3):
            difference = x_posed[s, i] - posed[first[s], i]
            total += difference * difference
        away = np.sqrt(total)
        if away <= slack:
            continue
        x, y, z = x_canonical[s, 0], x_canonical[s, 1], x_canonical[s, 2]
        a = int(np.floor((x - low[0]) * inverse))
        b = int(np.floor((y - low[1]) * inverse))
        c = int(np.floor((z - low[2]) * inverse))
        if a < 0 or b < 0 or c < 0 or a >= row.shape[0] or b >= row.shape[1] or c >= row.shape[2] or row[a, b, c] < 0:
            continue
        _nearest_listed(x, y, z, nearest[row[a, b, c]], vertices, found, squares)
        out[s] = np.sqrt(squares[0]) < away - slack
