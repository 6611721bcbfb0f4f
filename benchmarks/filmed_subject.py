"""Synthetic subjects filmed by one camera while they do what fits find hard: bend, kneel, sit down, turn.

The images are what an estimator gets, and the joints are known to the bit.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from PIL import Image
from scipy.spatial.transform import Rotation
from torch import Tensor

from twofold.body.balance import center_of_mass
from twofold.body.skeleton import JOINT_NAMES, ShapedBody, joint_transforms
from twofold.body.stances import Arm, Leg, Stance, stance_poses
from twofold.geometry.cameras import Camera
from twofold.geometry.rotations import rigid_transform
from twofold.studio.generate import Performer, cast, perform, photograph
from twofold.studio.scene import room

FPS, FRAMES = 12.0, 24
SIZE = (480, 640)
"""Width and height of the images."""


@dataclass(frozen=True)
class Act:
    """What a subject does.

    Attributes:
        stances: that follow one another.
        turn: degrees through which the body turns meanwhile.
        pitch: degrees by which the camera looks down.
        on_feet: the body keeps its balance over its feet; else only its left foot keeps its place.
    """

    stances: tuple[Stance, ...]
    turn: float
    pitch: float
    on_feet: bool


STAND = Stance()
ACTS = {
    "bending": Act((STAND, Stance(bow=65, nod=10), STAND), 0.0, 4.0, True),
    "reaching": Act((STAND, Stance(Arm(120, 60, 0, 20), Arm(40, 80, 0, 40), bow=15, lean=12), STAND), 0.0, 18.0, True),
    "kneeling": Act(
        (STAND, Stance(left_leg=Leg(85, 4, 4, 90), right_leg=Leg(5, 4, 4, 95))), 0.0, 18.0, False
    ),
    "sitting down": Act(
        (STAND, Stance(left_leg=Leg(80, 6, 8, 85), right_leg=Leg(80, 6, 8, 85), bow=20)), 0.0, 4.0, False
    ),
    "turning": Act((STAND, Stance(Arm(40, 40, 0, 40), Arm(40, 40, 0, 40)), STAND), 360.0, 18.0, True),
}  # fmt: skip


def positions(shaped: ShapedBody, poses: Tensor, translations: Tensor) -> Tensor:
    """Joints in the world, metres."""
    carried = joint_transforms(shaped.joints, poses, translations)
    return (carried[..., :3, :3] @ shaped.joints[:, :, None])[..., 0] + carried[..., :3, 3]


def staged(person: Performer, act: Act, yaw: float) -> Performer:
    """The subject with the poses of an act; its soles on the floor, and its weight over its feet where it stands."""
    keys = np.array([stance.numbers() for stance in act.stances], dtype=np.float64)
    at = np.linspace(0, len(keys) - 1, FRAMES)
    part = at - np.floor(at)
    at = np.floor(at) + part * part * (3 - 2 * part)
    angles = np.stack([np.interp(at, np.arange(len(keys)), column) for column in keys.T], -1)
    poses = stance_poses(angles, yaw + act.turn * np.linspace(0, 1, FRAMES))
    ankles = [JOINT_NAMES.index(f"{side}_ankle") for side in ("left", "right")]
    still = torch.zeros(FRAMES, 3)
    for _ in range(3 if act.on_feet else 0):
        joints = positions(person.shaped, torch.from_numpy(poses).float(), still)
        feet = joints[:, [7, 8, 10, 11]].mean(1)
        away = (center_of_mass(joints) - feet).double().numpy()
        heading = Rotation.from_euler("y", Rotation.from_rotvec(poses[:, 0]).as_euler("yxz")[:, :1])
        angle = np.arctan2(heading.inv().apply(away)[:, 2], away[:, 1])
        tilt = heading * Rotation.from_rotvec(-angle[:, None] * [1.0, 0, 0]) * heading.inv()
        poses[:, 0] = (tilt * Rotation.from_rotvec(poses[:, 0])).as_rotvec()
        poses[:, ankles, 0] += angle[:, None]
    poses = poses.astype(np.float32)
    joints = positions(person.shaped, torch.from_numpy(poses), still)
    kept = joints[:, ankles].mean(1) if act.on_feet else joints[:, ankles[0]]
    lowest = [joints[t, [7, 8, 10, 11]].amin(0)[1] for t in range(FRAMES)]
    rise = float(person.shaped.joints[[10, 11], 1].mean() - person.shaped.vertices[:, 1].min()) + 0.016
    moved = torch.stack([-kept[:, 0], rise - torch.stack(lowest), -kept[:, 2]], -1)
    return replace(person, poses=poses, translations=moved.numpy().astype(np.float32))


def tripod(distance: float, pitch: float, focal: float) -> Camera:
    """A camera that looks down at somebody who stands at the world's origin."""
    tilt = np.radians(pitch)
    down = torch.tensor([[1, 0, 0], [0, -np.cos(tilt), -np.sin(tilt)], [0, np.sin(tilt), -np.cos(tilt)]]).float()
    shift = torch.tensor([0.0, 0.0, distance]) - down @ torch.tensor([0.0, 0.9, 0.0])
    width, height = SIZE
    lens = torch.tensor([[focal, 0, (width - 1) / 2], [0, focal, (height - 1) / 2], [0, 0, 1]])
    return Camera(rigid_transform(down, shift), lens, height, width)


def scene(name: str, seed: int) -> tuple[Performer, Camera]:
    """Who does an act before which camera."""
    random, act = np.random.default_rng(seed), ACTS[name]
    person = staged(cast(seed, 4, 4), act, float(random.uniform(-50, 50)))
    distance = float(random.uniform(3.2, 4.4))
    return person, tripod(distance, act.pitch, float(random.uniform(0.8, 1.0)) * max(SIZE) * distance / 4.4)


def true_masks(name: str, seed: int) -> list[np.ndarray]:
    """How much of each pixel the subject covers, 0..255, for each image of `film`."""
    person, camera = scene(name, seed)
    covers = [photograph(person, perform(person, t), camera, 2)[1] for t in range(FRAMES)]
    return [np.rint(255 * cover.clip(0, 1)).astype(np.uint8) for cover in covers]


def film(name: str, seed: int, folder: Path) -> tuple[Camera, Tensor]:
    """Images of an act in a folder, where they are missing; the camera, and the joints in its axes, metres."""
    person, camera = scene(name, seed)
    folder.mkdir(parents=True, exist_ok=True)
    behind = room(camera, seed)
    for t in range(FRAMES):
        if (folder / f"{t:03d}.png").exists():
            continue
        color, cover = photograph(person, perform(person, t), camera, 2)
        image = color + (1 - cover[..., None]) * behind
        Image.fromarray(np.rint(255 * image.clip(0, 1)).astype(np.uint8)).save(folder / f"{t:03d}.png")
    joints = positions(person.shaped, torch.from_numpy(person.poses), torch.from_numpy(person.translations))
    view = camera.world_to_camera
    return camera, joints @ view[:3, :3].T + view[:3, 3]
