"""Compiled bookkeeping of `visibility.seen_samples`, for CPUs."""

# pyright: reportMissingParameterType=false

import numpy as np

from twofold.kernels.parallel import compiled


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
