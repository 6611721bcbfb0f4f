"""The colours of a made person, painted anew for every sample from its place in the T-pose.

Nothing is stored at vertices or in an image, so stripes, seams and eyes stay sharp at any size.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from twofold.studio.anatomy import Anatomy, arm_reach, bearing, smoothstep
from twofold.studio.appearance import Color, Look
from twofold.studio.clothing import HAIR, SHIRT, SHOES, SKIN, SOLES, TROUSERS, collar


@dataclass(frozen=True)
class Paint:
    """Material of surface samples.

    Attributes:
        color: share of the light sent back, linear RGB.
        gloss: strength of the highlight.
    """

    color: Float[np.ndarray, "n 3"]
    gloss: Float[np.ndarray, "n"]


def linear(color: Color) -> Float[np.ndarray, "3"]:
    """SRGB to linear light."""
    c = np.asarray(color, np.float32)
    return np.where(c <= 0.04045, c / 12.92, ((c + 0.055) / 1.055) ** 2.4).astype(np.float32)


def paint(points: Float[np.ndarray, "n 3"], layer: Int[np.ndarray, "n"], anatomy: Anatomy, look: Look) -> Paint:
    """Colours of surface points.

    Args:
        points: in the T-pose, without folds; metres.
        layer: which layer each belongs to.
        anatomy: landmarks.
        look: what the person wears.
    """
    color = np.zeros((len(points), 3), np.float32)
    gloss = np.zeros(len(points), np.float32)
    painters = {SKIN: _skin, SHIRT: _shirt, TROUSERS: _trousers, SHOES: _shoes, SOLES: _soles, HAIR: _hair}
    glosses = {SKIN: 0.10, SHIRT: 0.0, TROUSERS: 0.0, SHOES: 0.12, SOLES: 0.03, HAIR: 0.07}
    for which, painter in painters.items():
        chosen = np.nonzero(layer == which)[0]
        if len(chosen):
            color[chosen] = painter(points[chosen].astype(np.float32), anatomy, look)
            gloss[chosen] = glosses[which] if (which, look.hair) != (HAIR, "beanie") else 0.0
    return Paint(color, gloss)


def _mix(base: np.ndarray, other: np.ndarray, share: np.ndarray) -> np.ndarray:
    return base + share[:, None] * (other - base)


def _line(distance: np.ndarray, width: float) -> np.ndarray:
    """1 on a drawn line, 0 beside it; soft over a fifth of its width."""
    return 1 - smoothstep(0.8 * width, 1.2 * width, 2 * np.abs(distance))


def _grain(p: np.ndarray, size: float) -> np.ndarray:
    """Irregular mottling of about `size` metres, between -1 and 1."""
    q = p * (2 * np.pi / size)
    x, y, z = q.T
    return (
        np.sin(x + 1.7 * np.sin(0.7 * y)) + np.sin(y + 1.3 * np.sin(0.8 * z)) + np.sin(z + 1.9 * np.sin(0.6 * x))
    ) / 3


def _skin(p: np.ndarray, a: Anatomy, look: Look) -> np.ndarray:
    skin = linear(look.skin_color)
    flush = skin * np.array([1.06, 0.80, 0.78], np.float32)
    color = np.repeat(skin[None], len(p), 0) * (1 + 0.03 * _grain(p, 0.05))[:, None]
    fingers = smoothstep(abs(a.joints[22, 0]), abs(a.joints[22, 0]) + 0.08, np.abs(p[:, 0]))
    color = _mix(color, flush, 0.35 * fingers)
    face = np.nonzero((p[:, 1] > a.eyes[0, 1] - 3 * a.spread) & (p[:, 2] > a.joints[15, 2] - 0.03))[0]
    color[face] = _face(p[face], color[face], a, look)
    return color


def _face(p: np.ndarray, color: np.ndarray, a: Anatomy, look: Look) -> np.ndarray:
    """Cheeks, stubble, lips, brows and eyes, in units of the distance between the eyes."""
    skin, hair = linear(look.skin_color), linear(look.hair_color)
    middle = a.eyes.mean(0)
    x, y, z = ((p - middle) / a.spread).T
    ax = np.abs(x)
    rosy = skin * np.array([1.05, 0.66, 0.62], np.float32)
    color = _mix(color, rosy, 0.45 * np.exp(-(((ax - 0.62) / 0.32) ** 2) - ((y + 0.55) / 0.28) ** 2) * (z > -0.6))
    color = _mix(color, rosy, 0.35 * np.exp(-((x / 0.22) ** 2) - ((y + 0.62) / 0.16) ** 2))
    if look.beard:
        jaw = smoothstep(-0.72, -1.0, y) * (1 - smoothstep(0.9, 1.3, ax) * smoothstep(-0.6, -0.9, z))
        moustache = np.exp(-((x / 0.5) ** 4) - ((y + 0.88) / 0.10) ** 2)
        color = _mix(color, 0.6 * hair + 0.10 * skin, (0.62 * np.maximum(jaw, moustache)).clip(0, 0.62))
    lips = skin * np.array([0.92, 0.50, 0.50], np.float32)
    mouth = y + 1.07 + 0.05 * ax
    half = 0.40
    bow = np.sqrt(np.clip(1 - (x / half) ** 2, 0, 1))
    inside = (ax < half) & (np.abs(mouth) < 0.145 * bow)
    color = _mix(color, lips, (0.5 if look.beard else 0.85) * inside)
    color = _mix(color, 0.25 * lips, 0.9 * _line(mouth, 0.035) * (ax < half + 0.03))
    arch = y - 0.36 - 0.10 * np.sin((ax - 0.15) * 2.6).clip(0)
    brow = 1 - smoothstep(0.6, 1.0, 2 * np.abs(arch) / (0.15 * smoothstep(0.95, 0.5, ax) + 0.02))
    brow = brow * smoothstep(0.15, 0.24, ax) * (ax < 0.92)
    color = _mix(color, 0.8 * hair, 0.85 * brow)
    for eye in a.eyes:
        ex, ey = ((p[:, :2] - eye[:2]) / a.spread).T
        color = _eye(ex, ey, color, look)
    return color


def _eye(x: np.ndarray, y: np.ndarray, color: np.ndarray, look: Look) -> np.ndarray:
    """One eye about its own centre: almond of white, iris, pupil, a spark, lashes above."""
    width = 0.235
    inner = np.clip(1 - (x / width) ** 2, 0, 1)
    upper, lower = 0.105 * inner**0.8, -0.085 * inner
    open_ = (np.abs(x) < width) & (y < upper) & (y > lower)
    shade = (0.72 * np.array([1.0, 0.97, 0.94], np.float32))[None]
    color = _mix(color, shade, open_.astype(np.float32))
    r = np.hypot(x, y - 0.012)
    iris = linear(look.eye_color)
    color = _mix(color, iris * (0.6 + 0.5 * (r < 0.085))[:, None], (open_ & (r < 0.105)).astype(np.float32))
    color = _mix(color, np.array([[0.005, 0.005, 0.006]], np.float32), (open_ & (r < 0.048)).astype(np.float32))
    color = _mix(
        color, np.array([[0.95, 0.95, 0.95]], np.float32), (np.hypot(x + 0.035, y - 0.05) < 0.02).astype(np.float32)
    )
    lash = _line(y - upper - 0.012, 0.045) * (np.abs(x) < width + 0.02)
    color = _mix(color, np.array([[0.02, 0.015, 0.012]], np.float32), 0.95 * lash)
    color = _mix(color, color * 0.55, 0.6 * _line(y - lower + 0.008, 0.02) * (np.abs(x) < width))
    crease = _line(y - upper - 0.085, 0.03) * (np.abs(x) < width)
    return _mix(color, color * 0.6, 0.5 * crease)


def _shirt(p: np.ndarray, a: Anatomy, look: Look) -> np.ndarray:
    first, second = linear(look.shirt_color), linear(look.second_color)
    j = a.joints
    x, y, z = p.T
    reach = arm_reach(p, a)
    sleeve = reach > 0.10
    angle = np.where(sleeve, bearing(z - j[16, 2], y - j[16, 1]), bearing(x, z - j[3, 2]))
    along = np.where(sleeve, np.abs(x) - abs(j[16, 0]), y - a.crotch)
    color = np.repeat(first[None], len(p), 0)
    hem = y - (a.crotch + 0.035)
    elbow, wrist, shoulder = abs(j[18, 0]), abs(j[20, 0]), abs(j[16, 0])
    cuff = np.interp(look.sleeve, [0, 1, 2], [shoulder, elbow, wrist]) - np.abs(x)
    neck = collar(p, a)
    band = (neck < 0.017) & ~sleeve
    if look.shirt == "stripes":
        color = _mix(color, second, ((along / 0.052) % 1 < 0.42).astype(np.float32))
    elif look.shirt == "checks":
        count = np.where(sleeve, 7, 20)
        down, round_ = (along / 0.046) % 1 < 0.5, (angle * count / (2 * np.pi)) % 1 < 0.5
        color = _mix(color, second, 0.5 * down + 0.5 * round_)
        color = _mix(color, 0.3 * first, 0.8 * _line(((along / 0.046) % 1 - 0.75) * 0.046, 0.005))
    elif look.shirt == "emblem":
        front = (z > j[9, 2]) & ~sleeve
        color = _mix(color, second, (front & _emblem(x, y - j[9, 1] + 0.035, look.emblem)).astype(np.float32))
        back = (z < j[9, 2]) & ~sleeve
        color = _mix(color, second, (back & _digits(-x, y - j[9, 1] + 0.03, look.number)).astype(np.float32))
        color = _mix(color, second, ((cuff < 0.025) | band).astype(np.float32))
    elif look.shirt == "buttons":
        color = _mix(color, second, 0.55 * (((angle * np.where(sleeve, 11, 36)) / (2 * np.pi)) % 1 < 0.22))
        front = (z > j[9, 2]) & ~sleeve
        color = _mix(color, first * 0.45, front * _line(x - 0.017, 0.004))
        pocket = np.maximum(np.abs(x - 0.085) - 0.045, np.abs(y - j[9, 1] + 0.01) - 0.05)
        color = _mix(color, first * 0.45, front * _line(pocket, 0.006))
        spot = np.hypot(x, ((y - a.crotch) % 0.075) - 0.0375)
        color = _mix(color, np.array([[0.75, 0.72, 0.65]], np.float32), (front & (spot < 0.0075)).astype(np.float32))
        color = _mix(
            color,
            np.array([[0.1, 0.09, 0.08]], np.float32),
            (front & (np.abs(spot - 0.0085) < 0.0015)).astype(np.float32),
        )
        color = _mix(color, second, 0.8 * band)
    else:
        chest = y - j[9, 1] - 0.02
        color = _mix(color, second, ((chest > 0) | sleeve).astype(np.float32))
        color = _mix(color, linear(look.trouser_color), (np.abs(chest + 0.02) < 0.02) * ~sleeve)
        color = _mix(color, first, sleeve & ((cuff < 0.03) | (np.abs(cuff - 0.05) < 0.008)))
        back = (z < j[9, 2]) & ~sleeve
        color = _mix(color, second, (back & _digits(-x, y - j[9, 1] + 0.16, look.number)).astype(np.float32))
    stitches = np.maximum(_line(hem - 0.014, 0.003), _line(cuff - 0.014, 0.003))
    seams = np.maximum(stitches, _line((reach - 0.10) * (elbow - shoulder), 0.005))
    seams = np.maximum(seams, _line(neck - 0.017, 0.005) * ~sleeve)
    color = _mix(color, 0.45 * color, 0.7 * seams)
    return color * (1 + 0.05 * _grain(p, 0.011))[:, None]


def _emblem(x: np.ndarray, y: np.ndarray, which: int) -> np.ndarray:
    """Inside of a chest emblem about the origin, some 18 cm across: a star, a sun over waves, a bolt in a ring."""
    r, angle = np.hypot(x, y), bearing(x, y)
    if which == 0:
        fold = np.abs((angle / (2 * np.pi / 5) + 0.5) % 1 - 0.5) * (2 * np.pi / 5)
        return r * (np.cos(fold) + 1.15 * np.sin(fold)) < 0.085
    if which == 1:
        waves = (np.abs(((y + 0.045 + 0.006 * np.sin(x * 90)) % 0.024) - 0.012) < 0.006) & (y < -0.02) & (y > -0.085)
        rays = (r < 0.085) & (r > 0.055) & (np.abs((angle / (np.pi / 6)) % 1 - 0.5) < 0.2)
        return (y > -0.012) & ((r < 0.045) | rays) | (waves & (np.abs(x) < 0.085))
    bolt = (np.abs(x - 0.25 * y + 0.012) < 0.016) & (y > -0.005) & (y < 0.06)
    bolt |= (np.abs(x - 0.25 * y - 0.012) < 0.016) & (y < 0.006) & (y > -0.06)
    return bolt | (np.abs(r - 0.08) < 0.009)


_SEGMENTS = (
    0b1110111,
    0b0010010,
    0b1011101,
    0b1011011,
    0b0111010,
    0b1101011,
    0b1101111,
    0b1010010,
    0b1111111,
    0b1111011,
)
"""Seven-segment digits; from the highest bit: top, upper left and right, middle, lower left and right, bottom."""


def _digits(x: np.ndarray, y: np.ndarray, number: int) -> np.ndarray:
    """Inside of a two-digit number, 17 cm high, about the origin; x grows to the reader's right."""
    inside = np.zeros(len(x), bool)
    w, h, t = 0.034, 0.074, 0.012
    ends = (
        (-w, h, w, h), (-w, 0, -w, h), (w, 0, w, h), (-w, 0, w, 0), (-w, -h, -w, 0), (w, -h, w, 0), (-w, -h, w, -h),
    )  # fmt: skip
    for digit, center in ((number // 10, -0.056), (number % 10, 0.056)):
        for bit, (x0, y0, x1, y1) in enumerate(ends):
            if _SEGMENTS[digit] >> (6 - bit) & 1:
                dx = np.maximum(np.maximum(x0 - (x - center), (x - center) - x1), 0)
                dy = np.maximum(np.maximum(y0 - y, y - y1), 0)
                inside |= np.hypot(dx, dy) < t
    return inside


def _trousers(p: np.ndarray, a: Anatomy, look: Look) -> np.ndarray:
    base = linear(look.trouser_color)
    j = a.joints
    side = np.where(p[:, 0] >= 0, 1.0, -1.0)
    heights = [j[7, 1], j[4, 1], j[1, 1]]
    dx = p[:, 0] * side - np.interp(p[:, 1], heights, np.abs(j[[7, 4, 1], 0]))
    dz = p[:, 2] - np.interp(p[:, 1], heights, j[[7, 4, 1], 2])
    end = np.interp(look.trouser, [0, 1, 2], [j[1, 1], j[4, 1], j[7, 1]])
    hem = p[:, 1] - end
    worn = np.exp(-(((p[:, 1] - 0.5 * (j[1, 1] + j[4, 1])) / 0.2) ** 2)) * smoothstep(0.0, 0.06, dz)
    color = base * (1 + 0.35 * worn + 0.06 * _grain(p, 0.006) + 0.05 * _grain(p, 0.06))[:, None]
    outer = (dx > 0) & (np.abs(dz) < 0.12)
    if look.number % 3 == 0:
        color = _mix(color, linear(look.second_color), outer * _line(dz, 0.034))
    seams = np.maximum(outer * _line(dz - 0.002, 0.005) * (look.number % 3 > 0), _line(hem - 0.018, 0.004))
    drop = np.hypot(dx - 0.10, p[:, 1] - j[1, 1] - 0.03)
    seams = np.maximum(seams, (dz > 0.02) * _line(drop - 0.085, 0.005))
    back = np.maximum(np.abs(dx + 0.005) - 0.055, np.abs(p[:, 1] - j[1, 1] + 0.015) - 0.06)
    seams = np.maximum(seams, (dz < -0.03) * _line(back, 0.005))
    return _mix(color, 0.4 * base, 0.75 * seams)


def _shoes(p: np.ndarray, a: Anatomy, look: Look) -> np.ndarray:
    base, trim = linear(look.shoe_color), linear(look.sole_color)
    side = np.where(p[:, 0] >= 0, 1, 2)
    ankle = a.joints[[0, 7, 8]][side]
    ahead, height = p[:, 2] - ankle[:, 2], p[:, 1] - a.floor
    across = p[:, 0] - ankle[:, 0]
    color = np.repeat(base[None], len(p), 0)
    color = _mix(color, 0.7 * trim, (ahead > 0.155).astype(np.float32))
    laces = (np.abs(across) < 0.028) & (ahead > 0.045) & (ahead < 0.135) & (height > 0.035)
    color = _mix(color, base * 0.55, laces)
    color = _mix(color, np.array([[0.85, 0.85, 0.83]], np.float32), laces & ((ahead / 0.018) % 1 < 0.45))
    stripe = (
        (np.abs(across) > 0.03) & (np.abs(ahead - 0.02 - 0.6 * height) % 0.035 < 0.012) & (np.abs(ahead - 0.05) < 0.05)
    )
    color = _mix(color, trim, stripe & (height < 0.075))
    return _mix(color, 0.3 * base, (height > 0.082).astype(np.float32) * 0.0)


def _soles(p: np.ndarray, a: Anatomy, look: Look) -> np.ndarray:
    trim = linear(look.sole_color)
    height = p[:, 1] - a.floor
    color = np.repeat(trim[None], len(p), 0)
    return _mix(color, 0.45 * trim, (height < -0.012).astype(np.float32))


def _hair(p: np.ndarray, a: Anatomy, look: Look) -> np.ndarray:
    middle = a.eyes.mean(0)
    head = a.joints[15]
    x, y, z = (p - [middle[0], middle[1], 0.5 * (middle[2] + head[2])]).astype(np.float32).T
    angle = bearing(x, z)
    if look.hair == "beanie":
        first, second = linear(look.second_color), linear(look.shirt_color)
        ribs = 0.8 + 0.2 * np.cos(angle * 44)
        brim = (y < 0.075 * 0.9).astype(np.float32)
        return _mix(np.repeat(first[None], len(p), 0), second, brim) * ribs[:, None]
    strands = np.sin(angle * 34 + 3.0 * np.sin(y * 28 + 2 * angle)) * 0.5 + np.sin(angle * 71 + y * 90) * 0.3
    strands = strands + 0.4 * _grain(p, 0.02)
    base = linear(look.hair_color)
    parting = np.exp(-(((x - 0.028) / 0.004) ** 2)) * (z > 0) * (y > 0.07) if look.hair in ("bob", "bun") else 0 * x
    return _mix(base * (1 + 0.32 * strands)[:, None], 0.7 * linear(look.skin_color), 0.6 * parting)
