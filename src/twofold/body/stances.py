"""How a made person moves: natural poses, blended smoothly while the body turns before the camera."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.interpolate import PchipInterpolator
from scipy.ndimage import gaussian_filter1d
from scipy.spatial.transform import Rotation


@dataclass(frozen=True)
class Arm:
    """Degrees: `raise_` from hanging (0) to upright (180), `forward` from sideways (0) to ahead (90)."""

    raise_: int = 14
    forward: int = 20
    twist: int = 0
    elbow: int = 18


@dataclass(frozen=True)
class Leg:
    """Degrees. `lift` swings the thigh ahead, `out` sideways, `turn` points the foot outward, `knee` bends."""

    lift: int = 0
    out: int = 2
    turn: int = 8
    knee: int = 4


@dataclass(frozen=True)
class Stance:
    """One natural pose, in degrees.

    The trunk can `bow` ahead, `lean` to the left and `wind` to the left; the head can `nod` and `look` to the left.
    """

    left_arm: Arm = Arm()
    right_arm: Arm = Arm()
    left_leg: Leg = Leg()
    right_leg: Leg = Leg()
    bow: int = 0
    lean: int = 0
    wind: int = 0
    nod: int = 0
    look: int = 0

    def numbers(self) -> list[int]:
        """All angles in a row: four for each limb, then the trunk's three and the head's two."""
        limbs = [self.left_arm, self.right_arm]
        arms = [n for a in limbs for n in (a.raise_, a.forward, a.twist, a.elbow)]
        legs = [n for g in (self.left_leg, self.right_leg) for n in (g.lift, g.out, g.turn, g.knee)]
        return [*arms, *legs, self.bow, self.lean, self.wind, self.nod, self.look]


REHEARSED = (
    Stance(),
    Stance(Arm(55, 10, 0, 15), Arm(55, 10, 0, 15)),
    Stance(Arm(82, 80, 0, 20), Arm(80, 85, 0, 25), bow=6, nod=5),
    Stance(Arm(28, 35, 0, 70), Arm(26, -30, 0, 25), Leg(-16, 3, 6, 18), Leg(24, 3, 6, 14), wind=-10),
    Stance(Arm(26, -30, 0, 25), Arm(28, 35, 0, 70), Leg(24, 3, 6, 14), Leg(-16, 3, 6, 18), wind=10),
    Stance(Arm(46, -8, 55, 88), Arm(46, -8, 55, 88), Leg(0, 9, 12, 4), Leg(0, 9, 12, 4)),
    Stance(Arm(118, 30, -20, 75), Arm(16, 20, 0, 15), lean=-8, look=18),
    Stance(Arm(16, 20, 0, 15), Arm(112, 35, -20, 80), lean=8, look=-15),
    Stance(Arm(40, 75, 0, 100), Arm(40, 75, 0, 105), Leg(22, 10, 14, 40), Leg(22, 10, 14, 40), bow=14),
    Stance(Arm(88, 5, 0, 10), Arm(88, 5, 0, 10), Leg(0, 11, 10, 4), Leg(0, 11, 10, 4), look=10),
    Stance(Arm(60, 40, 0, 60), Arm(34, 10, 0, 35), Leg(0, 5, 6, 4), Leg(42, 8, 8, 62), wind=14),
)
"""Poses of the training motion."""

UNREHEARSED = (
    Stance(Arm(125, 15, 0, 30), Arm(70, 85, 0, 35), Leg(0, 6, 8, 6), Leg(6, 12, 8, 20), lean=-10, wind=12),
    Stance(Arm(75, 85, 0, 12), Arm(45, 60, 0, 115), Leg(32, 6, 8, 42), Leg(-20, 8, 16, 14), wind=-24, bow=8),
    Stance(Arm(100, 10, 0, 85), Arm(100, 10, 0, 85), Leg(4, 20, 16, 6), Leg(20, 20, 16, 36), lean=12),
    Stance(Arm(35, -35, 0, 30), Arm(95, 60, 0, 40), Leg(62, 8, 6, 85), Leg(0, 5, 6, 6), wind=16, nod=8),
    Stance(Arm(105, 70, 0, 30), Arm(30, 50, 0, 90), Leg(34, 12, 14, 58), Leg(34, 12, 14, 58), bow=26, nod=-10),
    Stance(Arm(66, -20, 0, 20), Arm(66, -20, 0, 20), Leg(-14, 4, 6, 8), Leg(34, 4, 6, 10), bow=-8, look=-24),
)
"""Poses of the unseen motion: other combinations, a little beyond what was rehearsed."""


def choreograph(
    seed: int, rehearsed: int, unrehearsed: int, yaw_range: float | None = None
) -> tuple[Float[np.ndarray, "T 24 3"], Float[np.ndarray, "T 2"]]:
    """Poses of all frames, and how far the body sways sideways and ahead.

    Args:
        seed: another seed, another order and other angles.
        rehearsed: frames of the training motion; the body turns twice about itself.
        unrehearsed: frames of the unseen motion, which follows.
        yaw_range: the body turns back and forth within this angle about +z instead, in the training motion; degrees.

    Returns:
        Axis-angle poses (radians, SMPL's T-pose is zero) and offsets (metres).
    """
    random = np.random.default_rng([seed, 2])
    standing, *others = REHEARSED
    first = [standing, *(others[i] for i in random.permutation(len(others)))][: max(4, rehearsed // 3)]
    second = [UNREHEARSED[i] for i in random.permutation(len(UNREHEARSED))][: max(3, unrehearsed // 2)]
    start = random.uniform(-20, 20)
    angles = np.concatenate([_blend(first, rehearsed, random), _blend(second, unrehearsed, random)])
    share = np.arange(rehearsed) / rehearsed
    trained = start + 720 * share if yaw_range is None else 0.5 * yaw_range * np.sin(4 * np.pi * share)
    turn = np.concatenate([trained, start + 200 + 300 * np.arange(unrehearsed) / unrehearsed])
    time = np.arange(len(angles)) / 12
    sway = np.stack([0.03 * np.sin(time * 1.7 + seed), 0.025 * np.sin(time * 1.3 + 1 + seed)], -1)
    return stance_poses(angles, turn), sway


def _blend(stances: list[Stance], moments: int, random: np.random.Generator) -> Float[np.ndarray, "T 21"]:
    """A smooth path through stances, each a little different every time; degrees."""
    keys = np.array([stance.numbers() for stance in stances])
    keys = keys + random.normal(size=keys.shape) * np.repeat([5.0, 2.5], [8, 13])
    keys[:, [3, 7, 11, 15]] = keys[:, [3, 7, 11, 15]].clip(3, 120)
    keys[:, [0, 4]] = keys[:, [0, 4]].clip(13, 128)
    path = PchipInterpolator(np.linspace(0, 1, len(keys)), keys)(np.linspace(0, 1, moments))
    return gaussian_filter1d(path, 0.12 * moments / len(keys), axis=0, mode="nearest")


def stance_poses(angles: Float[np.ndarray, "T 21"], yaw: Float[np.ndarray, "T"]) -> Float[np.ndarray, "T 24 3"]:
    """Axis-angle poses from stance angles and the direction the body faces, all in degrees."""
    radians = np.radians(angles)
    poses = np.zeros((len(angles), 24, 3))
    bow, lean, wind, nod, look = radians[:, 16:].T
    poses[:, 0] = Rotation.from_euler("yx", np.stack([np.radians(yaw), 0.35 * bow], -1)).as_rotvec()
    for joint, share in ((3, 0.25), (6, 0.35), (9, 0.4)):
        poses[:, joint] = np.stack([share * bow, share * wind, -share * lean], -1)
    for joint in (12, 15):
        poses[:, joint] = np.stack([0.5 * nod, 0.5 * look, np.zeros_like(look)], -1)
    for side, collar in ((1, 13), (-1, 14)):
        lift, ahead, twist, elbow = radians[:, :4].T if side > 0 else radians[:, 4:8].T
        # Some of the way is the collar bone's, which keeps the shoulder's shape.
        share = Rotation.from_rotvec(_axis(2, side * 0.18 * (lift - np.pi / 2)))
        level = np.stack([side * np.cos(ahead), np.zeros_like(ahead), np.sin(ahead)], -1)
        axis = np.cross([0.0, -1.0, 0.0], level)
        # From level sideways down to hanging, a turn of the arm about itself, and up again in the wanted plane.
        hanging = Rotation.from_rotvec([0, 0, -side * np.pi / 2])
        spin = Rotation.from_rotvec(_axis(0, twist))
        target = Rotation.from_rotvec(axis * lift[:, None]) * hanging * spin
        poses[:, collar] = share.as_rotvec()
        poses[:, collar + 3] = (share.inv() * target).as_rotvec()
        poses[:, collar + 5] = _axis(1, -side * elbow)
        poses[:, collar + 7] = _axis(2, side * 0.12 * np.ones_like(elbow))
    for side, hip in ((1, 1), (-1, 2)):
        lift, out, turn, knee = radians[:, 8:12].T if side > 0 else radians[:, 12:16].T
        thigh = Rotation.from_euler("zxy", np.stack([side * out, -lift - 0.35 * bow, side * turn], -1))
        poses[:, hip] = thigh.as_rotvec()
        poses[:, hip + 3] = _axis(0, knee)
        # The sole stays level as far as an ankle can.
        poses[:, hip + 6] = _axis(0, (lift - knee).clip(-0.55, 0.5))
    return poses


def _axis(which: int, angle: np.ndarray) -> np.ndarray:
    vector = np.zeros((*angle.shape, 3))
    vector[..., which] = angle
    return vector
