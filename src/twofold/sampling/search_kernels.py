"""Rays followed through a shell by a grid of signed distances, for CPUs; `shell_walk` has the arrays."""

# pyright: reportMissingParameterType=false

import numpy as np

from twofold.kernels.lanes import LANES
from twofold.kernels.parallel import compiled, compiled_part
from twofold.sampling.sdf_grid import KNOWN_BELOW, UNKNOWN
from twofold.sampling.visibility_kernels import light_passing
from twofold.sampling.walk_kernels import (
    FAR,
    divide,
    find_nearest,
    grown,
    is_closer,
    map_back,
    map_candidates,
    on_ray,
    row_at,
    weigh,
)

_ZERO, _ONE = np.float32(0), np.float32(1)
_KNOWN, _NOWHERE = np.float32(KNOWN_BELOW), np.float32(UNKNOWN)


@compiled
def choose(walk, grid, light, spacing, parts, begin, end):  # noqa: ANN001, ANN201
    """The samples of rays begin..end that may add more than a little by what a grid knows.

    Args:
        walk: what `map_candidates` takes before the candidates, as one tuple.
        grid: of this and the next two see `search`.
        light: see above.
        spacing: see above.
        parts: into how many the step of each candidate is divided.
        begin: first ray.
        end: ray behind the last.

    Returns:
        ray, depth, k nearest vertices and their weights, canonical point and inverse transform [S 12] of each sample.
    """
    shell, rays = walk[0], walk[1]
    found = search(*walk, grid, light, spacing, begin, end)
    if parts > 1:
        found = divide(shell, rays, found, parts)
    ray_at, depth_at = found[0], found[1]
    index = np.arange(len(ray_at))
    number, vertex, weight, point, inverse, _, _, _ = map_candidates(*walk, found, index, 0, len(index))
    possible = np.empty(len(number), np.bool_)
    mark_possible(number, ray_at, point, grid, light[0], light[1], np.float32(rays[5] / parts), possible)
    return _those(possible, ray_at[number], depth_at[number], vertex, weight, point, inverse)


@compiled
def keep_seen(sdf, beta, least, step, ray_at, depth_at, vertex, weight, point, inverse):  # noqa: ANN001, ANN201
    """Those of some samples that add more than a little to their pixels by their distances `sdf`; see `choose`."""
    seen = np.empty(len(sdf), np.bool_)
    ray, through = -1, _ONE
    for i in range(len(sdf)):
        if ray_at[i] != ray:
            ray, through = ray_at[i], _ONE
        passing = light_passing(sdf[i], beta, step)
        seen[i] = through * (_ONE - passing) > least
        through *= passing
    return _those(seen, ray_at, depth_at, vertex, weight, point, inverse)


@compiled_part
def _those(chosen, ray_at, depth_at, vertex, weight, point, inverse):  # noqa: ANN001, ANN202
    """The samples that are chosen, moved to the front of the arrays."""
    count = 0
    for i in range(len(chosen)):
        if chosen[i]:
            ray_at[count], depth_at[count] = ray_at[i], depth_at[i]
            vertex[count], weight[count] = vertex[i], weight[i]
            point[count], inverse[count] = point[i], inverse[i]
            count += 1
    return ray_at[:count], depth_at[:count], vertex[:count], weight[:count], point[:count], inverse[:count]


