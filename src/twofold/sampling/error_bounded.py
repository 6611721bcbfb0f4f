"""Where along a ray to look: evenly, or where a signed distance says that the surface is."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from twofold.config import require_within
from twofold.deform.skinning import to_canonical
from twofold.geometry.cameras import Rays, clip_to_box, without_tiny_components
from twofold.kernels.kdtree import query_nearest, search_tree
from twofold.sampling.joint_box import RELEASED_MARGIN, joint_box
from twofold.sampling.placement import Deformation, FieldQuery, Placement, placement
from twofold.sampling.posed_surface import PosedSurface
from twofold.sampling.shell import Shell, build_shell
from twofold.sampling.training_grid import TrainingGrid
from twofold.volume.rendering import laplace_density
from twofold.volume.samples import Samples

PDF_FLOOR = 1e-6
"""Added to every section where depths are refined, so that none is left out."""
FINAL_FLOOR = 1e-5
"""The same for the depths that are shaded."""
LARGEST_ERROR = 1e6
"""Where the growth of the error bound is cut off, before it overflows."""


def uniform_depths(rays: Rays, count: int, generator: torch.Generator | None = None) -> Float[Tensor, "R count"]:
    r"""Ascending depths from near to far: evenly spaced, both ends included, or one at random in each stratum.

    \[ t_i = t_n + \frac{i}{n - 1} (t_f - t_n), \qquad i = 0 \dots n - 1 \]

    and with a generator uniform between the middles to the neighbours of $t_i$.

    >>> ray = Rays(torch.zeros(1, 3), torch.eye(3)[:1], torch.tensor([1.0]), torch.tensor([2.0]))
    >>> uniform_depths(ray, 5)
    tensor([[1.0000, 1.2500, 1.5000, 1.7500, 2.0000]])

    Args:
        rays: near before far, both finite.
        count: depths for each ray, at least 2.
        generator: draws the random depths; None spaces them evenly.
    """
    steps = torch.linspace(0, 1, count, dtype=rays.near.dtype, device=rays.near.device)
    depths = rays.near[:, None] + (rays.far - rays.near)[:, None] * steps
    if generator is None:
        return depths
    middle = (depths[:, 1:] + depths[:, :-1]) / 2
    low, high = torch.cat([depths[:, :1], middle], 1), torch.cat([middle, depths[:, -1:]], 1)
    return low + (high - low) * _random(depths.shape, generator, depths)


def samples_between(depths: Float[Tensor, "R n"]) -> Samples:
    r"""Packed samples at all depths of each ray but the last, which only ends the last interval.

    \[ \delta_i = t_{i+1} - t_i \]

    >>> samples_between(torch.tensor([[1.0, 1.5, 3.0]]))
    Samples(ray_index=tensor([0, 0]), depth=tensor([1.0000, 1.5000]), delta=tensor([0.5000, 1.5000]))
    """
    rays, count = depths.shape[0], depths.shape[1] - 1
    ray_index = torch.arange(rays, device=depths.device).repeat_interleave(count)
    return Samples(ray_index, depths[:, :-1].flatten(), depths.diff(dim=1).flatten())


def invert(
    depths: Float[Tensor, "R n"], weights: Float[Tensor, "R m"], quantiles: Float[Tensor, "R q"]
) -> Float[Tensor, "R q"]:
    r"""Depths at quantiles of a distribution that is constant within each section (inverse transform sampling).

    \[ t(q) = t_i + \frac{q - F_i}{F_{i+1} - F_i} (t_{i+1} - t_i), \qquad F_i = \frac{\sum_{j<i} p_j}{\sum_j p_j}
    \le q < F_{i+1} \]

    >>> depths, weights = torch.tensor([[0.0, 1.0, 3.0]]), torch.tensor([[1.0, 3.0]])
    >>> invert(depths, weights, torch.tensor([[0.0, 0.25, 0.625]]))
    tensor([[0., 1., 2.]])

    Args:
        depths: n ascending ends of the m = n - 1 sections.
        weights: positive weight of each section, of any sum.
        quantiles: in 0..1.
    """
    cumulative = torch.cumsum(weights / weights.sum(-1, keepdim=True), -1)
    cumulative = torch.cat([torch.zeros_like(cumulative[:, :1]), cumulative], -1)
    section = torch.searchsorted(cumulative, quantiles, right=True).clamp(1, weights.shape[-1]) - 1
    below, above = cumulative.gather(1, section), cumulative.gather(1, section + 1)
    start, end = depths.gather(1, section), depths.gather(1, section + 1)
    # A section of (nearly) no share holds its quantile at its start.
    width = above - below
    part = (quantiles - below) / torch.where(width < 1e-5, torch.ones_like(width), width)
    return start + part.clamp(0, 1) * (end - start)


def surface_clearance(delta: Float[Tensor, "R m"], sdf: Float[Tensor, "R n"]) -> Float[Tensor, "R m"]:
    r"""How far a whole section stays from the surface at least, from the distances at its two ends.

    With the length $a$ and the distances $b$ and $c$ it is the triangle's height on $a$,

    \[ d^* = \frac{2}{a} \sqrt{p (p - a)(p - b)(p - c)}, \qquad p = \tfrac12 (a + b + c), \]

    or $b$ where $a^2 + b^2 \le c^2$, $c$ where $a^2 + c^2 \le b^2$, and 0 where the sign changes or $b + c \le a$.

    >>> surface_clearance(torch.tensor([[0.5, 0.5]]), torch.tensor([[0.3, 0.4, -0.1]]))
    tensor([[0.2400, 0.0000]])

    No surface lies inside the balls around the ends that their distances span. Where these meet over the section, its
    way out of them is their common chord; where they do not, or where the sign changes, the surface may cross it.

    Args:
        delta: length of each section.
        sdf: signed distances at their n = m + 1 ends.
    """
    b, c = sdf[:, :-1].abs(), sdf[:, 1:].abs()
    half = (delta + b + c) / 2
    square = half * (half - delta) * (half - b) * (half - c)
    # Balls that do not meet (b + c < delta) make the square negative: nothing is known between them.
    clearance = 2 * square.clamp_min(0).sqrt() / delta.clamp_min(1e-12)
    clearance = torch.where(delta.square() + c.square() <= b.square(), c, clearance)
    clearance = torch.where(delta.square() + b.square() <= c.square(), b, clearance)
    return torch.where(sdf[:, :-1].sign() * sdf[:, 1:].sign() == 1, clearance, torch.zeros_like(b))


@dataclass(frozen=True)
class ErrorBoundedSampler:
    """Refines depths until the opacity is known to within `tolerance`, then draws from the rendering weights.

    The algorithm of VolSDF (Yariv et al. 2021, algorithm 1), as the paper and Vid2Avatar use it. Distances are taken
    to be in the units of the rays' depths.

    Attributes:
        refined: depths added in each round.
        shaded: depths drawn in the end.
        extra: of the depths seen before, how many are shaded too.
        tolerance: allowed error of the opacity.
        bisections: steps of the search for the smallest sufficient scale of the density.
        rounds: at most.
        ends: two more depths: "released" has the constants 0 and 6 (whatever the ray's box, so haze behind the body
            counts while the density is soft), "ray" the ray's own near and far.
        units: of the rays that it is given by a method: "metres", or "scene", as released, the units of a normalised
            scene, in which lengths on rays meet signed distances in metres.
        box: of the rays' near and far: "posed", 0.31 m around the joints of the corrected pose; "given", as released,
            0.3 m and 0.01 scene units around those of the pose as given, with tiny components of directions replaced;
            "rays", none: the near and far that the rays have.
        per_ray_stop: a ray within the tolerance is refined no more; otherwise, as released, all go on until all are.
    """

    refined: int = 128
    shaded: int = 64
    extra: int = 32
    tolerance: float = 0.1
    bisections: int = 10
    rounds: int = 5
    ends: Literal["released", "ray"] = "released"
    units: Literal["metres", "scene"] = "metres"
    box: Literal["posed", "given", "rays"] = "posed"
    per_ray_stop: bool = False

    def __post_init__(self) -> None:
        """Refuses numbers that leave nothing to do."""
        require_within(
            self, refined=(2, 4096), shaded=(2, 4096), rounds=(1, 100), bisections=(1, 100), tolerance=(1e-6, 1e3)
        )
        if not 0 <= self.extra <= self.refined:
            raise ValueError(f"extra={self.extra} depths cannot be chosen from refined={self.refined}")

    @property
    def reach(self) -> float:
        """How far from the body samples can be, metres."""
        return RELEASED_MARGIN

    def shell(self, body: Float[Tensor, "V 3"], neighbours: int, margin: float = 0.0) -> Shell:
        """A coarse shell, which this sampler does not use; others that look at a posed avatar may."""
        return build_shell(body, 0.1, 0.03, max(6, 2 * neighbours))

    def ray_box(
        self, joints: Float[Tensor, "24 3"], given: Callable[[], Float[Tensor, "24 3"]], scale: float
    ) -> Float[Tensor, "2 3"]:
        """Where rays begin and end: a box around the posed joints, or around those of the pose as given.

        Args:
            joints: of the corrected pose, metres.
            given: those of the pose as given.
            scale: scene units to a metre.
        """
        return joint_box(given(), scale) if self.box == "given" else joint_box(joints)

    def build(
        self, deformation: Deformation, canonical: Float[Tensor, "V 3"], faces: Int[Tensor, "F 3"]
    ) -> "ErrorBoundedPlacer":
        """The sampler of one avatar; the canonical body is not used."""
        return ErrorBoundedPlacer(self, deformation)

    @torch.no_grad()
    def sample(
        self,
        rays: Rays,
        sdf: Callable[[Tensor], Tensor],
        beta: Float[Tensor, ""],
        generator: torch.Generator | None,
        training: bool,
    ) -> Samples:
        """Samples of every ray, `shaded` + `extra` + 1 of them (97 by default).

        Args:
            rays: R rays, near before far, both finite.
            sdf: signed distance at points of the world, [n 3] to [n].
            beta: the density's scale.
            generator: draws the depths in training; unused otherwise.
            training: jitters the first depths and draws the last ones at random; otherwise all are spaced evenly.
        """
        if training and generator is None:
            raise ValueError("training=True draws random depths, so it needs a generator; it is None")
        new = uniform_depths(rays, self.refined, generator if training else None)
        scale = (new.diff(dim=1).square().sum(1) / (4 * math.log1p(self.tolerance))).sqrt()
        depths, distances = new[:, :0], new[:, :0]
        active = torch.arange(len(rays), device=new.device)
        final = new.new_empty(len(rays), self.shaded + self.extra + 2)
        for turn in range(self.rounds):
            here = rays[active]
            points = here.origins[:, None] + new[..., None] * here.directions[:, None]
            values = sdf(points.flatten(0, 1)).unflatten(0, new.shape)
            depths, order = torch.cat([depths, new], 1).sort(1)
            distances = torch.cat([distances, values], 1).gather(1, order)
            scale = self.smallest_scale(depths, distances, beta, scale)
            done = self._finished(scale, beta, turn)
            if done.any():
                final[active[done]] = self._shaded_depths(
                    here[done], depths[done], distances[done], scale[done], generator if training else None
                )
            active, depths, distances, scale = active[~done], depths[~done], distances[~done], scale[~done]
            if len(active) == 0:
                break
            new = self._refined_depths(depths, distances, scale)
        return samples_between(final)

    def smallest_scale(
        self,
        depths: Float[Tensor, "R n"],
        distances: Float[Tensor, "R n"],
        beta: Float[Tensor, ""],
        known: Float[Tensor, "R"],
    ) -> Float[Tensor, "R"]:
        r"""The smallest scale of the density, not below `beta`, for which the opacity's error is within the tolerance.

        \[ \beta_+ = \min \{ \beta' \ge \beta : \max_k B_k(\beta') \le \epsilon \} \]

        with `error_bound` for $B_k$, found by bisection.

        >>> depths, far_off = torch.tensor([[0.0, 0.5, 1.0]]), torch.tensor([[2.0, 2.0, 2.0]])
        >>> ErrorBoundedSampler().smallest_scale(depths, far_off, torch.tensor(0.1), torch.tensor([1.0]))
        tensor([0.1000])

        Args:
            depths: ascending.
            distances: signed, at those depths.
            beta: the model's scale.
            known: a scale of each ray that is large enough.
        """
        delta = depths.diff(dim=1)
        clearance = surface_clearance(delta, distances)

        def within(scale: Tensor) -> Bool[Tensor, "R"]:
            return error_bound(delta, distances, clearance, scale).amax(1) <= self.tolerance

        low = beta.expand_as(known)
        high = torch.where(within(low), low, known)
        for _ in range(self.bisections):
            middle = (low + high) / 2
            good = within(middle)
            low, high = torch.where(good, low, middle), torch.where(good, middle, high)
        return high

    def _finished(self, scale: Tensor, beta: Tensor, turn: int) -> Tensor:
        if turn == self.rounds - 1:
            return torch.ones_like(scale, dtype=torch.bool)
        done = scale <= beta
        return done if self.per_ray_stop else done.all().expand_as(done)

    def _refined_depths(self, depths: Tensor, distances: Tensor, scale: Tensor) -> Tensor:
        delta = depths.diff(dim=1)
        weights = error_bound(delta, distances, surface_clearance(delta, distances), scale) + PDF_FLOOR
        return invert(depths, weights, _even_quantiles(self.refined, depths))

    def _shaded_depths(
        self, rays: Rays, depths: Tensor, distances: Tensor, scale: Tensor, generator: torch.Generator | None
    ) -> Tensor:
        delta = depths.diff(dim=1)
        optical = _optical_lengths(delta, distances, scale)
        weights = torch.exp(optical - optical.cumsum(1)) * -torch.expm1(-optical) + FINAL_FLOOR
        count = depths.shape[1]
        if generator is None:
            quantiles = _even_quantiles(self.shaded, depths)
            chosen = torch.linspace(0, count - 1, self.extra, dtype=torch.float64).long()
        else:
            quantiles = _random((len(depths), self.shaded), generator, depths)
            chosen = torch.randperm(count, generator=generator, device=generator.device)[: self.extra]
        near, far = rays.near[:, None], rays.far[:, None]
        if self.ends == "released":
            near, far = torch.zeros_like(near), torch.full_like(far, 6)
        seen = depths[:, chosen.to(depths.device)]
        return torch.cat([near, far, seen, invert(depths, weights, quantiles)], 1).sort(1).values


def error_bound(
    delta: Float[Tensor, "R m"],
    distances: Float[Tensor, "R n"],
    clearance: Float[Tensor, "R m"],
    scale: Float[Tensor, "R"],
) -> Float[Tensor, "R m"]:
    r"""Bound on the error of the opacity up to each section, if the density had this scale (VolSDF).

    \[ B_k = \exp\Big(-\sum_{j<k} \delta_j \sigma_j\Big) \Big( \min\big(e^{\sum_{i \le k} E_i}, 10^6\big) - 1 \Big),
    \qquad E_i = \frac{\delta_i^2}{4 \beta^2} \, e^{-d^*_i / \beta} \]

    with `surface_clearance` for $d^*$.

    >>> delta, sdf = torch.tensor([[0.1, 0.1]]), torch.tensor([[0.3, 0.1, -0.1]])
    >>> error_bound(delta, sdf, surface_clearance(delta, sdf), torch.tensor([0.1]))
    tensor([[0.0963, 0.3977]])

    Args:
        delta: length of each section.
        distances: signed, at the n = m + 1 ends.
        clearance: from `surface_clearance`.
        scale: of the density, one a ray.
    """
    optical = _optical_lengths(delta, distances, scale)
    before = optical.cumsum(1) - optical
    beta = scale[:, None]
    error = torch.cumsum(torch.exp(-clearance / beta) * delta.square() / (4 * beta.square()), 1)
    return torch.exp(-before) * (torch.exp(error).clamp_max(LARGEST_ERROR) - 1)


def _optical_lengths(delta: Tensor, distances: Tensor, scale: Tensor) -> Tensor:
    """Density times length of each section, for a scale of each ray's own: lengths are measured in that scale."""
    beta = scale[:, None]
    return laplace_density(distances[:, :-1] / beta, scale.new_ones(())) * (delta / beta)


