"""Where BlazePose puts landmarks on synthetic subjects with known poses: the table `blazepose.OFFSETS`.

python -m benchmarks.landmark_offsets [--seeds 11 12 13 14 15] [--frames 24]

Each frame of a made person is filmed from three random sides (pitch -3 to 24 degrees, 2.8 to 5 m), found by BlazePose
image by image, and each landmark's constant offset in its joint's frame is solved for, robustly; left and right
together.
"""

from __future__ import annotations

import argparse
from typing import Any

import numpy as np
import torch

from twofold.body.skeleton import joint_transforms, shape_body
from twofold.geometry.cameras import Camera, project
from twofold.prepare.detect.mediapipe_loader import load_mediapipe
from twofold.prepare.detections import LANDMARKS, mirrored_landmarks
from twofold.prepare.fitting.body_landmarks import body_points
from twofold.studio.generate import cast, perform, photograph

SIZE = 384


def camera_around(vertices: np.ndarray, random: np.random.Generator) -> Camera:
    """Somewhere around a person that is whole in its image."""
    azimuth, pitch = random.uniform(0, 2 * np.pi), np.radians(random.uniform(-3, 24))
    distance, focal = random.uniform(2.8, 5), random.uniform(0.8, 1.3)
    focal = min(focal, 0.85 * distance / 1.9)
    ahead = np.array([np.sin(azimuth) * np.cos(pitch), -np.sin(pitch), np.cos(azimuth) * np.cos(pitch)])
    right = np.cross(ahead, [0.0, 1.0, 0.0])
    right /= np.linalg.norm(right)
    rotation = np.stack([right, np.cross(ahead, right), ahead])
    view = np.eye(4)
    view[:3, :3] = rotation
    view[:3, 3] = -rotation @ ((vertices.max(0) + vertices.min(0)) / 2 - distance * ahead)
    lens = np.array([[focal * SIZE, 0, (SIZE - 1) / 2], [0, focal * SIZE, (SIZE - 1) / 2], [0, 0, 1]])
    return Camera(torch.from_numpy(view).float(), torch.from_numpy(lens).float(), SIZE, SIZE)


def equations(seed: int, frames: int, pose: Any) -> list[list[tuple[np.ndarray, np.ndarray]]]:
    """For each landmark pairs of rows: offsets in the joint's frame (metres) to errors across the ray (metres)."""
    random, person = np.random.default_rng(seed), cast(seed, 2 * frames // 3, frames - 2 * frames // 3)
    points = body_points(person.body)
    rest = points.place + points.basis @ person.betas
    shaped = shape_body(person.body, person.betas)
    rows: list[list[tuple[np.ndarray, np.ndarray]]] = [[] for _ in LANDMARKS]
    for t in range(frames):
        moment = perform(person, t)
        numbers = (torch.from_numpy(x[t]).float() for x in (person.poses, person.translations))
        carried = joint_transforms(shaped.joints, *numbers)[points.joint]
        places = (carried[:, :3, :3] @ rest[..., None])[..., 0] + carried[:, :3, 3]
        for _ in range(3):
            camera = camera_around(moment.vertices, random)
            color, cover = photograph(person, moment, camera, 2)
            behind = random.uniform(0.35, 0.8) * random.uniform(0.9, 1.1, 3)
            image = (np.clip(color + (1 - cover[..., None]) * behind, 0, 1) * 255).astype(np.uint8)
            found = pose.process(image)
            if found.pose_landmarks is None:
                continue
            seen = np.array([(p.x * SIZE - 0.5, p.y * SIZE - 0.5) for p in found.pose_landmarks.landmark])
            sure = np.array([p.visibility for p in found.pose_landmarks.landmark])
            pixels, depth = project(camera, places)
            error = (seen - pixels.numpy()) * (depth / camera.intrinsics[0, 0]).numpy()[:, None]
            trunk = [LANDMARKS.index(f"{s}_{part}") for s in ("left", "right") for part in ("shoulder", "hip")]
            # Left and right swapped, or another person's: no offset.
            if np.abs(error[trunk]).mean() > 0.12:
                continue
            inside = places @ camera.world_to_camera[:3, :3].T + camera.world_to_camera[:3, 3]
            slope = torch.zeros(len(LANDMARKS), 2, 3)
            slope[:, 0, 0] = slope[:, 1, 1] = 1
            slope[:, :, 2] = -inside[:, :2] / inside[:, 2:]
            slope = slope @ camera.world_to_camera[:3, :3] @ carried[:, :3, :3]
            for k in np.flatnonzero((sure > 0.7) & (np.linalg.norm(error, axis=1) < 0.12)):
                rows[k].append((slope[k].numpy(), error[k]))
    return rows


def solve(rows: list[tuple[np.ndarray, np.ndarray]]) -> np.ndarray:
    """The offset, metres, by least squares with weights that fall with the error."""
    matrix, right = (np.concatenate(part) for part in zip(*rows, strict=True))
    weight = np.ones(len(right))
    offset = np.zeros(3)
    for _ in range(10):
        offset = np.linalg.lstsq(matrix * weight[:, None], right * weight, rcond=None)[0]
        left = (right - matrix @ offset).reshape(-1, 2)
        weight = np.repeat(1 / (1 + (left**2).sum(1) / 0.03**2), 2)
    return offset


def main() -> None:
    """Prints the table, millimetres, on the left side."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", nargs="*", type=int, default=[11, 12, 13, 14, 15])
    parser.add_argument("--frames", type=int, default=24)
    options = parser.parse_args()
    rows: list[list[tuple[np.ndarray, np.ndarray]]] = [[] for _ in LANDMARKS]
    for seed in options.seeds:
        pose = load_mediapipe().solutions.pose.Pose(static_image_mode=True, model_complexity=1)
        for whole, one in zip(rows, equations(seed, options.frames, pose), strict=True):
            whole += one
    offsets = np.stack([solve(row) for row in rows])
    both = (offsets + offsets[list(mirrored_landmarks())] * [-1, 1, 1]) / 2
    for k, name in enumerate(LANDMARKS):
        if "right" not in name:
            print(f"{name:18s} {np.round(1000 * both[k]).astype(int).tolist()} from {len(rows[k])} images")


if __name__ == "__main__":
    main()
