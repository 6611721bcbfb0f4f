"""Wrinkles: folds of the cloth that come and go as nearby joints bend.

A fold field is a train of waves, 2 to 4 cm from crest to crest, in one region of the clothes. Its height follows the
bending of one joint, so the same point of the cloth is smooth in one pose and folded in another.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial.transform import Rotation

from twofold.studio.anatomy import bearing, smoothstep
from twofold.studio.clothing import SHIRT, TROUSERS
from twofold.studio.figure import Figure


@dataclass(frozen=True)
class Fold:
    """Waves on a part of the clothes.

    Attributes:
        vertices: which.
        phase: of the wave there, radians.
        height: its largest amplitude there, metres.
        driver: which of the numbers of `bending` raises it.
        slide: how far the crests wander per unit of the driver, radians.
    """

    vertices: Int[np.ndarray, "n"]
    phase: Float[np.ndarray, "n"]
    height: Float[np.ndarray, "n"]
    driver: int
    slide: float


_RISE = 0.0055
"""Amplitude of a fully raised fold, metres."""


def bending(pose: Float[np.ndarray, "24 3"]) -> Float[np.ndarray, "d"]:
    """How strongly each driver of the folds acts, from 0 (not at all) to about 1.

    In order: left elbow, arm down, arm forward, arm up; the same of the right; left knee, hip; the same of the right;
    the trunk forward, backward, to the left, to the right, wound to the left, to the right; 1 for what always is.
    """
    drivers: list[float] = []
    for side, collar in ((1, 13), (-1, 14)):
        turn = Rotation.from_rotvec(pose[collar]) * Rotation.from_rotvec(pose[collar + 3])
        _, y, z = turn.apply([side, 0, 0])
        elbow = float(np.linalg.norm(pose[collar + 5]))
        drivers += [elbow / 1.7, max(-y, 0.0) ** 1.5, max(z, 0.0), max(y + 0.1, 0.0)]
    for hip in (1, 2):
        thigh = Rotation.from_rotvec(pose[hip]).apply([0, -1, 0])
        drivers += [float(np.linalg.norm(pose[hip + 3])) / 1.2, max(np.arctan2(thigh[2], -thigh[1]) / 0.9, 0.0)]
    bow, wind, lean = pose[[3, 6, 9]].sum(0)
    for angle, full in ((bow, 0.4), (lean, 0.22), (wind, 0.35)):
        drivers += [max(angle, 0.0) / full, max(-angle, 0.0) / full]
    return np.minimum(np.array([*drivers, 1.0]), 1.3)


def lay_folds(figure: Figure, seed: int) -> tuple[Fold, ...]:
    """All fold fields of a dressed person."""
    random = np.random.default_rng([seed, 3])
    p, a = figure.rest.astype(np.float64), figure.anatomy
    label = figure.layers.argmin(1)
    gap = np.partition(figure.layers, 1, axis=1)[:, 1] - figure.layers.min(1)
    free = smoothstep(0.0, 0.008, gap)
    shirt, trousers = (label == SHIRT) * free, (label == TROUSERS) * free
    j = a.joints.astype(np.float64)
    wander = _wander(p, random)
    front = smoothstep(-0.5, 0.6, figure.normals[:, 2])
    back = 1 - front
    folds: list[Fold] = []

    def add(height: np.ndarray, along: np.ndarray, wave: float, driver: int, slide: float = 0.0) -> None:
        height = _RISE * height * random.uniform(0.85, 1.15)
        kept = np.nonzero(height > 1e-4)[0]
        phase = 2 * np.pi * along[kept] / wave + random.uniform(0, 6.28) + wander[0][kept]
        folds.append(Fold(kept, phase, height[kept] * (0.75 + 0.25 * np.sin(wander[1][kept])), driver, slide))

    for side, first in ((1, 0), (-1, 4)):
        elbow, shoulder = j[18 if side > 0 else 19], j[16 if side > 0 else 17]
        mine = shirt * (p[:, 0] * side > 0)
        d = (p - elbow) * [side, 1, 1]
        inner = smoothstep(-0.8, 0.9, figure.normals[:, 2])
        add(
            mine * np.exp(-((d[:, 0] / 0.075) ** 2)) * (0.35 + 0.65 * inner), d[:, 0] + 0.2 * d[:, 1], 0.028, first, 1.0
        )
        d = (p - shoulder) * [side, 1, 1]
        around = np.exp(-(((d[:, 0] + 0.03) / 0.10) ** 2) - ((d[:, 1] + 0.05) / 0.12) ** 2)
        add(mine * around, 0.72 * d[:, 0] - 0.70 * d[:, 1], 0.034, first + 1)
        add(mine * around * front, 0.95 * d[:, 0] + 0.3 * d[:, 1], 0.030, first + 2, 0.8)
        add(mine * np.exp(-((d / [0.11, 0.10, 0.2]) ** 2).sum(1)), d[:, 0] - 0.35 * d[:, 1], 0.030, first + 3)
        sleeve = mine * smoothstep(0.02, 0.06, d[:, 0])
        add(0.45 * sleeve, d[:, 0] + 0.6 * side * d[:, 2], 0.036, first + 1)
    for side, first in ((1, 8), (-1, 10)):
        mine = trousers * (p[:, 0] * side > 0)
        hip, knee, ankle = (a.joints[i if side > 0 else i + 1].astype(np.float64) for i in (1, 4, 7))
        d = p - knee
        near = np.exp(-((d[:, 1] / 0.085) ** 2))
        add(mine * near * (0.35 + 0.75 * back), d[:, 1] + 0.35 * d[:, 0], 0.031, first, 1.2)
        d = p - hip
        crease = np.exp(-(((d[:, 1] + 0.02) / 0.075) ** 2)) * (0.25 + 0.85 * front)
        add(mine * crease, d[:, 1] - 0.5 * side * d[:, 0], 0.033, first + 1, 0.8)
        d = p - ankle
        stack = np.exp(-(((d[:, 1] - 0.10) / 0.07) ** 2))
        add(0.42 * mine * stack, d[:, 1] + 0.25 * d[:, 2], 0.034, 18)
    waist = j[3, 1]
    d = p - [0, waist, 0]
    belt = shirt * np.exp(-(((d[:, 1] - 0.02) / 0.10) ** 2)) * smoothstep(0.26, 0.2, np.abs(p[:, 0]))
    left = smoothstep(-0.06, 0.08, p[:, 0])
    add(belt * (0.2 + 0.9 * front), d[:, 1] + 0.15 * np.abs(p[:, 0]), 0.034, 12, 0.8)
    add(belt * (0.2 + 0.9 * back), d[:, 1] - 0.15 * np.abs(p[:, 0]), 0.034, 13, 0.8)
    add(belt * (1 - left), d[:, 1] + 0.3 * p[:, 0], 0.032, 14)
    add(belt * left, d[:, 1] - 0.3 * p[:, 0], 0.032, 15)
    around = 0.14 * bearing(p[:, 0], p[:, 2] - j[0, 2]) * np.where(front > 0.5, 1, -1)
    wide = shirt * np.exp(-(((d[:, 1] - 0.1) / 0.16) ** 2)) * smoothstep(0.26, 0.2, np.abs(p[:, 0]))
    add(wide * np.abs(figure.normals[:, 2]), 0.75 * d[:, 1] + 0.66 * around, 0.036, 16)
    add(wide * np.abs(figure.normals[:, 2]), 0.75 * d[:, 1] - 0.66 * around, 0.036, 17)
    add(0.25 * wide, 0.2 * d[:, 1] + p[:, 0] + 0.5 * p[:, 2], 0.040, 18)
    return tuple(fold for fold in folds if len(fold.vertices))


def _wander(points: Float[np.ndarray, "n 3"], random: np.random.Generator) -> Float[np.ndarray, "2 n"]:
    """Two slow random fields, radians, so that no crest runs straight."""
    fields = np.zeros((2, len(points)))
    for field in fields:
        for _ in range(4):
            field += random.uniform(0.5, 1.0) * np.sin(points @ random.normal(0, 14, 3) + random.uniform(0, 6.28))
    return fields


def displacement(folds: tuple[Fold, ...], pose: Float[np.ndarray, "24 3"], count: int) -> Float[np.ndarray, "V"]:
    """How far each vertex moves along its canonical normal in a pose, metres."""
    moved = np.zeros(count)
    strength = bending(pose)
    for fold in folds:
        raised = smoothstep(0.08, 0.9, strength[fold.driver : fold.driver + 1])[0] if fold.driver < 18 else 1.0
        if raised > 0:
            phase = fold.phase + fold.slide * strength[fold.driver]
            # Crests are narrower than the valleys between them.
            moved[fold.vertices] += raised * fold.height * (np.cos(phase) + 0.3 * np.cos(2 * phase))
    return np.clip(moved, -0.008, 0.011)
