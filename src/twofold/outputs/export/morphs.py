"""The pose-dependent branch as morph targets: the full surface of each frame, pulled back through the exported rig."""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from scipy.optimize import lsq_linear, nnls
from torch import Tensor

from twofold.body.blending import weighted_transforms
from twofold.body.skeleton import PosedBody
from twofold.geometry.rotations import rigid_inverse
from twofold.geometry.surfaces import vertex_normals
from twofold.methods.base import Avatar, PosedAvatar

LIMIT = 0.03
"""How far the surface is looked for along a normal, metres."""
_OFF = 0.002
_MISPLACED = 0.04
_ROUNDS = 15
LEFT_OUT = 5
"""Every Nth frame is left out, to measure how targets do on frames that they were not fitted to."""


@dataclass(frozen=True)
class PulledBack:
    """One frame's surface, vertex by vertex.

    Attributes:
        displacement: what the exported skinning has to be given beside the rest vertices, rest space, metres.
        posed: where that puts the vertices, world, metres.
        canonical: the same points in canonical space, by the method's own map.
        to_observation: takes canonical gradients to observation space.
        to_rest: takes normals of observation space to the rest pose, not of unit length.
        found: where there is a surface close by that the map takes to the same part of the body; the displacement is
            zero elsewhere.
    """

    displacement: Float[Tensor, "V 3"]
    posed: Float[Tensor, "V 3"]
    canonical: Float[Tensor, "V 3"]
    to_observation: Float[Tensor, "V 3 3"]
    to_rest: Float[Tensor, "V 3 3"]
    found: Bool[Tensor, "V"]


@dataclass(frozen=True)
class Skin:
    """A surface in the T-pose with its skinning, and the same surface in canonical space.

    Attributes:
        vertices: rest pose, metres.
        canonical: canonical space, metres.
        faces: triangles.
        weights: skinning weights.
        rest: the body in the T-pose.
    """

    vertices: Float[Tensor, "V 3"]
    canonical: Float[Tensor, "V 3"]
    faces: Int[Tensor, "F 3"]
    weights: Float[Tensor, "V 24"]
    rest: PosedBody

    def transforms(self, body: PosedBody) -> Float[Tensor, "V 3 4"]:
        """Rest pose to world, at each vertex, with the body in another pose."""
        from_rest = body.bones @ rigid_inverse(self.rest.bones)
        return weighted_transforms(self.weights, from_rest)

    def moved(self, rows: Float[Tensor, "V 3 4"]) -> Float[Tensor, "V 3"]:
        """The vertices of the rest pose, each moved by its own transform."""
        return (rows[..., :3] * self.vertices[:, None]).sum(-1) + rows[..., 3]


