"""Rays walked through a shell, each sample mapped to canonical space on the way; `shell_walk` has the arrays.

One look at the vertices that a sample's voxel lists gives its nearest ones, their weights, its canonical position, and
whether it is mis-warped. `shell`, `skinning_kernels` and `pruning` do the same one after the other.
"""

# pyright: reportMissingParameterType=false

import numpy as np

from twofold.kernels.lanes import (
    LANES,
    apart,
    distinct,
    fill,
    load,
    minus,
    one_more_where_less,
    scaled,
    spread,
    store,
    times_plus,
)
from twofold.kernels.parallel import compiled, compiled_part

FAR = np.float32(1e9)
_ZERO, _ONE = np.float32(0), np.float32(1)


@compiled
def candidates(shell, rays, begin, end):  # noqa: ANN001, ANN201
    """Ray, depth and row of the shell's lists for every step of rays begin..end that lies in a listed voxel.

    Args:
        shell: (low, voxel, row, nearest, vertices) of a `Shell`.
        rays: (origins, directions, near, far, start, step): a ray's steps begin at its near end, shifted by the part
            `start` of a step.
        begin: first ray.
        end: ray behind the last.
    """
    low, voxel, row = shell[0], shell[1], shell[2]
    origins, directions, near, far, start, step = rays
    room = (end - begin) * 24 + 64
    ray_of, depth_of, row_of = np.empty(room, np.int64), np.empty(room, np.float32), np.empty(room, np.int32)
    count = 0
    inverse = np.float32(1 / voxel)
    for r in range(begin, end):
        steps = int(np.ceil((far[r] - near[r]) / step))
        i = 0
        while i < steps:
            depth = np.float32(near[r] + step * (i + start[r]))
            if depth >= far[r]:
                break
            x, y, z = on_ray(origins[r], directions[r], depth)
            at = row_at(x, y, z, low, inverse, row)
            i += 1
            if at < 0:
                # Nothing of the shell within -at - 1 voxels of this one's centre; a diagonal is kept in hand.
                i += max(0, int((-at - 3) * voxel / step))
                continue
            if count == room:
                room *= 2
                ray_of, depth_of, row_of = grown(ray_of, room), grown(depth_of, room), grown(row_of, room)
            ray_of[count], depth_of[count], row_of[count] = r, depth, at
            count += 1
    return ray_of[:count], depth_of[:count], row_of[:count]


@compiled
def divide(shell, rays, on_rays, parts):  # noqa: ANN001, ANN201
    """`parts` candidates evenly spread over the step of each of these; arrays as in `candidates`."""
    low, voxel, row = shell[0], shell[1], shell[2]
    origins, directions, near, far, _, step = rays
    ray_at, depth_at, _ = on_rays
    room = ray_at.shape[0] * parts
    ray_of, depth_of, row_of = np.empty(room, np.int64), np.empty(room, np.float32), np.empty(room, np.int32)
    count = 0
    inverse = np.float32(1 / voxel)
    for s in range(ray_at.shape[0]):
        r = ray_at[s]
        for part in range(parts):
            depth = np.float32(depth_at[s] + step * ((part + 0.5) / parts - 0.5))
            if depth < near[r] or depth >= far[r]:
                continue
            x, y, z = on_ray(origins[r], directions[r], depth)
            at = row_at(x, y, z, low, inverse, row)
            if at >= 0:
                ray_of[count], depth_of[count], row_of[count] = r, depth, at
                count += 1
    return ray_of[:count], depth_of[:count], row_of[:count]


