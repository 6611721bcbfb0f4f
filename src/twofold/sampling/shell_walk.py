"""Samples in a shell with their way to canonical space, found in compiled loops on CPUs."""

import math
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from twofold.geometry.cameras import Rays
from twofold.kernels.lanes import LANES
from twofold.kernels.parallel import in_parts, one_thread_each
from twofold.sampling import search_kernels, visibility_kernels, walk_kernels
from twofold.sampling.placement import Deformation, FieldQuery, Placement
from twofold.sampling.sdf_grid import SdfGrid
from twofold.sampling.shell import Shell, listed_on_rays, ray_arrays, ray_starts, shell_arrays
from twofold.volume.samples import Samples

_PATIENCE = 3
"""Rounds after which the few rays that are left look at one more candidate in each round."""
_STRETCH = 8
"""Candidates of the first round where rays do not leap; the next rounds take two, three times this number."""
_FEW = 256
"""Candidates that are worth a thread of their own: a round of a training step has about a thousand."""
_FEW_RAYS = 64
"""Rays that are worth a thread of their own."""
_Leap = tuple[float, np.ndarray, np.ndarray]
"""Share of the distance to the surface that a ray leaps over; each ray's next candidate, and where these end."""
_OnRays = tuple[np.ndarray, np.ndarray, np.ndarray]
"""Number of the ray, depth and row of the shell's lists of candidates, ray by ray."""
_POINT = 4
"""The canonical points among the arrays that `search_kernels.choose` returns."""
_GOOD = 6
"""Arrays that describe the samples in what `walk_kernels.map_candidates` returns; the others are of those left out."""
_FOLLOWED = (0, 3, 5)
"""Those of them that a ray is followed by: number, canonical point, distance to the body's nearest vertex."""


def can_walk(shell: Shell, rays: Rays) -> bool:
    """Whether a `Walk` is possible: single precision on a CPU, lists that fit into a vector."""
    own = (rays.origins, rays.directions, shell.vertices)
    return shell.nearest.shape[1] <= LANES and all(t.dtype == torch.float32 and not t.is_cuda for t in own)


def parts_of_step(step: float, beta: float, finest: float) -> int:
    r"""Into how many parts a step near the surface is divided: none is longer than twice the scale of the density.

    \[ n = \lceil \delta / \max(2 \beta, \delta_{\min}) \rceil \]

    >>> [parts_of_step(0.01, beta, 0.0025) for beta in (0.01, 0.003, 0.0001)], parts_of_step(0.01, 0.003, 0.0)
    ([1, 2, 4], 1)

    Args:
        step: $\delta$, metres.
        beta: scale of the density, metres.
        finest: $\delta_{\min}$, metres; 0 leaves the step as it is.
    """
    return max(1, math.ceil(step / max(2 * beta, finest) - 1e-6)) if finest else 1