@torch.no_grad()
def pull_back(avatar: Avatar, posed: PosedAvatar, skin: Skin, branch: str = "full") -> PulledBack:
    """The avatar's surface in a pose as a displacement of the rest vertices before skinning.

    Each skinned vertex moves along its normal to where the signed distance, asked in observation space, is zero (two
    secant steps); the inverse of its own skinning takes it back to the rest pose. So the result holds what the
    pose-dependent branch does, and what the exported skinning does otherwise than the method's own map.

    Args:
        avatar: whose field.
        posed: its pose.
        skin: the exported surface.
        branch: "full" or "base".
    """
    rows = skin.transforms(posed.body)
    start = skin.moved(rows)
    normals = vertex_normals(start, skin.faces)

    def field_at(shift: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        x, to_observation = avatar.to_canonical(start + shift[:, None] * normals, posed)
        return avatar.level(x, posed, branch), x, to_observation

    first, _, _ = field_at(torch.zeros_like(start[:, 0]))
    once = (-first).clamp(-LIMIT, LIMIT)
    second, _, _ = field_at(once)
    moved = once.abs() > 1e-4
    slope = torch.where(moved, (second - first) / torch.where(moved, once, 1.0), 1.0).clamp(0.4, 2.5)
    shift = (once - (second / slope).clamp(-0.01, 0.01)).clamp(-LIMIT, LIMIT)
    left, x, to_observation = field_at(shift)
    found = (left.abs() < _OFF) & (shift.abs() < LIMIT) & ((x - skin.canonical).norm(dim=-1) < _MISPLACED)
    shift = torch.where(found, shift, 0.0)
    linear = rows[..., :3]
    displacement = torch.linalg.solve(linear, shift[:, None] * normals)
    return PulledBack(
        displacement, start + shift[:, None] * normals, torch.where(found[:, None], x, skin.canonical),
        to_observation, linear.transpose(-1, -2), found,
    )  # fmt: skip


@dataclass(frozen=True)
class Morphs:
    """A mean shape and how it changes: displacement of frame t = mean + sum_k weights[t, k] targets[k].

    Weights lie in 0..1, because that is what programs show: Blender and Unity cut off what is below or above.

    Attributes:
        mean: metres.
        targets: metres at weight 1.
        weights: of the fitted frames; the largest of a target is 1.
    """

    mean: Float[Tensor, "V 3"]
    targets: Float[Tensor, "M V 3"]
    weights: Float[Tensor, "T M"]

    def weights_of(self, displacements: Float[Tensor, "T V 3"]) -> Float[Tensor, "T M"]:
        """Weights in 0..1 that come nearest to displacements, by least squares."""
        return bounded_weights(self.targets, displacements - self.mean)


def bounded_weights(targets: Float[Tensor, "M V 3"], off: Float[Tensor, "T V 3"]) -> Float[Tensor, "T M"]:
    """Weights in 0..1 with which targets come nearest to each of some displacements from their mean."""
    basis, wanted = targets.flatten(1).double(), off.flatten(1).double()
    weights = _least_squares((basis @ basis.T).cpu().numpy(), (basis @ wanted.T).cpu().numpy(), 1.0)
    return torch.from_numpy(weights).to(off)


def fit_morphs(displacements: Float[Tensor, "T V 3"], found: Bool[Tensor, "T V"], count: int) -> Morphs:
    """The mean over frames and `count` targets whose sums, with weights in 0..1, come near to each frame.

    Half as many principal components, each once with either sign, are the start. From there targets and weights are
    improved in turn by least squares, targets freely, weights not below zero (semi-nonnegative matrix factorization,
    Ding, Li, Jordan 2010), so the result is at least as near as those components are.

    Args:
        displacements: of the frames, metres.
        found: where they hold; elsewhere the mean of the other frames stands in.
        count: at most this many targets.
    """
    known = found[..., None].to(displacements.dtype)
    mean = (displacements * known).sum(0) / known.sum(0).clamp_min(1)
    off = ((displacements - mean) * known).flatten(1)
    # All targets are mixtures of the frames, so everything is done with the frames' products.
    products = (off.double() @ off.double().T).cpu().numpy()
    mixtures, weights = _mixtures(products, count)
    if len(mixtures) == 0:
        return Morphs(mean, off.new_zeros(0, *mean.shape), off.new_zeros(len(off), 0))
    targets = (torch.from_numpy(mixtures).to(off) @ off).unflatten(-1, mean.shape)
    return Morphs(mean, targets, torch.from_numpy(weights).to(off))


def _mixtures(products: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Targets as mixtures of the frames (M x T) and the frames' weights (T x M), from the frames' products."""
    values, vectors = np.linalg.eigh(products)
    leading = np.argsort(values)[::-1][: (count + 1) // 2]
    leading = leading[values[leading] > 1e-8 * max(values.max(initial=0), 1e-30)]  # what is smaller is rounding
    signed = np.stack([vectors[:, leading], -vectors[:, leading]], -1).reshape(len(products), -1)
    weights = signed.clip(0)[:, : min(count, 2 * len(leading))]
    mixtures = np.linalg.pinv(weights)
    for _ in range(_ROUNDS):
        weights = _least_squares(mixtures @ products @ mixtures.T, mixtures @ products, np.inf)
        mixtures = np.linalg.pinv(weights)
    weights = _least_squares(mixtures @ products @ mixtures.T, mixtures @ products, np.inf)
    largest = weights.max(0, initial=0)
    used = largest > 1e-6
    return (mixtures * largest[:, None])[used], (weights / np.maximum(largest, 1e-12))[:, used]


def _least_squares(squares: np.ndarray, products: np.ndarray, most: float) -> np.ndarray:
    """Weights in 0..most that minimise w' squares w - 2 w' products, for each column of `products`; one a row."""
    count = len(squares)
    if count == 0:
        return np.zeros((products.shape[1], 0))
    slack = 1e-9 * max(np.trace(squares) / count, 1e-30)
    root = np.linalg.cholesky(squares + slack * np.eye(count))
    sides = np.linalg.solve(root, products)
    if np.isinf(most):
        return np.stack([nnls(root.T, side)[0] for side in sides.T])
    return np.stack([lsq_linear(root.T, side, (0, most), method="bvls").x.clip(0, most) for side in sides.T])


def morph_errors(displacements: Float[Tensor, "T V 3"], found: Bool[Tensor, "T V"], count: int) -> dict[str, float]:
    """RMS distance (millimetres) of the mean shape, and of mean and targets, from the pulled-back surfaces.

    Targets are fitted without every fifth frame. "fitted" are the frames they were fitted to, "left_out" the others,
    whose weights are found by least squares.
    """
    left_out = torch.arange(len(displacements)) % LEFT_OUT == LEFT_OUT - 1
    morphs = fit_morphs(displacements[~left_out], found[~left_out], count)
    errors: dict[str, float] = {"targets": float(len(morphs.targets))}
    for name, chosen in (("fitted", ~left_out), ("left_out", left_out)):
        if not chosen.any():
            continue
        known = found[chosen][..., None]
        off = torch.where(known, displacements[chosen] - morphs.mean, 0.0)
        weights = morphs.weights_of(off + morphs.mean)
        shown = torch.einsum("tm,mvc->tvc", weights, morphs.targets)
        errors[f"{name}_without_mm"] = _rms_mm(off, known)
        errors[f"{name}_with_mm"] = _rms_mm(off - shown, known)
    return errors


def _rms_mm(off: Tensor, known: Tensor) -> float:
    return float((1000 * ((off * known).square().sum() / known.sum()).sqrt()).item())