@compiled
def map_candidates(  # noqa: ANN201
    shell, rays, canonical, limit, slack, smooth, scale, forward, k, found_on_rays, index, begin, end  # noqa: ANN001
):  # fmt: skip
    """Maps candidates to canonical space; those too far from the body and the mis-warped ones are left out.

    Args:
        shell: (low, voxel, row, nearest, vertices) of a `Shell` with at most 16 candidates a voxel.
        rays: see `candidates`.
        canonical: the shell of the canonical body.
        limit: largest distance to the nearest listed vertex, metres.
        slack: a sample that comes closer to the canonical body by more than this is mis-warped, metres; 0 keeps all.
        smooth: weights are those of `smooth_neighbour_weights`, else of `neighbour_weights`.
        scale: scene units per metre for the latter.
        forward: canonical-to-posed transform of each vertex, [V 16], row by row, the last four numbers zero.
        k: how many nearest vertices blend.
        found_on_rays: what `candidates` found.
        index: which of these to map.
        begin: first place in `index`.
        end: place behind the last.

    Returns:
        number of the candidate, k nearest vertices and their weights, canonical point, inverse transform [S 12], and
        distance to the nearest vertex of each sample; then number of each candidate too far from the body, and how many
        metres too far.
    """
    nearest, vertices = shell[3], shell[4]
    other_low, other_voxel, other_row, other_nearest, other_vertices = canonical
    ray_at, depth_at, row_at_of = found_on_rays
    room = end - begin
    number_of, far_of = np.empty(room, np.int64), np.empty(room, np.int64)
    away_of, excess_of = np.empty(room, np.float32), np.empty(room, np.float32)
    vertex_of, weight_of = np.empty((room, k), np.int64), np.empty((room, k), np.float32)
    point_of, inverse_of = np.empty((room, 3), np.float32), np.empty((room, 12), np.float32)
    found, squares, weights = np.zeros(LANES, np.int64), np.full(LANES, FAR, np.float32), np.empty(k, np.float32)
    around, buffer = np.full((3, LANES), FAR, np.float32), np.empty((3, LANES), np.float32)
    origins, directions = rays[0], rays[1]
    count = far = 0
    # Hardly any branch depends on the data, so the processor fetches the next samples' lists beforehand.
    for place in range(begin, end):
        i = index[place]
        r, depth, at = ray_at[i], depth_at[i], row_at_of[i]
        x, y, z = on_ray(origins[r], directions[r], depth)
        find_nearest(x, y, z, at, nearest, vertices, around, buffer, found, squares)
        weigh(squares, smooth, scale, weights)
        map_back(x, y, z, found, weights, forward, buffer, inverse_of, point_of, count)
        number_of[count] = i
        for j in range(k):
            vertex_of[count, j], weight_of[count, j] = found[j], weights[j]
        away_of[count] = np.sqrt(squares[0])
        kept = squares[0] < limit * limit
        if not kept:
            far_of[far], excess_of[far] = i, away_of[count] - limit
            far += 1
        away = away_of[count] - slack
        if kept and slack > 0 and away > 0:
            kept = not is_closer(
                point_of[count, 0], point_of[count, 1], point_of[count, 2], away * away,
                other_low, other_voxel, other_row, other_nearest, other_vertices,
            )  # fmt: skip
        count += int(kept)
    return (
        number_of[:count], vertex_of[:count], weight_of[:count], point_of[:count], inverse_of[:count],
        away_of[:count], far_of[:far], excess_of[:far],
    )  # fmt: skip


@compiled_part
def on_ray(origin, direction, depth):  # noqa: ANN001, ANN201
    """The point of a ray at a depth."""
    return origin[0] + depth * direction[0], origin[1] + depth * direction[1], origin[2] + depth * direction[2]


@compiled_part
def row_at(x, y, z, low, inverse, row):  # noqa: ANN001, ANN201
    """What `row` says of a point's voxel; outside of the grid -1."""
    a = int(np.floor((x - low[0]) * inverse))
    b = int(np.floor((y - low[1]) * inverse))
    c = int(np.floor((z - low[2]) * inverse))
    if a < 0 or b < 0 or c < 0 or a >= row.shape[0] or b >= row.shape[1] or c >= row.shape[2]:
        return np.int32(-1)
    return row[a, b, c]


@compiled_part
def find_nearest(x, y, z, at, listed, vertices, around, buffer, found, squares):  # noqa: ANN001, ANN201
    """All vertices listed in a row and their squared distances, nearest first; `around` and `buffer` are work space."""
    for j in range(listed.shape[1]):
        v = listed[at, j]
        around[0, j], around[1, j], around[2, j] = vertices[v, 0], vertices[v, 1], vertices[v, 2]
    dx = minus(fill(x), load(around, 0, 0))
    dy = minus(fill(y), load(around, 1, 0))
    dz = minus(fill(z), load(around, 2, 0))
    square = distinct(times_plus(dx, dx, times_plus(dy, dy, times_plus(dz, dz, fill(_ZERO)))))
    store(buffer, 0, 0, square)
    # A vertex comes as many places behind the first as there are nearer ones.
    place = fill(_ZERO)
    for j in range(listed.shape[1]):
        place = one_more_where_less(spread(buffer, 0, j), square, place)
    store(buffer, 1, 0, place)
    for j in range(listed.shape[1]):
        rank = int(buffer[1, j])
        found[rank], squares[rank] = listed[at, j], buffer[0, j]


