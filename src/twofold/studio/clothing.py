"""Clothes, shoes and hair as signed distances around a body (negative inside, metres), in the T-pose."""

import numpy as np
from jaxtyping import Float
from scipy.interpolate import PchipInterpolator

from twofold.kernels.kdtree import search_tree
from twofold.studio.anatomy import Anatomy, arm_reach, around_neck, bearing, leg_reach, smoothstep
from twofold.studio.appearance import Look

SKIN, SHIRT, TROUSERS, SHOES, SOLES, HAIR = range(6)
"""Layers, in the order that `dress` gives."""


def dress(
    points: Float[np.ndarray, "n 3"], smooth: list[Float[np.ndarray, "n"]], anatomy: Anatomy, look: Look
) -> Float[np.ndarray, "n 6"]:
    """Signed distance of every layer.

    Args:
        points: where, in the T-pose.
        smooth: the body's signed distance there, blurred a little, more, and most.
        anatomy: landmarks.
        look: what to wear.
    """
    tight, loose, round_ = smooth
    layers = [
        tight,
        _shirt(points, tight, loose, anatomy, look),
        _trousers(points, tight, loose, anatomy, look),
        *_shoes(points, tight, round_, anatomy),
        _hair(points, round_, anatomy, look),
    ]
    return np.stack(layers, -1).astype(np.float32)


def collar(points: Float[np.ndarray, "n 3"], anatomy: Anatomy) -> Float[np.ndarray, "n"]:
    """How far points of a shirt lie outside the opening for the neck, metres."""
    opening = around_neck(points, anatomy.joints) - anatomy.neck - 0.014
    # Behind, the edge runs at the root of the neck; ahead it comes down to the collar bones.
    off = points - anatomy.joints[12]
    edge = -0.82 * (off[:, 1] + 0.030) - 0.57 * off[:, 2]
    return np.maximum(opening, edge).astype(np.float32)


def _cut(layer: Float[np.ndarray, "n"], end: Float[np.ndarray, "n"]) -> Float[np.ndarray, "n"]:
    """A layer cut off where `end` is positive, its rim rounded as cloth is."""
    return 0.5 * (layer + end + np.sqrt((layer - end) ** 2 + 0.006**2))


def _shirt(points: np.ndarray, tight: np.ndarray, loose: np.ndarray, anatomy: Anatomy, look: Look) -> np.ndarray:
    j, reach = anatomy.joints, arm_reach(points, anatomy)
    y = points[:, 1]
    hem = anatomy.crotch + 0.035
    on_sleeve = smoothstep(0.0, 0.3, reach)
    toward_hem = 1 - smoothstep(hem, j[9, 1], y)
    cuff = smoothstep(0.5 * look.sleeve, look.sleeve, reach) if look.sleeve < 1 else -0.3 * smoothstep(1.2, 1.8, reach)
    offset = 0.011 + on_sleeve * (0.003 + 0.007 * cuff) + (1 - on_sleeve) * 0.011 * toward_hem
    base = np.minimum(loose - offset, tight - 0.006)
    shoulder, elbow, wrist = abs(j[16, 0]), abs(j[18, 0]), abs(j[20, 0])
    end = np.interp(look.sleeve, [0, 1, 2], [shoulder, elbow, wrist])
    above = np.maximum(-collar(points, anatomy), y - j[12, 1] - 0.045)
    return _cut(base, np.maximum.reduce([np.abs(points[:, 0]) - end, hem - y, above]))


def _trousers(points: np.ndarray, tight: np.ndarray, loose: np.ndarray, anatomy: Anatomy, look: Look) -> np.ndarray:
    reach = leg_reach(points, anatomy)
    flare = smoothstep(0.3, 1.9, reach) if look.trouser > 1 else smoothstep(0.2, 0.9, reach)
    base = np.minimum(loose - 0.009 - 0.016 * flare, tight - 0.005)
    j = anatomy.joints
    end = np.interp(look.trouser, [0, 1, 2], [j[1, 1], j[4, 1], j[7, 1]])
    waist = points[:, 1] - (anatomy.joints[0, 1] + 0.06)
    return _cut(base, np.maximum(end - points[:, 1], waist))


