"""Values over the surface of a body, completed from where they were observed.

A first guess for what was never filmed is the same body part at the same height; on the back of the head it is the
hair. What the observed part differs from that guess is carried over the border and to the mirrored side by a screened
Poisson equation, so there is no seam.
"""

from dataclasses import dataclass
from typing import cast

import numpy as np
from jaxtyping import Float, Int
from scipy import sparse
from scipy.sparse.linalg import SuperLU, splu

from twofold.body.skeleton import ShapedBody
from twofold.field.surface_samples import even_samples, ring_medians, slope_within, weighted_median
from twofold.kernels.kdtree import search_tree

GROUPS = (0, 1, 1, 0, 1, 1, 0, 1, 1, 0, 2, 2, 3, 0, 0, 4, 5, 5, 5, 5, 5, 5, 6, 6)
"""Body part of each joint, left and right alike: trunk, legs, feet, neck, head, arms, hands."""
TRUNK, LEGS, FEET, NECK, HEAD, ARMS, HANDS = range(7)
SAMPLES = 40_000
"""Points on the surface, some 7 mm apart: fine enough for stripes, which the vertices of a body are not."""
RING = 0.006
"""Height of a ring around a body part, metres."""
FAINT = 0.04
"""By how much colours may differ from ring to ring, 0..1, and still become alike: stripes and hems differ by more."""
ENOUGH = 2e-5
"""Observed area without which a ring takes its value from those beside, square metres."""
OBSERVED_LENGTH, MIRROR_LENGTH, HAIR_LENGTH, RING_LENGTH = 0.012, 0.02, 0.025, 0.04
"""Metres over which the solution leaves an observed value, a mirrored one, the hair's and a ring's for those beside."""
FREE_LENGTH = 10.0
"""The same where nothing is to be said: what is beside decides."""
SIDEWAYS = 0.1
"""How much a point of a ring that faces the cameras counts; one that is seen from its side counts 1 + this."""
SLOPE_RING = 0.03
"""Height of the rings in which `SurfaceFill.slope` compares, metres."""
NECKLINE = 0.11
"""How far below the neck joint clothes may be open in front, metres: rings above are those as far below that height."""
SCALP, NAPE = 0.82, 0.12
"""Heights within the head, 0 at the chin and 1 at the crown: hair for certain above the first; behind the ears down to
the second."""


@dataclass(frozen=True)
class BodyParts:
    """Where the vertices of a body lie on it.

    Attributes:
        group: body part, see `GROUPS`.
        mirrored: the vertex nearest to the mirrored place.
    """

    group: Int[np.ndarray, "V"]
    mirrored: Int[np.ndarray, "V"]


def body_parts(shaped: ShapedBody) -> BodyParts:
    r"""The parts of a body in SMPL's T-pose, and which vertex is the mirror image of which.

    \[ m(i) = \arg\min_j \lVert v_j - (2 c_x - x_i, y_i, z_i) \rVert, \qquad c \text{ the pelvis} \]

    >>> import torch
    >>> vertices = torch.tensor([[0.1, 0.0, 0.0], [-0.1, 0.0, 0.0], [0.0, 1.0, 0.0]])
    >>> weights = torch.nn.functional.one_hot(torch.tensor([1, 2, 15]), 24).float()
    >>> shaped = ShapedBody(vertices, torch.zeros(24, 3), torch.tensor([[0, 1, 2]]), weights, torch.zeros(3, 3, 0))
    >>> parts = body_parts(shaped)
    >>> parts.mirrored.tolist(), [(LEGS, LEGS, HEAD)[k] == parts.group[k] for k in range(3)]
    ([1, 0, 2], [True, True, True])
    """
    rest = shaped.vertices.numpy()
    group = np.array(GROUPS)[shaped.weights.numpy().argmax(1)]
    middle = shaped.joints[0].numpy()
    flipped = rest * np.array([-1, 1, 1], rest.dtype) + np.array([2 * middle[0], 0, 0], rest.dtype)
    mirrored = np.asarray(search_tree(rest).query(flipped)[1], dtype=np.int64)
    return BodyParts(group, mirrored)