@compiled_part
def weigh(squares, smooth, scale, weights):  # noqa: ANN001, ANN201
    """Weights of the nearest vertices by their squared distances."""
    count = weights.shape[0]
    total = _ZERO
    share = _ONE / max(squares[count - 1], np.float32(1e-12))
    for j in range(count):
        if smooth:
            part = _ONE - squares[j] * share
            weights[j] = part * part + np.float32(1e-6)
        else:
            weights[j] = np.exp(-min(squares[j] * scale * scale, np.float32(4)))
        total += weights[j]
    share = _ONE / total
    for j in range(count):
        weights[j] *= share


@compiled_part
def map_back(x, y, z, found, weights, forward, buffer, inverse, point, s):  # noqa: ANN001, ANN201
    """Row `s` of the blended transforms' inverses, [S 12], and of the points that they make of x, y, z."""
    mixed = scaled(weights[0], load(forward, found[0], 0))
    for j in range(1, weights.shape[0]):
        mixed = times_plus(fill(weights[j]), load(forward, found[j], 0), mixed)
    store(buffer, 2, 0, mixed)
    a0, a1, a2, a3 = buffer[2, 0], buffer[2, 1], buffer[2, 2], buffer[2, 3]
    b0, b1, b2, b3 = buffer[2, 4], buffer[2, 5], buffer[2, 6], buffer[2, 7]
    c0, c1, c2, c3 = buffer[2, 8], buffer[2, 9], buffer[2, 10], buffer[2, 11]
    i00, i01, i02 = b1 * c2 - b2 * c1, c1 * a2 - c2 * a1, a1 * b2 - a2 * b1
    i10, i11, i12 = b2 * c0 - b0 * c2, c2 * a0 - c0 * a2, a2 * b0 - a0 * b2
    i20, i21, i22 = b0 * c1 - b1 * c0, c0 * a1 - c1 * a0, a0 * b1 - a1 * b0
    scale = _ONE / (a0 * i00 + a1 * i10 + a2 * i20)
    i00, i01, i02 = i00 * scale, i01 * scale, i02 * scale
    i10, i11, i12 = i10 * scale, i11 * scale, i12 * scale
    i20, i21, i22 = i20 * scale, i21 * scale, i22 * scale
    t0, t1, t2 = -(i00 * a3 + i01 * b3 + i02 * c3), -(i10 * a3 + i11 * b3 + i12 * c3), -(i20 * a3 + i21 * b3 + i22 * c3)
    inverse[s, 0], inverse[s, 1], inverse[s, 2], inverse[s, 3] = i00, i01, i02, t0
    inverse[s, 4], inverse[s, 5], inverse[s, 6], inverse[s, 7] = i10, i11, i12, t1
    inverse[s, 8], inverse[s, 9], inverse[s, 10], inverse[s, 11] = i20, i21, i22, t2
    point[s, 0] = i00 * x + i01 * y + i02 * z + t0
    point[s, 1] = i10 * x + i11 * y + i12 * z + t1
    point[s, 2] = i20 * x + i21 * y + i22 * z + t2


@compiled_part
def is_closer(x, y, z, square, low, voxel, row, nearest, vertices):  # noqa: ANN001, ANN201
    """Whether a listed vertex of a shell is closer to a point than the root of `square`."""
    at = row_at(x, y, z, low, np.float32(1 / voxel), row)
    if at < 0:
        return False
    for j in range(nearest.shape[1]):
        v = nearest[at, j]
        dx, dy, dz = x - vertices[v, 0], y - vertices[v, 1], z - vertices[v, 2]
        if dx * dx + dy * dy + dz * dz < square:
            return True
    return False


@compiled_part
def grown(old, room):  # noqa: ANN001, ANN201
    """A longer array that begins like `old`."""
    apart()
    new = np.empty(room, old.dtype)
    new[: old.shape[0]] = old
    return new