@dataclass(frozen=True)
class Walk:
    """Where rays run through a shell, and what maps its points to canonical space.

    Attributes:
        ray_ids: which rays meet the shell's box.
        step: distance between samples, metres.
        given: what `walk_kernels.map_candidates` takes before the candidates.
        spacing: how far the body's surface may be from the nearest of its vertices, metres.
        chosen: some candidates, as `on_rays` has all; None for all.
    """

    ray_ids: Tensor
    step: float
    given: Any
    spacing: float = 0.0
    chosen: _OnRays | None = None

    @cached_property
    def on_rays(self) -> _OnRays:
        """Number (among `ray_ids`), depth and row of the shell's lists of every candidate, ray by ray."""
        return self.chosen or listed_on_rays(self.given[0], self.given[1], len(self.ray_ids))

    @torch.no_grad()
    def whole(self) -> Placement:
        """What `sample_shell`, `placement` and `miswarped` find one after the other: all samples."""
        return self._placement(*self._mapped(np.arange(len(self.on_rays[0])))[:_GOOD])

    @torch.no_grad()
    def seen(
        self, query: FieldQuery, least: float, share: float, finest: float = 0.0, grid: SdfGrid | None = None
    ) -> Placement:
        r"""The samples of `whole` that `visible` would choose, found without a look at most others.

        Rays are followed from front to back, a few samples at a time, and no further once less than `least` of their
        light comes through. A sample at the distance $s$ from the surface has a weight of at most

        \[ w \le \delta \, \sigma(s) = \frac{\delta}{2 \beta} e^{-s / \beta}, \]

        which is below $w_{\min}$ beyond $g = \beta \ln(\delta / (2 \beta w_{\min}))$. So from a sample at the distance
        $s > g$ the ray leaps over $a \, (s - g)$ metres.

        Args:
            query: of the field.
            least: smallest weight that counts, $w_{\min}$.
            share: $a$; 0 looks at every sample. The distance grows by a metre a metre, but inverse skinning stretches
                space, so less than one.
            finest: the steps of the samples found are divided until these are at most $2 \beta$ long, or this, metres;
                0 leaves them.
            grid: of the field's distances. Rays are followed by it, and the field is queried only where samples may
                count, or not at all if that is costly.
        """
        parts = parts_of_step(self.step, float(query.beta.detach()), finest)
        if grid is not None:
            return self._seen_by(grid, query, least, share, parts)
        coarse = self._search(query, least, share)
        if parts == 1 or len(coarse[0]) == 0:
            return self._placement(*coarse)
        finer = walk_kernels.divide(self.given[0], self.given[1], tuple(a[coarse[0]] for a in self.on_rays), parts)
        walk = replace(self, step=self.step / parts, chosen=finer)
        found, through = walk._mapped(np.arange(len(finer[0])))[:_GOOD], np.ones(len(self.ray_ids), np.float32)
        number, point, away = (found[part] for part in _FOLLOWED)
        seen = walk._follow(number, point, away, query, least, through, None)
        return walk._placement(*(array[seen] for array in found))

    def _seen_by(self, grid: SdfGrid, query: FieldQuery, least: float, share: float, parts: int) -> Placement:
        """`seen` with a grid, some rays in each thread; steps are divided into `parts`."""
        beta, step = np.float32(query.beta.detach()), self.step / parts
        light = (beta, *(np.float32(number) for number in (least, share, self._guard(query, least))))
        given = (self.given, grid.arrays(), light, np.float32(self.spacing), parts)

        def seen(begin: int, end: int) -> tuple[np.ndarray, ...]:
            found = search_kernels.choose(*given, begin, end)
            if query.costly:
                return found
            torch.set_num_threads(1)  # Of each thread, and so is the next.
            with torch.no_grad():
                sdf = query.distance(torch.from_numpy(found[_POINT])).float().contiguous().numpy()
            return search_kernels.keep_seen(sdf, beta, np.float32(least), np.float32(step), *found)

        with one_thread_each():
            found = _joined(in_parts(len(self.ray_ids), seen, least=_FEW_RAYS))
        return replace(self, step=step)._placed(*found)

    def _search(self, query: FieldQuery, least: float, share: float) -> list[np.ndarray]:
        """What `_mapped` says of the samples that `seen` looks for, in steps of the walk."""
        ray_at = self.on_rays[0]
        bounds = np.searchsorted(ray_at, np.arange(len(self.ray_ids) + 1))
        place, ends = bounds[:-1].copy(), bounds[1:]
        through = np.ones(len(place), np.float32)
        index, limit = np.empty(len(ray_at), np.int64), np.float32(least)
        kept, rounds = list[list[np.ndarray]](), 0
        # Where nothing of the shell is far enough from the surface to leap from, short rounds save nothing.
        leaping = self._guard(query, least) < self.given[3] / 2
        while True:
            length = 1 + rounds // _PATIENCE if leaping else _STRETCH * (1 + rounds)
            count = visibility_kernels.next_on_rays(place, ends, through, limit, length, index)
            if count == 0:
                break
            rounds += 1
            *found, too_far, excess = self._mapped(index[:count])
            if share > 0 and len(too_far):
                visibility_kernels.leap_to_shell(too_far, excess, *self.on_rays[:2], place, ends)
            if len(found[0]):
                number, point, away = (found[part] for part in _FOLLOWED)
                seen = self._follow(number, point, away, query, least, through, (share, place, ends))
                kept.append([array[seen] for array in found])
        if not kept:
            return self._mapped(index[:0])[:_GOOD]
        found = [np.concatenate(part) for part in zip(*kept, strict=True)]
        order = np.argsort(found[0])
        return [array[order] for array in found]

    def _follow(
        self, number: np.ndarray, point: np.ndarray, away: np.ndarray, query: FieldQuery, least: float,
        through: np.ndarray, leap: _Leap | None,
    ) -> np.ndarray:  # fmt: skip
        """Which of these candidates add more than `least`; the light left on each ray is reduced by all of them."""
        away = np.sqrt(np.maximum(away**2 - np.float32(self.spacing**2), 0))
        beta, seen, none = query.beta.detach(), np.empty(len(number), bool), np.zeros(0, np.int64)
        sdf = query.distance(torch.from_numpy(point)).float().contiguous().numpy()
        guard = self._guard(query, least)
        share, place, ends = leap or (0.0, none, none)
        light = np.float32(beta), np.float32(self.step), through, np.float32(least), seen
        leaping = np.float32(share), np.float32(guard), place, ends
        visibility_kernels.follow_to_surface(number, *self.on_rays[:2], sdf, away, *light, *leaping)
        return seen

    def _guard(self, query: FieldQuery, least: float) -> float:
        """How far from the surface samples count, metres; see `seen`."""
        beta = float(query.beta.detach())
        return max(beta * math.log(self.step / (2 * beta * least)), 0.0)

    def _mapped(self, index: np.ndarray) -> list[np.ndarray]:
        """What `walk_kernels.map_candidates` says of these."""
        given = (*self.given, self.on_rays, index)
        return list(_joined(in_parts(len(index), lambda b, e: walk_kernels.map_candidates(*given, b, e), least=_FEW)))

    def _placement(
        self, number: np.ndarray, vertex: np.ndarray, weight: np.ndarray, point: np.ndarray, inverse: np.ndarray,
        _away: np.ndarray,
    ) -> Placement:  # fmt: skip
        return self._placed(self.on_rays[0][number], self.on_rays[1][number], vertex, weight, point, inverse)

    def _placed(
        self, ray_at: np.ndarray, depth_at: np.ndarray, vertex: np.ndarray, weight: np.ndarray, point: np.ndarray,
        inverse: np.ndarray,
    ) -> Placement:  # fmt: skip
        depth = torch.from_numpy(depth_at)
        samples = Samples(self.ray_ids[torch.from_numpy(ray_at)], depth, torch.full_like(depth, self.step))
        arrays = (torch.from_numpy(vertex), torch.from_numpy(weight), torch.zeros(len(depth), dtype=torch.bool))
        return Placement(samples, *arrays, torch.from_numpy(point), torch.from_numpy(inverse).unflatten(1, (3, 4)))