@compiled_part
def search(  # noqa: ANN201
    shell, rays, canonical, limit, slack, smooth, scale, forward, k, grid, light, spacing, begin, end  # noqa: ANN001
):  # fmt: skip
    """Ray, depth and row of the shell's lists for every step of rays begin..end that may add more than a little.

    A ray is followed until the grid knows that too little light is left. Where the surface is further than the distance
    from which on samples count, it leaps.

    Args:
        shell: of this and the next eight see `map_candidates`.
        rays: see `candidates`.
        canonical: see above.
        limit: see above.
        slack: see above.
        smooth: see above.
        scale: see above.
        forward: see above.
        k: see above.
        grid: (values, low, inverse spacing, error) of an `SdfGrid`.
        light: (scale of the density, least weight, share of a distance to leap, distance from which on samples count).
        spacing: how far the body's surface may be from its nearest vertex, metres.
        begin: first ray.
        end: ray behind the last.
    """
    low, voxel, row = shell[0], shell[1], shell[2]
    origins, directions, near, far, start, step = rays
    beta, least, share, guard = light
    nearest, vertices = shell[3], shell[4]
    other_low, other_voxel, other_row, other_nearest, other_vertices = canonical
    values, lowest, spaced, error = grid
    found, squares, weights = np.zeros(LANES, np.int64), np.full(LANES, FAR, np.float32), np.empty(k, np.float32)
    around, buffer = np.full((3, LANES), FAR, np.float32), np.empty((3, LANES), np.float32)
    room = (end - begin) * 8 + 64
    ray_of, depth_of, row_of = np.empty(room, np.int64), np.empty(room, np.float32), np.empty(room, np.int32)
    point, transform = np.empty((1, 3), np.float32), np.empty((1, 12), np.float32)
    count = 0
    inverse = np.float32(1 / voxel)
    for r in range(begin, end):
        steps = int(np.ceil((far[r] - near[r]) / step))
        through = _ONE
        i = 0
        while i < steps and through > least:
            depth = np.float32(near[r] + step * (i + start[r]))
            if depth >= far[r]:
                break
            x, y, z = on_ray(origins[r], directions[r], depth)
            at = row_at(x, y, z, low, inverse, row)
            i += 1
            if at < 0:
                i += max(0, int((-at - 3) * voxel / step))
                continue
            find_nearest(x, y, z, at, nearest, vertices, around, buffer, found, squares)
            away = np.sqrt(squares[0])
            if away >= limit:
                i += max(0, int((away - limit) / step))
                continue
            weigh(squares, smooth, scale, weights)
            map_back(x, y, z, found, weights, forward, buffer, transform, point, 0)
            a, b, c = point[0, 0], point[0, 1], point[0, 2]
            away -= slack
            if (
                slack > 0
                and away > 0
                and is_closer(a, b, c, away * away, other_low, other_voxel, other_row, other_nearest, other_vertices)
            ):
                continue
            distance = _distance_at(a, b, c, values, lowest, spaced)
            if distance < _KNOWN:
                nearer = distance - error
                if nearer > guard:
                    # Not further than the body's surface: a longer distance belongs to a sample mapped to nowhere.
                    body = np.sqrt(max(squares[0] - spacing * spacing, _ZERO))
                    i += max(0, int(np.ceil(share * (min(nearer, body) - guard) / step)) - 1)
                    continue
                seen = through * (_ONE - light_passing(nearer, beta, step)) > least
                through *= light_passing(distance + error, beta, step)
                if not seen:
                    continue
            if count == room:
                room *= 2
                ray_of, depth_of, row_of = grown(ray_of, room), grown(depth_of, room), grown(row_of, room)
            ray_of[count], depth_of[count], row_of[count] = r, depth, at
            count += 1
    return ray_of[:count], depth_of[:count], row_of[:count]


@compiled
def mark_possible(number, ray_at, point, grid, beta, least, step, possible):  # noqa: ANN001, ANN201
    """possible[S] = whether a sample may add more than `least` to its pixel, by the bounds of a grid.

    Args:
        number: of each sample among the candidates, in their order.
        ray_at: ray of each candidate.
        point: canonical position of each sample, metres.
        grid: see `search`.
        beta: scale of the density, metres.
        least: smallest weight that counts.
        step: metres.
        possible: the answer.
    """
    values, lowest, spaced, error = grid
    ray, through = -1, _ONE
    for i in range(number.shape[0]):
        if ray_at[number[i]] != ray:
            ray, through = ray_at[number[i]], _ONE
        distance = _distance_at(point[i, 0], point[i, 1], point[i, 2], values, lowest, spaced)
        if distance >= _KNOWN:
            possible[i] = through > least
            continue
        possible[i] = through * (_ONE - light_passing(distance - error, beta, step)) > least
        through *= light_passing(distance + error, beta, step)


@compiled_part
def _distance_at(x, y, z, values, low, inverse):  # noqa: ANN001, ANN202
    """The trilinear distance of a grid at a point; huge where it is not known."""
    u, v, w = (x - low[0]) * inverse, (y - low[1]) * inverse, (z - low[2]) * inverse
    size_x, size_y, size_z = values.shape
    # Before numbers become integers: huge ones and NaN have none.
    if not (0 <= u < size_x - 1 and 0 <= v < size_y - 1 and 0 <= w < size_z - 1):
        return _NOWHERE
    a, b, c = int(u), int(v), int(w)
    largest = max(
        max(values[a, b, c], values[a, b, c + 1], values[a, b + 1, c], values[a, b + 1, c + 1]),
        max(values[a + 1, b, c], values[a + 1, b, c + 1], values[a + 1, b + 1, c], values[a + 1, b + 1, c + 1]),
    )
    if largest >= _KNOWN:
        return _NOWHERE
    u, v, w = u - np.float32(a), v - np.float32(b), w - np.float32(c)
    x00 = values[a, b, c] + w * (values[a, b, c + 1] - values[a, b, c])
    x01 = values[a, b + 1, c] + w * (values[a, b + 1, c + 1] - values[a, b + 1, c])
    x10 = values[a + 1, b, c] + w * (values[a + 1, b, c + 1] - values[a + 1, b, c])
    x11 = values[a + 1, b + 1, c] + w * (values[a + 1, b + 1, c + 1] - values[a + 1, b + 1, c])
    x0, x1 = x00 + v * (x01 - x00), x10 + v * (x11 - x10)
    return x0 + u * (x1 - x0)
