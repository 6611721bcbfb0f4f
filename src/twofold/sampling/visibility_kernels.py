"""Compiled bookkeeping of `visibility.seen_samples`, for CPUs."""

# pyright: reportMissingParameterType=false

import numpy as np

from twofold.kernels.parallel import compiled, compiled_part

_ONE, _HALF = np.float32(1), np.float32(0.5)


@compiled_part
def light_passing(distance, beta, delta):  # noqa: ANN001, ANN201
    """Share of the light that passes a step of `delta` metres at this signed distance: e to the -density * delta."""
    tail = _HALF * np.exp(-abs(distance) / beta)
    return np.exp(-(tail if distance > 0 else _ONE - tail) / beta * delta)


@compiled
def next_stretch(first, through, start, length, min_weight, index):  # noqa: ANN001, ANN201
    """Numbers of the samples `start`..`start + length` of each ray that still lets light through; how many there are.

    `first` [R + 1] is where each ray's samples begin.
    """
    count = 0
    for r in range(through.shape[0]):
        if through[r] > min_weight:
            for s in range(first[r] + start, min(first[r] + start + length, first[r + 1])):
                index[count] = s
                count += 1
    return count


@compiled
def follow(index, ray_index, delta, density, through, min_weight, seen):  # noqa: ANN001, ANN201
    """Follows the light through the samples `index` with their densities; marks those that add more than a little."""
    ray, light, optical = -1, np.float32(0), 0.0
    for i in range(index.shape[0]):
        s = index[i]
        if ray_index[s] != ray:
            if ray >= 0:
                through[ray] = light * np.float32(np.exp(-optical))
            ray, optical = ray_index[s], 0.0
            light = through[ray]
        here = density[i] * delta[s]
        seen[s] = light * np.float32(np.exp(-optical)) * np.float32(-np.expm1(-here)) > min_weight
        optical += here
    if ray >= 0:
        through[ray] = light * np.float32(np.exp(-optical))


@compiled
def next_on_rays(place, ends, through, min_weight, length, index):  # noqa: ANN001, ANN201
    """Numbers of the `length` candidates that each ray with light left looks at next; how many there are.

    They begin at `place` [R], which is moved behind them; `ends` [R] is where a ray's candidates end.
    """
    count = 0
    for r in range(through.shape[0]):
        if through[r] > min_weight:
            end = min(place[r] + length, ends[r])
            for s in range(place[r], end):
                index[count] = s
                count += 1
            place[r] = end
    return count


@compiled
def follow_to_surface(  # noqa: ANN201
    index, ray_at, depth_at, sdf, away, beta, delta, through, min_weight, seen, share, guard, place, ends  # noqa: ANN001
):  # fmt: skip
    """`follow` with the density of the distances `sdf`, seen[i] for index[i]; then rays far from the surface leap.

    A ray whose last candidate of `index` is further from the surface than `guard`, metres, from which on samples count,
    skips those within `share` times the distance that is left to that. The surface is no further than the
    body's, `away` metres: a longer distance comes from a sample that is mapped to nowhere.
    """
    for i in range(index.shape[0]):
        s, distance = index[i], sdf[i]
        r = ray_at[s]
        passing = light_passing(distance, beta, delta)
        seen[i] = through[r] * (_ONE - passing) > min_weight
        through[r] *= passing
        if share > 0 and s == place[r] - 1:
            _leap(r, depth_at[s] + share * (min(distance, away[i]) - guard), depth_at, place, ends)


@compiled
def leap_to_shell(index, excess, ray_at, depth_at, place, ends):  # noqa: ANN001, ANN201
    """Moves the rays whose last candidate of `index` is too far from the body, by `excess` metres, to the next near."""
    for i in range(index.shape[0]):
        s = index[i]
        r = ray_at[s]
        if s == place[r] - 1:
            _leap(r, depth_at[s] + excess[i], depth_at, place, ends)


@compiled_part
def _leap(r, reach, depth_at, place, ends):  # noqa: ANN001, ANN202
    """Moves a ray to its first candidate that is no nearer than `reach`."""
    while place[r] < ends[r] and depth_at[place[r]] < reach:
        place[r] += 1
