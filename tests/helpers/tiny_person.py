"""A filmed person small enough to train on within a test: 48 x 48 pixels, seven frames, two cameras."""

import math
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from little_body import JOINTS
from skimage.measure import marching_cubes

from twofold.body.skeleton import PARENTS, Body, pose_body, shape_body
from twofold.capture.folder import CaptureWriter
from twofold.capture.types import Capture
from twofold.field.factorized_grid import GridFieldConfig
from twofold.geometry.cameras import Camera
from twofold.geometry.raster import box_filter, rasterize, supersampled
from twofold.methods.completion import CompletionConfig
from twofold.methods.factorized_recipes import quick
from twofold.methods.skinned_config import COMPLETING
from twofold.recipe import Recipe
from twofold.sampling.shell_sampler import ShellSampler
from twofold.training.loop import Progress, train

SIZE, MOMENTS, FACTOR = 48, 7, 4
BACKGROUND = (0.2, 0.1, 0.3)
SPLITS = {
    "train": {"front": [0, 1, 2, 3, 4]},
    "novel_view": {"side": [0, 2, 4]},
    "novel_pose": {"front": [5], "side": [5, 6]},
}


def person_body(spacing: float = 0.06, thickness: float = 0.08) -> Body:
    """A closed surface around all bones, some 700 vertices; each follows the bones close to it."""
    joints = torch.tensor(JOINTS)
    low, high = joints.amin(0) - thickness - 2 * spacing, joints.amax(0) + thickness + 2 * spacing
    axes = [torch.arange(float(a), float(b), spacing) for a, b in zip(low, high, strict=True)]
    grid = torch.stack(torch.meshgrid(*axes, indexing="ij"), -1)
    volume = bone_distances(joints, grid).amin(-1) - thickness
    vertices, faces, _, _ = marching_cubes(volume.numpy(), 0.0, spacing=(spacing,) * 3, gradient_direction="descent")
    template = low + torch.from_numpy(vertices.astype(np.float32))
    closeness = torch.exp(-(bone_distances(joints, template) ** 2) / (2 * 0.05**2))
    weights = torch.zeros(len(template), 24).index_add(1, torch.tensor(PARENTS[1:]), closeness)
    return Body(
        name="tiny",
        template=template,
        faces=torch.from_numpy(faces.astype(np.int64)),
        weights=weights / weights.sum(-1, keepdim=True),
        joints=joints,
        shape_basis=0.1 * template[..., None],
        joint_basis=0.1 * joints[..., None],
        pose_basis=torch.zeros(len(template), 3, 0),
    )


def bone_distances(joints: torch.Tensor, points: torch.Tensor) -> torch.Tensor:
    """Distance of points [... 3] to the segment from each joint's parent to the joint, [... 23]."""
    start, along = joints[list(PARENTS[1:])], joints[1:] - joints[list(PARENTS[1:])]
    offset = points[..., None, :] - start
    share = ((offset * along).sum(-1) / along.square().sum(-1)).clamp(0, 1)
    return (offset - share[..., None] * along).norm(dim=-1)


def ring_camera(angle: float, size: int = SIZE) -> Camera:
    """Looks at the person's middle from 2.5 metres, `angle` (radians) from the front."""
    c, s = math.cos(angle), math.sin(angle)
    rotation = torch.tensor([[c, 0, -s], [0, -1.0, 0], [-s, 0, -c]])
    middle = torch.tensor([0.03, -0.4, 0.0])
    transform = torch.eye(4)
    transform[:3, :3] = rotation
    transform[:3, 3] = torch.tensor([0.0, 0.0, 2.5]) - rotation @ middle
    intrinsics = torch.tensor([[1.25 * size, 0, (size - 1) / 2], [0, 1.25 * size, (size - 1) / 2], [0, 0, 1]])
    return Camera(transform, intrinsics, size, size)


def person_cameras() -> dict[str, Camera]:
    return {"front": ring_camera(0.0), "side": ring_camera(1.0)}


