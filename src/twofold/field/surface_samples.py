"""Points spread evenly over the surface of a body, and medians of values around its parts.

Vertices lie a centimetre or more apart, which is too far for stripes.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int
from scipy import sparse

GOLDEN = (0.7548776662, 0.5698402910)
"""Steps of a sequence that fills a square evenly (the plastic number's powers)."""
BAND, PASSES = 0.06, 3
"""Standard deviation of the filter that removes faint bands, metres, and how often it is applied."""


@dataclass(frozen=True)
class SurfaceSamples:
    """Points on triangles.

    Attributes:
        corners: vertices of the triangle that each lies on.
        share: of each corner, barycentric.
        area: of the surface that each stands for, square metres.
    """

    corners: Int[np.ndarray, "n 3"]
    share: Float[np.ndarray, "n 3"]
    area: float

    def __len__(self) -> int:
        """How many."""
        return len(self.corners)

    def at(self, values: Float[np.ndarray, "V *c"]) -> Float[np.ndarray, "n *c"]:
        """Values of vertices at the samples."""
        share = self.share.reshape(*self.share.shape, *[1] * (values.ndim - 1))
        return (share * values[self.corners]).sum(1)

    def gather(self, vertices: int) -> sparse.csr_matrix:
        """The transpose of `at`: sums values of samples into vertices."""
        columns = np.repeat(np.arange(len(self)), 3)
        pairs = (self.share.ravel(), (self.corners.ravel(), columns))
        return sparse.csr_matrix(pairs, shape=(vertices, len(self)))

    @property
    def nearest(self) -> Int[np.ndarray, "n"]:
        """The corner with the largest share."""
        return self.corners[np.arange(len(self)), self.share.argmax(1)]


def even_samples(
    vertices: Float[np.ndarray, "V 3"], faces: Int[np.ndarray, "F 3"], kept: Float[np.ndarray, "F"], count: int
) -> SurfaceSamples:
    r"""Points spread evenly over triangles; always the same ones.

    Point $i$ of $n$ lies in the triangle at which the running sum of areas passes $(i + 1/2) / n$ of the whole, at

    \[ (u_i, v_i) = \big( (i + \tfrac12) (\rho^{-1}, \rho^{-2}) \big) \bmod 1, \qquad \rho^3 = \rho + 1, \]

    folded where $u + v > 1$.

    >>> square = np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]])
    >>> samples = even_samples(square, np.array([[0, 1, 2], [0, 2, 3]]), np.array([1.0, 0.0]), 400)
    >>> samples.area, samples.at(square).mean(0).round(2).tolist()
    (0.00125, [0.67, 0.33, 0.0])

    Args:
        vertices: metres.
        faces: triangles.
        kept: share of each triangle that counts, 0..1.
        count: how many points.
    """
    a, b, c = (vertices[faces[:, i]] for i in range(3))
    size = 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1) * kept
    ends = size.cumsum()
    face = np.searchsorted(ends, (np.arange(count) + 0.5) / count * ends[-1]).clip(0, len(faces) - 1)
    u, v = ((np.arange(count)[:, None] + 0.5) * GOLDEN % 1).T
    # The square folded onto the triangle.
    over = u + v > 1
    u, v = np.where(over, 1 - u, u), np.where(over, 1 - v, v)
    return SurfaceSamples(faces[face], np.stack([1 - u - v, u, v], -1), float(ends[-1]) / count)


def weighted_median(values: Float[np.ndarray, "n C"], weight: Float[np.ndarray, "n"]) -> Float[np.ndarray, "C"]:
    r"""The median of each column, each row counted by its weight.

    \[ \min \{ v_k : \sum_{v_i \le v_k} w_i \ge \tfrac12 \sum_i w_i \} \]

    >>> weighted_median(np.array([[1.0], [2.0], [9.0]]), np.array([1.0, 1.0, 3.0]))
    array([9.])
    """
    order = values.argsort(0)
    ends = weight[order].cumsum(0)
    which = (ends < 0.5 * ends[-1]).sum(0).clip(0, len(values) - 1)
    columns = np.arange(values.shape[1])
    return values[order[which, columns], columns]


def without_faint_bands(
    table: Float[np.ndarray, "r C"], places: Float[np.ndarray, "r"], faint: float
) -> Float[np.ndarray, "r C"]:
    r"""Values along a part without faint bands: a bilateral filter, which leaves higher steps.

    \[ v_i \leftarrow \frac{\sum_j w_{ij} v_j}{\sum_j w_{ij}}, \qquad
    w_{ij} = \exp \Big( -\frac{(a_i - a_j)^2}{2 b^2} - \frac{\lVert v_i - v_j \rVert^2}{2 C \tau^2} \Big) \]

    `PASSES` times, with the places $a$, the width $b$ of `BAND` and the height $\tau$ of what is faint.

    >>> places = np.arange(30) / 100
    >>> hem, fold = (places > 0.145) * 0.5, (np.abs(places - 0.15) < 0.02) * 0.05
    >>> np.ptp(without_faint_bands(hem[:, None], places, 0.08)).round(2)
    0.5
    >>> np.ptp(without_faint_bands(fold[:, None], places, 0.08)) < 0.02
    True

    Args:
        table: values by place.
        places: metres.
        faint: $\tau$, in units of the values, root mean square over the columns.
    """
    near = -((places[:, None] - places) ** 2) / (2 * BAND**2)
    for _ in range(PASSES):
        apart = ((table[:, None] - table) ** 2).mean(-1)
        weight = np.exp(near - apart / (2 * faint**2))
        table = weight @ table / weight.sum(1, keepdims=True)
    return table


