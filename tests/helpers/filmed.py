"""A person filmed for checks: turns once round with one arm up, before two cameras and a wall with a pattern."""

import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from PIL import Image
from tiny_person import person_body, ring_camera

from twofold.body.skeleton import pose_body, shape_body
from twofold.capture.folder import CaptureWriter
from twofold.geometry.raster import box_filter, rasterize, supersampled

SIZE, MOMENTS, FPS = 96, 24, 12.0
SPLITS = {
    "train": {"front": list(range(20))},
    "novel_view": {"side": [0, 4, 8, 12, 16]},
    "novel_pose": {"front": [20, 21, 22, 23], "side": [21, 23]},
}


def cameras():
    """Far enough away to see all of the person, and a little from above, which no two conventions have in common."""
    return {"front": raised(ring_camera(0.0, SIZE), 0.25), "side": raised(ring_camera(math.pi / 2, SIZE), -0.15)}


def raised(camera, angle):
    """The camera moved up around the person, and zoomed out."""
    zoom = torch.diag(torch.tensor([0.8, 0.8, 1.0]))
    zoom[:2, 2] = 0.1 * (SIZE - 1)
    c, s, middle = math.cos(angle), math.sin(angle), torch.tensor([0.0, 0.0, 2.5])
    turn = torch.tensor([[1, 0, 0], [0, c, -s], [0, s, c]])
    matrix = torch.eye(4)
    matrix[:3, :3] = turn @ camera.world_to_camera[:3, :3]
    matrix[:3, 3] = turn @ (camera.world_to_camera[:3, 3] - middle) + middle
    return replace(camera, world_to_camera=matrix, intrinsics=zoom @ camera.intrinsics)


def motion():
    """Nothing in it is symmetric, so that whatever is exchanged shows."""
    poses, translations = torch.zeros(MOMENTS, 24, 3), torch.zeros(MOMENTS, 3)
    phase = 2 * math.pi * torch.arange(MOMENTS) / MOMENTS
    poses[:, 0, 1] = phase
    poses[:, 16, 2] = 0.9 + 0.3 * phase.sin()  # the left arm up,
    poses[:, 17, 2] = 1.2 - 0.2 * phase.cos()  # the right one down
    poses[:, 18, 1] = -0.6 + 0.3 * (2 * phase).sin()
    poses[:, 1, 0] = -0.5 + 0.3 * (2 * phase).cos()  # the left leg ahead
    poses[:, 5, 0] = 0.6 + 0.3 * (3 * phase).sin()
    translations[:, 0], translations[:, 2] = 0.15 * phase.sin(), -0.1 * phase.cos()
    return poses, translations


def wall(height=SIZE, width=SIZE, seed=0):
    """Coloured blocks, 0..1, nowhere alike."""
    blocks = np.random.default_rng(seed).random((height // 8, width // 8, 3), dtype=np.float32)
    return 0.2 + 0.6 * torch.from_numpy(blocks.repeat(8, 0).repeat(8, 1))


def film(folder, **changes):
    """Writes the capture; `changes` replace arguments of `finish`."""
    body, betas, (poses, translations) = person_body(), torch.tensor([0.0]), motion()
    shaped, behind = shape_body(body, betas), wall()
    paint = 0.5 + 0.4 * torch.sin(9 * body.template)
    with CaptureWriter(folder) as writer:
        for time in range(MOMENTS):
            vertices = pose_body(shaped, poses[time], translations[time]).vertices
            for name, camera in cameras().items():
                hits = rasterize(supersampled(camera, 3), vertices, body.faces)
                seen = (paint[body.faces[hits.face]] * hits.barycentric[..., None]).sum(1)
                original = box_filter(camera, 3, hits.pixel, torch.cat([seen, torch.ones(len(seen), 1)], -1))
                mask = original[..., 3:]
                image = original[..., :3] + (1 - mask) * behind
                writer.image(name, time, (255 * image).round().to(torch.uint8).numpy())
                writer.mask(name, time, (255 * mask[..., 0]).round().to(torch.uint8).numpy())
        arguments = {
            "name": "turner", "body": body, "betas": betas, "poses": poses, "translations": translations,
            "cameras": cameras(), "splits": SPLITS, "fps": FPS, "credit": "nobody",
        }  # fmt: skip
        writer.finish(**(arguments | changes))
    return folder


def move(folder: Path, change):
    """Changes `motion.npz` by a function of its arrays."""
    with np.load(folder / "motion.npz") as old:
        arrays = dict(old)
    np.savez(folder / "motion.npz", **(arrays | change(arrays)))


def describe(folder: Path, change):
    """Changes `capture.json` by a function of its contents."""
    path = folder / "capture.json"
    description = json.loads(path.read_text())
    change(description)
    path.write_text(json.dumps(description))


def each_mask(folder: Path, change):
    """Changes all masks by a function of their bytes and frame."""
    for path in sorted((folder / "masks").rglob("*.png")):
        with Image.open(path) as image:
            mask = np.array(image)
        Image.fromarray(change(mask, int(path.stem))).save(path)