def cotangent_laplacian(vertices: Float[np.ndarray, "V 3"], faces: Int[np.ndarray, "F 3"]) -> sparse.csc_matrix:
    r"""The positive semidefinite Laplacian of a triangle mesh; negative weights of obtuse triangles become tiny ones.

    \[ L_{ij} = -\tfrac12 (\cot \alpha_{ij} + \cot \beta_{ij}), \qquad L_{ii} = -\sum_{j \ne i} L_{ij} \]

    >>> corners = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
    >>> cotangent_laplacian(corners, np.array([[0, 1, 2]])).toarray().round(2).tolist()
    [[1.0, -0.5, -0.5], [-0.5, 0.5, -0.0], [-0.5, -0.0, 0.5]]
    """
    rows, columns, values = [], [], []
    for corner in range(3):
        a, b, c = (faces[:, (corner + i) % 3] for i in range(3))
        u, v = vertices[b] - vertices[a], vertices[c] - vertices[a]
        area = np.linalg.norm(np.cross(u, v), axis=1).clip(1e-12)
        weight = (0.5 * (u * v).sum(1) / area).clip(1e-3, 1e3)
        rows += [b, c]
        columns += [c, b]
        values += [weight, weight]
    shape = (len(vertices), len(vertices))
    edges = sparse.coo_matrix((np.concatenate(values), (np.concatenate(rows), np.concatenate(columns))), shape=shape)
    edges = edges.tocsc()
    return cast(sparse.csc_matrix, sparse.diags(np.asarray(edges.sum(1)).ravel()).tocsc() - edges)


