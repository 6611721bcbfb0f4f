"""Values over the surface of a body, completed from where they were observed.

What was never filmed is taken from the mirrored point where that was seen, else from the same body part at the same
height; the back of the head takes the colour of the hair. A screened Poisson equation joins all this to what was
observed without a seam.
"""

from dataclasses import dataclass
from typing import cast

import numpy as np
from jaxtyping import Float, Int
from scipy import sparse
from scipy.sparse.linalg import SuperLU, splu

from twofold.body.skeleton import ShapedBody
from twofold.geometry.surfaces import vertex_normals
from twofold.kernels.kdtree import search_tree

GROUPS = (0, 1, 1, 0, 1, 1, 0, 1, 1, 0, 2, 2, 3, 0, 0, 4, 5, 5, 5, 5, 5, 5, 6, 6)
"""Body part of each joint, left and right alike: trunk, legs, feet, neck, head, arms, hands."""
TRUNK, LEGS, FEET, NECK, HEAD, ARMS, HANDS = range(7)
BIN = 0.02
"""Height of a ring around a body part, metres."""
OBSERVED_LENGTH, MIRROR_LENGTH, HAIR_LENGTH, RING_LENGTH = 0.012, 0.02, 0.025, 0.08
"""Metres over which the solution leaves an observed value, a mirrored one, the hair's and a ring's for those beside."""
FREE_LENGTH = 10.0
"""The same where nothing is to be said: what is beside decides."""
SCALP, NAPE = 0.82, 0.12
"""Heights within the head, 0 at the chin and 1 at the crown: hair for certain above the first; behind the ears down to
the second."""


@dataclass(frozen=True)
class BodyParts:
    """Where the vertices of a body lie on it.

    Attributes:
        group: body part, see `GROUPS`.
        along: place along the part, metres: height, and distance from the middle of the body on arms and hands.
        mirrored: the vertex nearest to the mirrored place.
    """

    group: Int[np.ndarray, "V"]
    along: Float[np.ndarray, "V"]
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
    level = np.isin(group, (ARMS, HANDS))
    middle = shaped.joints[0].numpy()
    along = np.where(level, np.abs(rest[:, 0] - middle[0]), rest[:, 1])
    flipped = rest * np.array([-1, 1, 1], rest.dtype) + np.array([2 * middle[0], 0, 0], rest.dtype)
    mirrored = np.asarray(search_tree(rest).query(flipped)[1], dtype=np.int64)
    return BodyParts(group, along, mirrored)


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


class SurfaceFill:
    """Completes values that were observed on part of a body's surface."""

    def __init__(self, shaped: ShapedBody, weight: Float[np.ndarray, "V"], area: Float[np.ndarray, "V"]) -> None:
        """Prepares everything that does not depend on the values.

        Args:
            shaped: the body in the T-pose.
            weight: how well each vertex was observed, 0..1.
            area: of the surface around each vertex, square metres; 0 for inner parts.
        """
        self.parts = body_parts(shaped)
        self.rest = shaped.vertices.double().numpy()
        self.normals = vertex_normals(shaped.vertices, shaped.faces).numpy()
        self.joints = shaped.joints.double().numpy()
        self.weight = weight.astype(np.float64)
        self.area = area.astype(np.float64)
        self.mirror_weight = self.weight[self.parts.mirrored]
        self.hairy = self._hairiness()
        laplacian = cotangent_laplacian(self.rest, shaped.faces.numpy())
        # Inner parts have no outer area, but have to hang together with the rest.
        mass = self.area + 0.1 * self.area[self.area > 0].mean()
        unseen = 1 - self.weight
        mirrored = unseen * self.mirror_weight / MIRROR_LENGTH**2
        hair = unseen * self.hairy / HAIR_LENGTH**2
        head = self.parts.group == HEAD
        ring = unseen * np.where(head, 1e-3, 1.0) / RING_LENGTH**2
        self._pulls = [mass * pull for pull in (self.weight**2 / OBSERVED_LENGTH**2, mirrored, hair, ring)]
        self._free = mass / FREE_LENGTH**2
        diagonal = sum(self._pulls) + self._free
        self._solver: SuperLU = splu((laplacian + sparse.diags(diagonal)).tocsc())

    def __call__(self, values: Float[np.ndarray, "V C"]) -> Float[np.ndarray, "V C"]:
        r"""The completed values: nearly the observed ones where these are good.

        The minimum over $u$ of

        \[ \int \lVert \nabla u \rVert^2 + \sum_k \int \frac{w_k}{\ell_k^2} \lVert u - p_k \rVert^2 \]

        with what was observed, its mirror image, the hair and the rings as $p_k$.

        Args:
            values: as observed; where the weight is 0 they do not matter.
        """
        values = np.where(self.weight[:, None] > 0, values, 0).astype(np.float64)
        trust = self.weight * (self.area + 1e-9)
        everywhere = weighted_median(values, trust)
        pieces = (values, values[self.parts.mirrored], self._hair(values, trust)[None], self._rings(values, trust))
        right = self._free[:, None] * everywhere
        for pull, piece in zip(self._pulls, pieces, strict=True):
            right = right + pull[:, None] * piece
        return self._solver.solve(right).astype(np.float32)

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

    def _hairiness(self) -> Float[np.ndarray, "V"]:
        """1 where hair grows on nearly everybody: the crown, and the head behind the ears down to the nape."""
        height, behind = self._head_heights()
        back = np.clip((behind + 0.01) / 0.02, 0, 1) * np.clip((height - NAPE) / 0.1, 0, 1)
        return np.where(self.parts.group == HEAD, np.maximum(back, self._crown()), 0.0)

    def _crown(self) -> Float[np.ndarray, "V"]:
        """1 on the top of the head, 0 below."""
        return np.where(self.parts.group == HEAD, np.clip((self._head_heights()[0] - SCALP) / 0.05, 0, 1), 0.0)

    def _hair(self, values: Float[np.ndarray, "V C"], trust: Float[np.ndarray, "V"]) -> Float[np.ndarray, "C"]:
        """What was observed of the crown, or else of the highest part of the head that was.

        Not of all that is hairy: a camera in front sees ears and cheeks beside it.
        """
        height, _ = self._head_heights()
        counted = trust * self._crown()
        if counted.sum() < 1e-4:  # less than a square centimetre
            seen = (self.parts.group == HEAD) & (self.weight > 0)
            if not seen.any():
                return weighted_median(values, trust)
            counted = trust * (seen & (height >= np.quantile(height[seen], 0.9)))
        return weighted_median(values, counted)

    def _rings(self, values: Float[np.ndarray, "V C"], trust: Float[np.ndarray, "V"]) -> Float[np.ndarray, "V C"]:
        """The median of what was observed of the same body part at the same height, on either side of the body."""
        group, along = self.parts.group, self.parts.along
        out = np.broadcast_to(weighted_median(values, trust), values.shape).copy()
        for part in range(max(GROUPS) + 1):
            own = np.nonzero(group == part)[0]
            seen = own[trust[own] > 1e-9]
            if not len(seen):
                continue
            index = np.floor(along[seen] / BIN).astype(int)
            places, medians = [], []
            for ring in range(int(index.min()), int(index.max()) + 1):
                near = seen[np.abs(index - ring) <= 1]
                if trust[near].sum() > 2e-5:
                    places.append((ring + 0.5) * BIN)
                    medians.append(weighted_median(values[near], trust[near]))
            if places:
                table = np.array(medians)
                out[own] = np.stack([np.interp(along[own], places, column) for column in table.T], -1)
        return out