@torch.no_grad()
def start_walk(
    shell: Shell, rays: Rays, step: float, generator: torch.Generator | None, limit: float, k: int,
    deformation: Deformation, forward: Float[Tensor, "V 3 4"], canonical: Shell, slack: float,
    spacing: float = 0.0,
) -> Walk:  # fmt: skip
    """Finds where rays run through a shell.

    Args:
        shell: where to sample.
        rays: their near and far bounds are respected.
        step: metres.
        generator: shifts each ray's evenly spaced samples; None puts samples at mid-step.
        limit: largest distance to the nearest vertex, metres.
        k: how many nearest vertices count.
        deformation: by what weights they do.
        forward: canonical-to-posed transforms of the vertices.
        canonical: the shell of the canonical body, which mis-warped samples come too close to.
        slack: by more than this, metres; 0 keeps all.
        spacing: how far the body's surface may be from the nearest of its vertices, metres.
    """
    clipped, ray_ids, start = ray_starts(shell, rays, generator)
    own, lines = shell_arrays(shell), ray_arrays(clipped, start, step)
    rows = torch.nn.functional.pad(forward.detach().flatten(1), (0, LANES - 12)).numpy()
    smooth, scale = deformation.falloff == "smooth", deformation.scale if deformation.falloff == "scene" else 1
    given = (
        own, lines, shell_arrays(canonical), np.float32(limit), np.float32(slack), smooth, np.float32(scale), rows,
        min(k, shell.nearest.shape[1]),
    )  # fmt: skip
    return Walk(ray_ids, step, given, spacing)


def _joined(parts: list[Any]) -> Any:
    """Arrays found in parts, each as one."""
    return parts[0] if len(parts) == 1 else tuple(np.concatenate(part) for part in zip(*parts, strict=True))