class SurfaceFill:
    """Completes values that were observed on part of a body's surface, at points spread evenly over it."""

    def __init__(
        self, shaped: ShapedBody, weight: Float[np.ndarray, "V"], area: Float[np.ndarray, "V"],
        facing: Float[np.ndarray, "V"], count: int = SAMPLES,
    ) -> None:  # fmt: skip
        """Prepares everything that does not depend on the values.

        Args:
            shaped: the body in the T-pose.
            weight: how well each vertex was observed, 0..1.
            area: of the surface around each vertex, square metres; 0 for inner parts.
            facing: mean cosine of the angle between each vertex's normal and the direction to the cameras.
            count: of the points.
        """
        self.parts = body_parts(shaped)
        self.rest = shaped.vertices.double().numpy()
        faces = shaped.faces.numpy()
        outer = (area > 0).astype(float)
        self.samples = even_samples(self.rest, faces, outer[faces].mean(1), count)
        self.weight = self.samples.at(weight.astype(np.float64))
        self.group = self.parts.group[self.samples.nearest]
        self.along = _along(self.samples.at(self.rest), self.group, float(shaped.joints[0, 0]))
        neckline = float(shaped.joints[12, 1]) - NECKLINE
        behind = (self.group == TRUNK) & (self.along > neckline)
        self._ring_at = np.where(behind, 2 * neckline - self.along, self.along)
        # What hangs between the legs in front is no measure of the buttocks; the thighs beside them are.
        self._ring_group = np.where(self.group == LEGS, TRUNK, self.group)
        self.hairy, self.crown = (self.samples.at(values) for values in self._hair_regions())
        self._head_height = self.samples.at(self._head_heights()[0])
        self._trust = self.weight * self.samples.area
        self.facing = self.samples.at(facing.astype(np.float64))
        # What lies beside the unobserved part says more about it than what is on the chest.
        self._beside = self._trust * (1 + SIDEWAYS - self.facing).clip(SIDEWAYS)
        self._mirrored = self._mirrors(float(shaped.joints[0, 0]))
        self._seen_there = (1 - self.weight) * self.weight[self._mirrored]
        self._gather = self.samples.gather(len(self.rest)) @ sparse.diags(self._trust)
        self._gathered = np.asarray(self._gather.sum(1)).ravel()
        laplacian = cotangent_laplacian(self.rest, faces)
        # Inner parts have no outer area, but have to hang together with the rest.
        mass = area + 0.1 * area[area > 0].mean()
        observed = np.where(self._gathered > 0, weight.astype(np.float64), 0)
        unseen = 1 - observed
        head = self.parts.group == HEAD
        ring = np.where(head, 1e-3, 1.0) / RING_LENGTH**2 + self._hair_regions()[0] / HAIR_LENGTH**2
        mirrored = observed[self.parts.mirrored] / MIRROR_LENGTH**2
        self._observed = mass * observed**2 / OBSERVED_LENGTH**2
        diagonal = self._observed + mass * (unseen * (ring + mirrored) + 1 / FREE_LENGTH**2)
        self._solver: SuperLU = splu((laplacian + sparse.diags(diagonal)).tocsc())

    def __call__(
        self, values: Float[np.ndarray, "n C"], ring: float = RING, faint: float | None = FAINT
    ) -> Float[np.ndarray, "n C"]:
        r"""The completed values at the samples: by their weight the observed ones, for the rest what was completed.

        That is $g + u$ with the guess $g$ from rings and hair and the $u$ that minimises

        \[ \int \lVert \nabla u \rVert^2 + \sum_k \int \frac{w_k}{\ell_k^2} \lVert u - p_k \rVert^2 \]

        where $p_1$ is what was observed less the guess, and the others are zero: where the mirrored point was seen,
        on hair, and by the length over which a ring lets go of what is beside.

        Args:
            values: as observed, at the samples; where the weight is 0 they do not matter.
            ring: height of a ring, metres.
            faint: bands of rings that differ by less from those beside are left out: shadows of arms, and folds; None
                for none.
        """
        values = np.where(self.weight[:, None] > 0, values, 0).astype(np.float64)
        guess = self.guess(values, ring, faint)
        rest = (self._gather @ (values - guess)) / self._gathered.clip(1e-12)[:, None]
        completed = guess + self.samples.at(self._solver.solve(self._observed[:, None] * rest))
        return (completed + self.weight[:, None] * (values - completed)).astype(np.float32)

    def guess(
        self, values: Float[np.ndarray, "n C"], ring: float = RING, faint: float | None = FAINT
    ) -> Float[np.ndarray, "n C"]:
        """Each sample's mirror image by how well it was seen; for the rest its ring (`ring_medians`), or the hair."""
        around = ring_medians(values, self._beside, self._ring_group, self.along, ring, ENOUGH, self._ring_at, faint)
        alone = around + self.hairy[:, None] * (self._hair(values) - around)
        return alone + self._seen_there[:, None] * (values[self._mirrored] - alone)

    def _mirrors(self, middle: float) -> Int[np.ndarray, "n"]:
        """The sample nearest to the mirror image of each."""
        places = self.samples.at(self.rest)
        return np.asarray(search_tree(places).query(places * [-1, 1, 1] + [2 * middle, 0, 0])[1], dtype=np.int64)

    def slope(self, values: Float[np.ndarray, "n"]) -> float:
        """How observed values grow with the cosine to the cameras within rings; see `slope_within`."""
        off_head = self._trust * (self.group != HEAD)
        return slope_within(values, self.facing, off_head, self.group, self.along, SLOPE_RING)

    def _head_heights(self) -> tuple[Float[np.ndarray, "V"], Float[np.ndarray, "V"]]:
        """Height of each vertex within the head (0 at the chin, 1 at the crown), and how far behind its middle, metres.

        Both are meaningless off the head.
        """
        head = self.parts.group == HEAD
        if not head.any():
            return np.zeros(len(self.rest)), np.zeros(len(self.rest))
        front = self.rest[head][:, 2]
        low, high = np.percentile(self.rest[head][:, 1], [2, 100])
        height = (self.rest[:, 1] - low) / max(high - low, 1e-6)
        return height, 0.5 * (front.min() + front.max()) - self.rest[:, 2]

    def _hair_regions(self) -> tuple[Float[np.ndarray, "V"], Float[np.ndarray, "V"]]:
        """1 where hair grows on nearly everybody (crown, and behind the ears down to the nape), and 1 on the crown."""
        height, behind = self._head_heights()
        head = self.parts.group == HEAD
        crown = np.where(head, np.clip((height - SCALP) / 0.05, 0, 1), 0.0)
        back = np.clip((behind + 0.01) / 0.02, 0, 1) * np.clip((height - NAPE) / 0.1, 0, 1)
        return np.where(head, np.maximum(back, crown), 0.0), crown

    def _hair(self, values: Float[np.ndarray, "n C"]) -> Float[np.ndarray, "C"]:
        """What was observed of the crown, or else of the highest part of the head that was.

        Not of all that is hairy: a camera in front sees ears and cheeks beside it.
        """
        counted = self._trust * self.crown
        if counted.sum() < 1e-4:  # less than a square centimetre
            seen = (self.group == HEAD) & (self.weight > 0)
            if not seen.any():
                return weighted_median(values, self._trust)
            counted = self._trust * (seen & (self._head_height >= np.quantile(self._head_height[seen], 0.9)))
        return weighted_median(values, counted)


def _along(points: Float[np.ndarray, "n 3"], group: Int[np.ndarray, "n"], middle: float) -> Float[np.ndarray, "n"]:
    """Height, and distance from the middle of the body on arms and hands, metres."""
    return np.where(np.isin(group, (ARMS, HANDS)), np.abs(points[:, 0] - middle), points[:, 1])