def person_motion() -> tuple[torch.Tensor, torch.Tensor]:
    """Turns a little to both sides and swings arms and legs."""
    poses, translations = torch.zeros(MOMENTS, 24, 3), torch.zeros(MOMENTS, 3)
    for moment in range(MOMENTS):
        phase = 2 * math.pi * moment / MOMENTS
        poses[moment, 0, 1] = 0.6 * math.sin(phase)
        poses[moment, [16, 17], 2] = torch.tensor([-0.5, 0.5]) * (1 + math.cos(phase))
        poses[moment, [1, 2], 0] = 0.3 * torch.tensor([1.0, -1.0]) * math.sin(phase)
        translations[moment, 0] = 0.03 * math.cos(phase)
    return poses, translations


def person_colors(body: Body) -> torch.Tensor:
    """One colour a vertex: broad bands that cross the whole body."""
    waves = torch.stack([5 * body.template[:, 1], 4 * body.template[:, 0], 6 * body.template.sum(1)], -1)
    return 0.5 + 0.4 * torch.sin(waves)


def write_person(folder: Path) -> Path:
    """Films that person into a capture folder."""
    body, betas, (poses, translations), cameras = person_body(), torch.tensor([0.3]), person_motion(), person_cameras()
    shaped, colors = shape_body(body, betas), person_colors(body)
    with CaptureWriter(folder) as writer:
        for time in range(MOMENTS):
            vertices = pose_body(shaped, poses[time], translations[time]).vertices
            if time in (0, 5):
                writer.mesh(time, vertices.numpy(), body.faces.numpy())
            for name, camera in cameras.items():
                hits = rasterize(supersampled(camera, FACTOR), vertices, body.faces)
                seen = (colors[body.faces[hits.face]] * hits.barycentric[..., None]).sum(1)
                values = torch.cat([seen, torch.ones(len(seen), 1)], -1)
                original = box_filter(camera, FACTOR, hits.pixel, values)
                mask = original[..., 3]
                image = original[..., :3] + (1 - mask[..., None]) * torch.tensor(BACKGROUND)
                writer.image(name, time, (255 * image).round().to(torch.uint8).numpy())
                writer.mask(name, time, (255 * mask).round().to(torch.uint8).numpy())
        writer.finish(
            name="tiny person", body=body, betas=betas, poses=poses, translations=translations, cameras=cameras,
            splits=SPLITS, fps=10.0, background=BACKGROUND,
        )  # fmt: skip
    return folder


def tiny_recipe(steps: int = 100, **training: object) -> Recipe:
    """`quick`, shrunk; poses are refined and the shells follow them within the first few steps."""
    start = quick()
    method = replace(
        start.method,
        field=GridFieldConfig(low_voxels=(0.12, 0.06), high_voxels=(0.04,), width=16, shared=8),
        sampler=ShellSampler(radius=0.06, step=0.02, voxel=0.03, min_weight=1e-3),
        losses=replace(start.method.losses, eikonal_points=64),
        pose=replace(start.method.pose, zero_until=3, refine_from=4, refine=("root", "body", "translation", "shape")),
        shell_refresh=12,
        completion=CompletionConfig(),
    )
    settings = {"steps": steps, "images_per_step": 1, "warmup": 3, "checkpoint_every": 10, "preview_every": 0}
    settings["pixels"] = replace(start.training.pixels, rays=256)
    return replace(start, name="tiny", method=method, training=replace(start.training, **(settings | training)))


def completing_recipe(steps: int = 100, **training: object) -> Recipe:
    """`tiny_recipe` with unobserved regions completed, from an early step on."""
    recipe = tiny_recipe(steps, **training)
    completion = replace(COMPLETING, start=5, every=8, points=64)
    return replace(recipe, method=replace(recipe.method, completion=completion))


@dataclass(frozen=True)
class Run:
    """A finished training: its folder, its capture, and what it told at each step."""

    folder: Path
    capture: Capture
    told: tuple[Progress, ...]


def train_tiny(capture: Capture, folder: Path) -> Run:
    told: list[Progress] = []
    train(capture, tiny_recipe(), folder, torch.device("cpu"), progress=told.append)
    return Run(folder, capture, tuple(told))