def _shoes(
    points: np.ndarray, tight: np.ndarray, round_: np.ndarray, anatomy: Anatomy
) -> tuple[np.ndarray, np.ndarray]:
    """The upper, rounded over the toes, and the sole under its outline."""
    ankle, floor = anatomy.joints[7], anatomy.floor
    height = points[:, 1] - floor
    opening = height - 0.085 - 0.25 * (ankle[2] - points[:, 2]).clip(-0.06, 0.05)
    upper = _cut(np.minimum(round_ - 0.013, tight - 0.006), opening)
    # The samples below the ankle fill the footprint, so their distance in the plane is its outline.
    print_ = anatomy.rest[anatomy.rest[:, 1] < floor + 0.05]
    low = points[:, 1] < floor + 0.08
    outline = np.full(len(points), 1.0, np.float32)
    outline[low] = search_tree(print_[:, [0, 2]]).query(points[low][:, [0, 2]], distance_upper_bound=0.2)[0].clip(max=1)
    thickness = 0.016 + 0.008 * smoothstep(0.0, -0.08, points[:, 2] - ankle[2])
    slab = np.abs(height - 0.5 * (0.014 - thickness)) - 0.5 * (0.014 + thickness)
    sole = np.maximum(outline - 0.012, slab)
    return np.maximum(upper, -height), sole


_HAIRLINES = {
    "short": ((0.0, 0.5, 0.85, 1.1, 1.3, 1.5, 1.75, 2.1, 3.2), (1.05, 0.95, 0.62, 0.0, 0.05, 0.45, 0.35, -0.5, -1.2)),
    "back": ((0.0, 0.5, 0.9, 1.25, 1.6, 2.1, 3.2), (1.08, 1.0, 0.78, 0.40, 0.40, -0.45, -1.15)),
    "curtain": ((0.0, 0.45, 0.75, 0.95, 1.5, 3.2), (1.05, 0.85, 0.2, -1.1, -1.6, -1.75)),
    "beanie": ((0.0, 0.9, 1.6, 3.2), (0.72, 0.55, 0.35, 0.0)),
}
"""Height of the hairline above the eyes, in eye distances, over the angle from the front."""


def _hair(points: np.ndarray, round_: np.ndarray, anatomy: Anatomy, look: Look) -> np.ndarray:
    unit = anatomy.spread
    eyes, head = anatomy.eyes.mean(0), anatomy.joints[15]
    near = points[:, 1] > eyes[1] - 4 * unit
    away = np.full(len(points), 1.0, np.float32)
    p = points[near] - np.array([0, eyes[1], 0.5 * (eyes[2] + head[2]) - 0.4 * unit], np.float32)
    angle = bearing(np.abs(p[:, 0]), p[:, 2])
    style = {"beanie": "beanie", "bob": "curtain", "bun": "back", "ponytail": "back"}.get(look.hair, "short")
    line = (PchipInterpolator(*_HAIRLINES[style])(angle) * unit).astype(np.float32)
    above = p[:, 1] - line
    top = smoothstep(0.5 * unit, 2.0 * unit, p[:, 1])
    depth = {
        "crop": 0.010,
        "quiff": 0.012,
        "bob": 0.022,
        "bun": 0.010,
        "ponytail": 0.010,
        "curls": 0.026,
        "beanie": 0.014,
    }
    thickness = np.full(len(p), depth[look.hair])
    if look.hair == "quiff":
        thickness += 0.028 * top * smoothstep(-0.6 * unit, 1.0 * unit, p[:, 2])
    if look.hair == "curls":
        q = p * 170 + 1.5 * np.sin(p[:, [1, 2, 0]] * 75)
        thickness += 0.0045 * np.sin(q).sum(1) + 0.008 * top
    taper = 0.35 + 0.65 * smoothstep(0.0, 0.022, above) if style != "beanie" else np.ones(len(p))
    shell = np.maximum(round_[near] - 0.004 - thickness * taper, -0.8 * above)
    if look.hair == "bun":
        shell = np.minimum(shell, np.linalg.norm(p - np.array([0, 1.75, -1.35]) * unit, axis=1) - 0.66 * unit)
    if look.hair == "ponytail":
        shell = np.minimum(shell, _tail(p / unit) * unit)
    away[near] = shell
    return away


def _tail(p: np.ndarray) -> np.ndarray:
    """A ponytail from the back of the head, in eye distances."""
    bends = np.array([[0, 0.9, -1.55], [0, 0.7, -2.25], [0, -0.6, -2.55], [0, -1.9, -2.3]])
    radii = (0.3, 0.5, 0.45, 0.12)
    best = np.full(len(p), 9.0)
    for i in range(3):
        start, way = bends[i], bends[i + 1] - bends[i]
        along = np.clip((p - start) @ way / (way @ way), 0, 1)
        radius = radii[i] + along * (radii[i + 1] - radii[i])
        best = np.minimum(best, np.linalg.norm(p - start - along[:, None] * way, axis=1) - radius)
    return best