def ring_medians(
    values: Float[np.ndarray, "n C"], trust: Float[np.ndarray, "n"], group: Int[np.ndarray, "n"],
    along: Float[np.ndarray, "n"], height: float, enough: float, asked: Float[np.ndarray, "n"] | None = None,
    faint: float | None = None,
) -> Float[np.ndarray, "n C"]:  # fmt: skip
    r"""For each point the median of what was observed of the same body part at the same height, on either side.

    \[ g(p) = \operatorname{median}_{q} \{ v_q : \lfloor a_q / h \rfloor = \lfloor a_p / h \rfloor \} \text{ by } A_q \]

    with the place $a$ along the part, the height $h$ and the observed area $A$; linear between the middles of rings.
    Rings with too little of it take the values of those beside; parts without any, the median of all.

    >>> values, along = np.array([[1.0], [2.0], [9.0], [0.0]]), np.array([0.0, 0.01, 0.01, 0.19])
    >>> ring_medians(values, np.array([1.0, 1, 1, 0]), np.zeros(4, int), along, 0.1, 0.5)[:, 0].tolist()
    [2.0, 2.0, 2.0, 2.0]

    Args:
        values: of points of the surface.
        trust: observed area of each, square metres.
        group: body part of each.
        along: place along the part, metres.
        height: of a ring, metres.
        enough: observed area that a ring needs, square metres.
        asked: the place whose ring each point takes, metres; None for its own.
        faint: rings whose values differ by less than about this, over less than `BAND`, become alike
            (`without_faint_bands`); None leaves them.
    """
    at = along if asked is None else asked
    out = np.broadcast_to(weighted_median(values, trust), values.shape).copy()
    for part in np.unique(group):
        own = np.nonzero(group == part)[0]
        seen = own[trust[own] > 0]
        ring = np.floor(along[seen] / height).astype(int)
        order = np.argsort(ring, kind="stable")
        starts = np.unique(ring[order], return_index=True)[1]
        pieces = [piece for piece in np.split(seen[order], starts[1:]) if trust[piece].sum() >= enough]
        if pieces:
            places = np.array([along[piece].mean() for piece in pieces])
            table = np.array([weighted_median(values[piece], trust[piece]) for piece in pieces])
            if faint is not None:
                table = without_faint_bands(table, places, faint)
            out[own] = np.stack([np.interp(at[own], places, column) for column in table.T], -1)
    return out


def slope_within(
    values: Float[np.ndarray, "n"], by: Float[np.ndarray, "n"], trust: Float[np.ndarray, "n"],
    group: Int[np.ndarray, "n"], along: Float[np.ndarray, "n"], height: float,
) -> float:  # fmt: skip
    r"""How values grow with another quantity within rings around body parts: the median of the rings' slopes.

    \[ b_r = \frac{\operatorname{cov}_r(v, x)}{\operatorname{var}_r(x)}, \qquad b = \operatorname{median}_r b_r
    \text{ by } A_r \operatorname{var}_r(x) \]

    A pattern on one side of a part falsifies the rings that it crosses and not the others. 0 without any observation.

    >>> by = np.linspace(0, 1, 20)
    >>> slope_within(3 * by, by, np.ones(20), np.zeros(20, int), np.repeat([0.0, 1.0], 10), 0.1)
    3.0

    Args:
        values: of points of the surface.
        by: the other quantity.
        trust: observed area of each, square metres.
        group: body part of each.
        along: place along the part, metres.
        height: of a ring, metres.
    """
    ring = np.unique(np.stack([group, np.floor(along / height).astype(int)], -1), axis=0, return_inverse=True)[1]
    ring = ring.reshape(-1)

    def total(numbers: np.ndarray) -> np.ndarray:
        return np.bincount(ring, trust * numbers)

    area = total(np.ones_like(values)).clip(1e-12)
    x, v = by - (total(by) / area)[ring], values - (total(values) / area)[ring]
    spread, along_it = total(x * x), total(x * v)
    known = spread > 1e-9 * area
    if not known.any():
        return 0.0
    slopes = along_it[known] / spread[known]
    return float(round(weighted_median(slopes[:, None], spread[known])[0], 12))
