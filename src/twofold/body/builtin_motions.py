"""Motions that need no file: `walk`, `turn`, `dance`, `range-of-motion`, made for the body that is to move.

Feet lead: they are planted on the floor, swing and are planted again, and the pelvis is as high as both legs allow.
Trunk, arms and head come from stances (`twofold.body.stances`). All poses stay within a person's joint limits.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from scipy.interpolate import PchipInterpolator
from scipy.ndimage import gaussian_filter1d, minimum_filter1d
from torch import Tensor

from twofold.body.joint_limits import within_limits
from twofold.body.leg_ik import ANKLES, HIPS, TOES, reach
from twofold.body.motion import Motion, joint_frames, leg_length, local_poses
from twofold.body.skeleton import ShapedBody
from twofold.body.stances import Arm, Leg, Stance, stance_poses
from twofold.geometry.rotations import axis_angle_to_matrix

FPS = 30.0
_STRETCH = 0.985
"""Share of its length to which a leg stretches in a step: knees are never quite straight."""


@dataclass(frozen=True)
class Plant:
    """A foot on the floor.

    Attributes:
        start: when it comes down, seconds.
        end: when it leaves.
        place: where its front joint stands (x, z), metres.
        yaw: which way it points, radians about y.
    """

    start: float
    end: float
    place: tuple[float, float]
    yaw: float = 0.0


@dataclass(frozen=True)
class FootPath:
    """A foot over time: world rotations of ankle and toes, and where the ankle is, metres."""

    rotations: Float[Tensor, "T 3 3"]
    toes: Float[Tensor, "T 3 3"]
    ankles: Float[Tensor, "T 3"]


def _walk(body: ShapedBody) -> Motion:
    """Four strides ahead."""
    joints, leg = body.joints.double(), leg_length(body.joints)
    cycle, stride = 1.08, 1.5 * leg
    speed, stance = stride / cycle, 0.62 * cycle
    time = np.arange(round(4 * cycle * FPS)) / FPS
    plants: list[list[Plant]] = []
    for side, phase in ((0, 0.0), (1, 0.5)):
        across = 0.75 * float(joints[HIPS[side], 0])
        ahead = float(joints[TOES[side], 2] - joints[ANKLES[side], 2]) + 0.01
        starts = [(k + phase) * cycle - 0.31 * cycle for k in range(-1, 6)]
        plants.append([Plant(s, s + stance, (across, speed * (s + stance / 2) + ahead)) for s in starts])
    angle = 2 * np.pi * time / cycle
    swing = np.cos(angle - 2 * np.pi * 0.19)  # 1 when the right heel strikes and the left arm is ahead
    upper = _upper(len(time), Stance(Arm(9, 0, 0, 22), Arm(9, 0, 0, 22)))
    # An arm is raised ahead or back: its plane lies along the walk, so the sign goes into the plane's direction.
    for first, sign in ((0, 1.0), (4, -1.0)):
        ahead = 4 + 26 * sign * swing
        upper[:, first] = np.hypot(8, ahead)
        upper[:, first + 1] = np.degrees(np.arctan2(ahead, 8))
        upper[:, first + 3] = 24 + 12 * sign * swing
    upper[:, 16], upper[:, 18] = 3, -9 * swing
    pelvis = np.stack([0.022 * leg * np.cos(angle), speed * time], -1)
    return _stepping("walk", body, pelvis, np.radians(4) * swing, plants, upper, (18.0, 62.0))


def _turn(body: ShapedBody) -> Motion:
    """Once about itself on the spot, in twelve steps of each foot."""
    beat, steps = 0.5, 12
    seconds = beat * (steps + 1)
    time = np.arange(round(seconds * FPS)) / FPS
    turn = 2 * np.pi / steps
    yaw = turn * np.clip(time / beat - 0.5, 0, steps)
    yaw = gaussian_filter1d(yaw, 0.15 * FPS, mode="nearest")
    plants: list[list[Plant]] = []
    for side in (0, 1):
        # Left steps in even beats, right in odd ones; both stand at the end.
        moves = [k for k in range(steps) if k % 2 == side]
        row, start, facing = list[Plant](), -1.0, 0.0
        for k in moves:
            row.append(_beside(body, side, start, (k + 0.1) * beat, facing))
            start, facing = (k + 0.85) * beat, turn * (k + 1)
        last = 2 * np.pi
        row.append(_beside(body, side, start, seconds + 1 if facing >= last - 1e-6 else (steps + 0.1) * beat, facing))
        if facing < last - 1e-6:
            row.append(_beside(body, side, (steps + 0.85) * beat, seconds + 1, last))
        plants.append(row)
    upper = _upper(len(time), Stance(Arm(16, 20, 0, 20), Arm(16, 20, 0, 20)))
    upper[:, 20] = 8
    return _stepping("turn", body, np.zeros((len(time), 2)), yaw, plants, upper, (12.0, 0.0))


def _beside(
    body: ShapedBody, side: int, start: float, end: float, yaw: float, across: float = 0.0, out: float = 0.14
) -> Plant:
    """A foot standing under its hip, of a body that faces `yaw` at `across` metres to its left."""
    toe, hip = body.joints[TOES[side]], body.joints[HIPS[side]]
    x = float(hip[0]) * 1.1 + across
    z = float(toe[2] - body.joints[ANKLES[side], 2])
    place = (np.cos(yaw) * x + np.sin(yaw) * z, -np.sin(yaw) * x + np.cos(yaw) * z)
    return Plant(start, end, (float(place[0]), float(place[1])), yaw + (out if side == 0 else -out))


_DANCE = (
    Stance(Arm(30, 30, 0, 70), Arm(30, 30, 0, 70)),
    Stance(Arm(95, 10, 0, 30), Arm(40, 55, 0, 95), lean=-6, look=20, wind=-10),
    Stance(Arm(40, 55, 0, 95), Arm(95, 10, 0, 30), lean=6, look=-20, wind=10),
    Stance(Arm(128, 20, 0, 40), Arm(120, 25, 0, 50), nod=-8),
    Stance(Arm(60, 70, 0, 80), Arm(60, 70, 0, 80), bow=10, nod=8),
    Stance(Arm(118, 30, -20, 75), Arm(30, 20, 0, 40), lean=-8, look=18, wind=14),
    Stance(Arm(30, 20, 0, 40), Arm(112, 35, -20, 80), lean=8, look=-15, wind=-14),
    Stance(Arm(46, -8, 55, 88), Arm(46, -8, 55, 88), nod=5),
)


def _dance(body: ShapedBody) -> Motion:
    """Steps from side to side in time, 16 beats."""
    beat, beats, reach_out = 0.5, 16, 0.3 * leg_length(body.joints)
    time = np.arange(round(beat * beats * FPS)) / FPS
    plants: list[list[Plant]] = []
    # Of four beats: left out, right beside it, right back out, left beside it.
    for side, moves in ((0, (0, 3)), (1, (1, 2))):
        row, start, across = list[Plant](), -1.0, 0.0
        for k in range(beats):
            if k % 4 in moves:
                row.append(_beside(body, side, start, (k + 0.15) * beat, 0.0, across))
                start, across = (k + 0.85) * beat, reach_out if k % 4 in (0, 1) else 0.0
        row.append(_beside(body, side, start, float(time[-1]) + 1, 0.0, across))
        plants.append(row)
    keys = np.array([*range(0, beats + 1, 2)]) * beat
    sideways = np.array([reach_out * 0.5 if k % 2 else 0.0 for k in range(len(keys))]) + 0.25 * reach_out
    shift = gaussian_filter1d(np.interp(time, keys, sideways), 0.1 * FPS, mode="nearest")
    angles = np.array([_DANCE[k % len(_DANCE)].numbers() for k in range(len(keys))], dtype=np.float64)
    upper = gaussian_filter1d(PchipInterpolator(keys, angles)(time), 0.05 * FPS, axis=0, mode="nearest")
    bounce = 0.035 * leg_length(body.joints) * (1 - np.cos(2 * np.pi * time / beat))
    yaw = np.radians(10) * np.sin(2 * np.pi * time / (4 * beat))
    pelvis = np.stack([shift, np.zeros_like(shift)], -1)
    return _stepping("dance", body, pelvis, yaw, plants, upper, (10.0, 15.0), bounce)


_RANGE = (
    Stance(),
    Stance(Arm(88, 0, 0, 5), Arm(88, 0, 0, 5)),
    Stance(Arm(150, 20, 0, 5), Arm(150, 20, 0, 5)),
    Stance(),
    Stance(Arm(88, 85, 0, 5), Arm(88, 85, 0, 5)),
    Stance(Arm(80, 85, 0, 125), Arm(80, 85, 0, 125)),
    Stance(Arm(30, -55, 0, 10), Arm(30, -55, 0, 10)),
    Stance(nod=28),
    Stance(nod=-28),
    Stance(look=60),
    Stance(look=-60),
    Stance(bow=55, nod=10),
    Stance(bow=-16),
    Stance(lean=28),
    Stance(lean=-28),
    Stance(Arm(40, 10, 0, 40), Arm(40, 10, 0, 40), wind=38),
    Stance(Arm(40, 10, 0, 40), Arm(40, 10, 0, 40), wind=-38),
    Stance(Arm(80, 80, 0, 10), Arm(80, 80, 0, 10), Leg(58, 10, 12, 86), Leg(58, 10, 12, 86), bow=20),
    Stance(),
    Stance(Arm(55, 10, 0, 15), Arm(55, 10, 0, 15), left_leg=Leg(80, 4, 6, 95)),
    Stance(Arm(55, 10, 0, 15), Arm(55, 10, 0, 15), left_leg=Leg(4, 32, 6, 6)),
    Stance(),
    Stance(Arm(55, 10, 0, 15), Arm(55, 10, 0, 15), right_leg=Leg(80, 4, 6, 95)),
    Stance(Arm(55, 10, 0, 15), Arm(55, 10, 0, 15), right_leg=Leg(4, 32, 6, 6)),
    Stance(),
)
"""One joint after the other: shoulders, elbows, head, trunk, knees, hips."""


def _range_of_motion(body: ShapedBody) -> Motion:
    """Every joint through its range, standing."""
    joints = body.joints.double()
    pause = 0.9
    keys = np.arange(len(_RANGE)) * pause
    time = np.arange(round(keys[-1] * FPS) + 1) / FPS
    angles = PchipInterpolator(keys, np.array([s.numbers() for s in _RANGE], dtype=np.float64))(time)
    lifted = np.array(
        [[s.left_leg not in (s.right_leg, Leg()), s.right_leg not in (s.left_leg, Leg())] for s in _RANGE]
    )
    free = torch.from_numpy(PchipInterpolator(keys, lifted.astype(np.float64))(time))
    # A foot is free as soon as it leaves the floor at all.
    held = 1 - (free * 6).clamp(0, 1)
    held = held * held * (3 - 2 * held)
    poses = torch.from_numpy(stance_poses(angles, np.zeros(len(time))))
    start = Motion("range-of-motion", poses, torch.zeros(len(time), 3, dtype=torch.float64), FPS)
    rotations, positions = joint_frames(joints, start)
    stands = [_beside(body, side, -1.0, float(time[-1]) + 1, 0.0) for side in (0, 1)]
    feet = [_foot_path(body, side, [stands[side]], time, (0.0, 0.0)) for side in (0, 1)]
    # The pelvis is where the feet that stand want it, above the one that stands alone.
    wanted = torch.stack([feet[s].ankles - positions[:, ANKLES[s]] for s in (0, 1)], 1)
    weights = (1 - free).clamp_min(1e-3)
    weights = weights / weights.sum(1, keepdim=True)
    root = (weights[..., None] * wanted).sum(1)
    root[:, 0] += 0.75 * float(joints[HIPS[0], 0]) * (weights[:, 0] - weights[:, 1])
    root = torch.from_numpy(gaussian_filter1d(root.numpy(), 0.05 * FPS, axis=0, mode="nearest"))
    root = _lowered(joints, rotations, root, [f.ankles for f in feet], held)
    return _assembled("range-of-motion", joints, poses, root, feet, held)


def _upper(frames: int, stance: Stance) -> Float[np.ndarray, "T 21"]:
    return np.repeat(np.array([stance.numbers()], dtype=np.float64), frames, 0)


def _stepping(
    name: str, body: ShapedBody, pelvis: Float[np.ndarray, "T 2"], yaw: Float[np.ndarray, "T"],
    plants: list[list[Plant]], upper: Float[np.ndarray, "T 21"], pitch: tuple[float, float],
    bounce: Float[np.ndarray, "T"] | float = 0.0,
) -> Motion:  # fmt: skip
    """A motion whose feet follow their plants.

    Args:
        name: of the motion.
        body: who moves.
        pelvis: path over the floor (x, z), metres.
        yaw: which way the pelvis faces, radians.
        plants: of both feet, in order of time, from before the first frame until after the last.
        upper: stance angles, degrees; the legs' only say which way the knees bend.
        pitch: degrees by which toes point up when the heel strikes, and heels rise when a foot leaves the floor.
        bounce: how much lower than possible the pelvis is, metres.
    """
    joints = body.joints.double()
    time = np.arange(len(upper)) / FPS
    upper = upper.copy()
    upper[:, 8:16] = [12, 2, 8, 24] * 2
    poses = torch.from_numpy(stance_poses(upper, np.degrees(yaw)))
    feet = [_foot_path(body, side, plants[side], time, pitch) for side in (0, 1)]
    root = torch.zeros(len(time), 3, dtype=torch.float64)
    root[:, [0, 2]] = torch.from_numpy(pelvis) - joints[0, [0, 2]]
    root[:, 1] = -float(body.vertices[:, 1].min())
    rotations = joint_frames(joints, Motion(name, poses, root, FPS))[0]
    held = torch.ones(len(time), 2, dtype=torch.float64)
    root = _lowered(joints, rotations, root, [f.ankles for f in feet], held)
    root[:, 1] -= torch.as_tensor(bounce)
    return _assembled(name, joints, poses, root, feet, held)


def _foot_path(
    body: ShapedBody, side: int, plants: list[Plant], time: Float[np.ndarray, "T"], pitch: tuple[float, float]
) -> FootPath:
    """Where a foot is: planted, rolling over its heel and its front, or swinging to its next place."""
    joints = body.joints.double()
    sole = float(body.vertices[:, 1].min())
    ankle, toe = joints[ANKLES[side]], joints[TOES[side]]
    rise = float(toe[1]) - sole
    heel = torch.stack([ankle[0], torch.tensor(sole, dtype=torch.float64), ankle[2] - 0.05])
    places, turns, pitches, bends = (np.zeros((len(time), n)) for n in (3, 1, 1, 1))
    for k, plant in enumerate(plants):
        here = (time >= plant.start) & (time < plant.end)
        places[here], turns[here] = (plant.place[0], rise, plant.place[1]), plant.yaw
        length = plant.end - plant.start
        landing = np.clip(1 - (time - plant.start) / (0.16 * min(length, 1.0)), 0, 1)
        leaving = np.clip((time - plant.end) / (0.42 * min(length, 0.7)) + 1, 0, 1)
        pitches[here, 0] = (-pitch[0] * landing**2 + 0.55 * pitch[1] * leaving**2)[here]
        bends[here, 0] = (0.55 * pitch[1] * leaving**2)[here]
        if k + 1 == len(plants):
            continue
        following = plants[k + 1]
        air = (time >= plant.end) & (time < following.start)
        share = (time[air] - plant.end) / (following.start - plant.end)
        smooth = share * share * (3 - 2 * share)
        start, end = np.array(plant.place), np.array(following.place)
        far = float(np.linalg.norm(end - start))
        lift = (0.03 + 0.04 * min(far, 1.0)) * 16 * (share * (1 - share)) ** 2
        places[air] = np.stack(
            [start[0] + smooth * (end[0] - start[0]), rise + lift, start[1] + smooth * (end[1] - start[1])], -1
        )
        turns[air, 0] = plant.yaw + smooth * (following.yaw - plant.yaw)
        # From the heel up to the toes up, with the heel highest soon after it left.
        early = np.interp(share, [0, 0.15, 0.45, 1], [0.55, 1.0, 0.35, 0])
        late = np.interp(share, [0.5, 0.8, 1], [0, 0.8, 1])
        pitches[air, 0] = pitch[1] * early - pitch[0] * late
        bends[air, 0] = 0.55 * pitch[1] * np.interp(share, [0, 0.3], [1, 0])
    tilt = torch.from_numpy(np.radians(gaussian_filter1d(pitches[:, 0], 0.02 * FPS, mode="nearest")))
    bend = torch.from_numpy(np.radians(bends[:, 0]))
    yaw = _about(1, torch.from_numpy(turns[:, 0]))
    rotations = yaw @ _about(0, tilt)
    # Toes up: the foot turns about its heel, which stays where it is when the foot is flat; heel up: about its front.
    spot = torch.from_numpy(places)
    over_front = spot + (rotations @ (ankle - toe))
    over_heel = spot + yaw @ (heel - toe) + (rotations @ (ankle - heel))
    ankles = torch.where((tilt < 0)[:, None], over_heel, over_front)
    return FootPath(rotations, yaw @ _about(0, tilt - bend), ankles)


def _about(axis: int, angles: Float[Tensor, "T"]) -> Float[Tensor, "T 3 3"]:
    vector = torch.zeros(len(angles), 3, dtype=torch.float64)
    vector[:, axis] = angles
    return axis_angle_to_matrix(vector)


def _lowered(
    joints: Float[Tensor, "24 3"], rotations: Float[Tensor, "T 24 3 3"], root: Float[Tensor, "T 3"],
    ankles: list[Float[Tensor, "T 3"]], held: Float[Tensor, "T 2"],
) -> Float[Tensor, "T 3"]:  # fmt: skip
    """Translations whose height lets both legs reach their feet, smoothly over time."""
    highest = root[:, 1].clone()
    for side in (0, 1):
        hip = rotations[:, 0] @ (joints[HIPS[side]] - joints[0]) + joints[0] + root
        across = (hip - ankles[side])[:, [0, 2]].square().sum(-1)
        above = ((_STRETCH * leg_length(joints)) ** 2 - across).clamp_min(0).sqrt()
        limit = root[:, 1] + ankles[side][:, 1] + above - hip[:, 1]
        highest = torch.where(held[:, side] > 0, torch.minimum(highest, limit), highest)
    low = minimum_filter1d(highest.numpy(), max(1, round(0.1 * FPS)), mode="nearest")
    smooth = torch.from_numpy(gaussian_filter1d(low, 0.08 * FPS, mode="nearest"))
    return torch.stack([root[:, 0], smooth, root[:, 2]], -1)


def _assembled(
    name: str, joints: Float[Tensor, "24 3"], poses: Float[Tensor, "T 24 3"], root: Float[Tensor, "T 3"],
    feet: list[FootPath], held: Float[Tensor, "T 2"],
) -> Motion:  # fmt: skip
    """The poses with legs that reach for their feet as far as these are held."""
    rotations, positions = joint_frames(joints, Motion(name, poses, root, FPS))
    share = held[:, :, None]
    own = positions[:, list(ANKLES)]
    ankles = own + share * (torch.stack([f.ankles for f in feet], 1) - own)
    turned = reach(rotations, positions, ankles)
    for side in (0, 1):
        whole = held[:, side, None, None] > 0.5
        turned[:, ANKLES[side]] = torch.where(whole, feet[side].rotations, turned[:, ANKLES[side]])
        turned[:, TOES[side]] = torch.where(whole, feet[side].toes, turned[:, ANKLES[side]])
    return Motion(name, within_limits(local_poses(turned)), root, FPS)


BUILTIN_MOTIONS: dict[str, Callable[[ShapedBody], Motion]] = {
    "walk": _walk,
    "turn": _turn,
    "dance": _dance,
    "range-of-motion": _range_of_motion,
}
"""Which function makes which motion, of the body that is to move (in the T-pose), at `FPS`."""
