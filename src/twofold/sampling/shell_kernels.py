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


@compiled
def list_vertices(vertices, low, voxel, reach, near, listed, squares, begin, end):  # noqa: ANN001, ANN201
    """listed[N C], squares[N C] = the vertices nearest to the centre of each voxel, as far as they lie within `reach`.

    `near` [X Y Z] is the row of a voxel, or negative. Every vertex offers itself to the voxels around it; `begin`,
    `end` are the slabs of voxels that a call fills.
    """
    k = listed.shape[1]
    edge, limit = np.float32(voxel), np.float32(reach * reach)
    half = np.float32(0.5)
    for v in range(vertices.shape[0]):
        u = (vertices[v, 0] - low[0]) / edge - half
        w = (vertices[v, 1] - low[1]) / edge - half
        t = (vertices[v, 2] - low[2]) / edge - half
        span = np.float32(reach / voxel)
        for a in range(max(begin, int(np.ceil(u - span))), min(end, int(np.floor(u + span)) + 1)):
            dx = (a - u) * edge
            left = limit - dx * dx
            if left < 0:
                continue
            wide = np.sqrt(left) / edge
            for b in range(max(0, int(np.ceil(w - wide))), min(near.shape[1], int(np.floor(w + wide)) + 1)):
                dy = (b - w) * edge
                rest = left - dy * dy
                if rest < 0:
                    continue
                deep = np.sqrt(rest) / edge
                for c in range(max(0, int(np.ceil(t - deep))), min(near.shape[2], int(np.floor(t + deep)) + 1)):
                    n = near[a, b, c]
                    if n < 0:
                        continue
                    dz = (c - t) * edge
                    square = np.float32(dx * dx + dy * dy + dz * dz)
                    if square < squares[n, k - 1]:
                        place = k - 1
                        while place > 0 and squares[n, place - 1] > square:
                            squares[n, place], listed[n, place] = squares[n, place - 1], listed[n, place - 1]
                            place -= 1
                        squares[n, place], listed[n, place] = square, v
