"""The compiled walk of rays through a shell, for CPUs; `shell` holds its twin in PyTorch, for GPUs and for tests."""

# pyright: reportMissingParameterType=false

import numpy as np

from twofold.kernels.parallel import compiled


@compiled
def walk(origins, directions, near, far, start, step, low, voxel, row, nearest, vertices, limit, begin, end):  # noqa: ANN001, ANN201
    """Samples of rays begin..end within `limit` metres of their nearest listed vertex.

    `row` gives the row of `nearest` for each voxel, or -k where no voxel of the shell is closer than k - 1 voxels, so
    that empty space is crossed in leaps.

    Returns:
        ray, depth, nearest vertex and squared distance of each sample.
    """
    room = (end - begin) * 24 + 64
    ray_of, depth_of = np.empty(room, np.int64), np.empty(room, np.float32)
    vertex_of, square_of = np.empty(room, np.int64), np.empty(room, np.float32)
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
            best, which = np.float32(1e30), -1
            for k in range(nearest.shape[1]):
                v = nearest[at, k]
                dx, dy, dz = x - vertices[v, 0], y - vertices[v, 1], z - vertices[v, 2]
                square = dx * dx + dy * dy + dz * dz
                if square < best:
                    best, which = square, v
            if best >= limit_square:
                continue
            if count == room:
                room *= 2
                ray_of, depth_of = _grown(ray_of, room), _grown(depth_of, room)
                vertex_of, square_of = _grown(vertex_of, room), _grown(square_of, room)
            ray_of[count], depth_of[count], vertex_of[count], square_of[count] = r, depth, which, best
            count += 1
    return ray_of[:count], depth_of[:count], vertex_of[:count], square_of[:count]


@compiled
def _grown(old, room):  # noqa: ANN001, ANN202
    new = np.empty(room, old.dtype)
    new[: old.shape[0]] = old
    return new