def _even_quantiles(count: int, like: Tensor) -> Tensor:
    return torch.linspace(0, 1, count, dtype=like.dtype, device=like.device).expand(len(like), count).contiguous()


def _random(shape: tuple[int, ...], generator: torch.Generator, like: Tensor) -> Tensor:
    """Uniform in 0..1, drawn on the generator's device, so that a seed means the same everywhere."""
    return torch.rand(shape, generator=generator, dtype=like.dtype, device=generator.device).to(like.device)


class ErrorBoundedPlacer:
    """Places samples in the box around the posed joints by `ErrorBoundedSampler`."""

    def __init__(self, config: ErrorBoundedSampler, deformation: Deformation) -> None:
        """Keeps the configuration."""
        self.training_grid: TrainingGrid | None = None
        self.config, self.deformation = config, deformation

    def place(
        self, rays: Rays, surface: PosedSurface, query: FieldQuery, training: bool, generator: torch.Generator | None
    ) -> Placement:
        """See `twofold.sampling.placement.Sampler`."""
        deformation, k = self.deformation, surface.neighbours
        scale = deformation.scale if self.config.units == "scene" else 1.0
        rays = without_tiny_components(rays) if self.config.box == "given" else rays
        whole = self.config.box == "rays"
        clipped, hit = (rays, rays.far > rays.near) if whole else clip_to_box(rays, *surface.box)
        inside = hit.nonzero()[:, 0]
        seen = clipped[inside]
        seen = Rays(seen.origins * scale, seen.directions, seen.near * scale, seen.far * scale)
        tree = search_tree(surface.body.vertices.detach().cpu().numpy())

        def nearest_to(points: Tensor) -> tuple[Tensor, Tensor]:
            away, index = query_nearest(tree, points.detach().cpu().numpy(), k)
            return torch.from_numpy(index).to(points.device), torch.from_numpy(away).float().to(points.device)

        def sdf(points: Tensor) -> Tensor:
            points = points / scale
            index, apart = nearest_to(points)
            x_canonical, _ = to_canonical(points, index, deformation.weigh(apart**2), surface.forward.detach())
            value = query.distance(x_canonical)
            # The release treats outliers as empty only when it does not train.
            return value if training else torch.where(apart[:, 0] > deformation.outlier_distance, 4.0, value)

        with torch.no_grad():
            samples = self.config.sample(seen, sdf, query.beta, generator, generator is not None)
        samples = Samples(inside[samples.ray_index], samples.depth / scale, samples.delta / scale)
        index, apart = nearest_to(samples.points(rays))
        outlier = apart[:, 0] > deformation.outlier_distance
        return placement(samples, rays, index, deformation.weigh(apart**2), outlier, surface)
