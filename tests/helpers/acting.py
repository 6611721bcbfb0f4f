"""A body that acts before cameras, all of it known: motion, landmarks, masks, images."""

import dataclasses
import functools
import importlib.util

import numpy as np
import pytest
import torch
from little_body import little_body

from twofold.body.anny import anny_body
from twofold.body.skeleton import JOINT_NAMES
from twofold.geometry.cameras import Camera, project
from twofold.geometry.raster import rasterize
from twofold.geometry.rotations import axis_angle_to_matrix
from twofold.prepare.detections import Track
from twofold.prepare.fitting.body_landmarks import body_points
from twofold.prepare.fitting.observations import Evidence
from twofold.prepare.fitting.parameters import FittedMotion, choose, place_joints, place_points, pose_motion

HEIGHT, WIDTH = 200, 160
HIPS = (23, 24)

needs_anny = pytest.mark.skipif(importlib.util.find_spec("anny") is None, reason="the package anny is not installed")


@functools.cache
def the_body(name="sausages"):
    return anny_body() if name == "anny" else little_body(spacing=0.06, thickness=0.07)


def with_numbers(thing, dtype=torch.float64):
    """A dataclass with its numbers in another precision."""
    parts = {field.name: getattr(thing, field.name) for field in dataclasses.fields(thing)}
    numbers = {k: v.to(dtype) for k, v in parts.items() if isinstance(v, torch.Tensor) and v.is_floating_point()}
    return dataclasses.replace(thing, **numbers)


def random_motion(body, moments=4, seed=0, size=0.4, dtype=torch.float32):
    """Anything that the unknowns of a fit may be."""
    generator = torch.Generator().manual_seed(seed)

    def random(*shape):
        return torch.randn(shape, generator=generator, dtype=torch.float64)

    motion = FittedMotion(
        guess=axis_angle_to_matrix(2 * random(moments, 3)), root=size * random(moments, 3),
        pose=size * random(moments, 23, 3), translation=random(moments, 3) + torch.tensor([0.0, 0.0, 6.0]),
        betas=0.5 * random(body.shape_basis.shape[-1]), marks=0.02 * random(33, 3), log_focal=0.1 * random(),
        log_distance=0.1 * random(),
    )  # fmt: skip
    return with_numbers(motion, dtype)


def acted(body, moments=12, fps=10.0, turn=1.0, heading=0.0, betas=0.4):
    """Somebody who turns and swings arms and legs, in a world with y up; the pelvis is about the origin."""
    seconds = torch.arange(moments) / fps
    yaw = heading + turn * (seconds - seconds.mean())
    root = torch.zeros(moments, 3)
    root[:, 1] = yaw
    pose = torch.zeros(moments, 23, 3)
    swing = torch.sin(2 * torch.pi * 0.7 * seconds)
    for side, sign in (("left", 1.0), ("right", -1.0)):
        at = {part: JOINT_NAMES.index(f"{side}_{part}") - 1 for part in ("hip", "knee", "shoulder", "elbow")}
        pose[:, at["shoulder"], 2] = sign * (-0.8 + 0.3 * swing)
        pose[:, at["elbow"], 1] = -sign * (0.6 + 0.3 * swing)
        pose[:, at["hip"], 0] = -0.35 + 0.25 * sign * swing
        pose[:, at["knee"], 0] = 0.6 + 0.3 * sign * swing
    walk = torch.stack([0.2 * swing, 0.03 * swing, 0.1 * torch.cos(2 * seconds)], 1)
    shape = torch.zeros(body.shape_basis.shape[-1])
    shape[0] = betas
    rest = body.joints[0] + body.joint_basis[0, :, : len(shape)] @ shape
    return FittedMotion(
        guess=axis_angle_to_matrix(root), root=torch.zeros(moments, 3), pose=pose, translation=walk - rest,
        betas=shape, marks=torch.zeros(33, 3), log_focal=torch.zeros(()), log_distance=torch.zeros(()),
    )  # fmt: skip


def standing_camera(azimuth=0.0, distance=3.6, height=HEIGHT, width=WIDTH, focal=1.4):
    """Looks at the origin from around; at azimuth 0 it sees a face that looks along +z."""
    sine, cosine = float(np.sin(azimuth)), float(np.cos(azimuth))
    view = torch.eye(4)
    view[:3, :3] = torch.tensor([[cosine, 0, -sine], [0, -1, 0], [-sine, 0, -cosine]])
    view[2, 3] = distance
    size = focal * max(height, width)
    intrinsics = torch.tensor([[size, 0, (width - 1) / 2], [0, size, (height - 1) / 2], [0, 0, 1]])
    return Camera(view, intrinsics, height, width)


def before_camera(body, motion, camera):
    """The motion in the axes of a camera, and that camera at the world's origin: what one camera alone can tell."""
    rotation, shift = camera.world_to_camera[:3, :3], camera.world_to_camera[:3, 3]
    rest = body.joints[0] + body.joint_basis[0, :, : len(motion.betas)] @ motion.betas
    guess = rotation @ axis_angle_to_matrix(motion.root) @ motion.guess
    moved = (motion.translation + rest) @ rotation.T + shift - rest
    turned = dataclasses.replace(motion, guess=guess, root=torch.zeros_like(motion.root), translation=moved)
    return turned, dataclasses.replace(camera, world_to_camera=torch.eye(4))


def landmarks(body, motion, camera, noise=0.0, seed=0):
    """What an estimator finds that is off by `noise` pixels."""
    places = place_points(pose_motion(body, motion), body_points(body), motion)
    pixels = project(camera, places)[0].numpy()
    pixels = pixels + noise * np.random.default_rng(seed).standard_normal(pixels.shape)
    hips = places[:, HIPS].mean(1, keepdim=True)
    world = ((places - hips) @ camera.world_to_camera[:3, :3].T).numpy()
    return Track(pixels.astype(np.float32), np.full(pixels.shape[:2], 0.95, np.float32), world)


def silhouettes(body, motion, camera):
    """Masks, 255 where the body covers a pixel's centre, else 0."""
    masks = []
    for vertices in pose_motion(body, motion).place(choose(body, torch.arange(len(body.template)))):
        mask = np.zeros(camera.height * camera.width, np.uint8)
        mask[rasterize(camera, vertices, body.faces).pixel.numpy()] = 255
        masks.append(mask.reshape(camera.height, camera.width))
    return masks


def evidence_of(body, motion, camera, noise=0.0, seed=0):
    return Evidence(camera, landmarks(body, motion, camera, noise, seed), silhouettes(body, motion, camera))


def joints_of(body, motion):
    return place_joints(pose_motion(body, motion), body, motion)


def overlap(first, second):
    """Intersection over union of masks, frame by frame."""
    pairs = [(a > 127, b > 127) for a, b in zip(first, second, strict=True)]
    return np.array([(a & b).sum() / (a | b).sum() for a, b in pairs])
