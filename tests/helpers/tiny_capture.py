"""A tiny capture to break: a stick figure in front of two cameras."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np
import torch

from twofold.body.skeleton import Body, joint_transforms, shape_body, skin
from twofold.capture.folder import CaptureWriter
from twofold.geometry.cameras import Camera, project

# A T-pose: x to the left hand, y up; ankles at about -0.9.
JOINTS = [
    (0, 0, 0), (0.1, -0.1, 0), (-0.1, -0.1, 0), (0, 0.1, 0), (0.1, -0.5, 0), (-0.1, -0.5, 0), (0, 0.25, 0),
    (0.1, -0.9, 0), (-0.1, -0.9, 0), (0, 0.35, 0), (0.1, -0.95, 0.1), (-0.1, -0.95, 0.1), (0, 0.5, 0), (0.08, 0.45, 0),
    (-0.08, 0.45, 0), (0, 0.6, 0), (0.2, 0.45, 0), (-0.2, 0.45, 0), (0.45, 0.45, 0), (-0.45, 0.45, 0), (0.7, 0.45, 0),
    (-0.7, 0.45, 0), (0.8, 0.45, 0), (-0.8, 0.45, 0),
]  # fmt: skip
MOMENTS, HEIGHT, WIDTH = 6, 40, 48


def stick_body() -> Body:
    # The pelvis is off the origin, as SMPL's is: what turns about the wrong point shows.
    joints = torch.tensor(JOINTS, dtype=torch.float32) + torch.tensor([0.04, 0.05, 0.08])
    corners = 0.05 * torch.tensor([[1, 0, -1], [-1, 0, -1], [0, 1, 0], [0, -1, 1]], dtype=torch.float32)
    template = (joints[:, None] + corners).flatten(0, 1)
    tetrahedron = torch.tensor([[0, 1, 2], [0, 3, 1], [0, 2, 3], [1, 3, 2]])
    return Body(
        name="stick",
        template=template,
        faces=(torch.arange(24)[:, None, None] * 4 + tetrahedron).flatten(0, 1),
        weights=torch.eye(24).repeat_interleave(4, 0),
        joints=joints,
        shape_basis=0.1 * template[..., None],
        joint_basis=0.1 * joints[..., None],
        pose_basis=torch.zeros(len(template), 3, 0),
    )


def tiny_cameras() -> dict[str, Camera]:
    intrinsics = torch.tensor([[50.0, 0, 23.5], [0, 50, 19.5], [0, 0, 1]])
    front, back = torch.eye(4), torch.eye(4)
    front[1, 1] = front[2, 2] = -1  # y up, looking down -z
    back[0, 0] = back[1, 1] = -1
    front[2, 3] = back[2, 3] = 3
    return {"front": Camera(front, intrinsics, HEIGHT, WIDTH), "back": Camera(back, intrinsics, HEIGHT, WIDTH)}


def tiny_motion() -> tuple[torch.Tensor, torch.Tensor]:
    poses = 0.1 * torch.randn(MOMENTS, 24, 3, generator=torch.Generator().manual_seed(0))
    return poses, torch.linspace(-0.1, 0.1, MOMENTS)[:, None] * torch.ones(3)


SPLITS = {
    "train": {"front": [0, 1, 2, 3]},
    "novel_view": {"back": [0, 2]},
    "novel_pose": {"front": [4, 5], "back": [4]},
}


def write_tiny(
    folder: Path,
    overwrite: bool = False,
    ignored: Mapping[tuple[str, int], np.ndarray] | None = None,
    **changes: object,
) -> Path:
    """Writes the tiny capture; `ignored` are layers by camera and time, `changes` replace arguments of `finish`."""
    body, betas, (poses, translations), cameras = stick_body(), torch.tensor([0.5]), tiny_motion(), tiny_cameras()
    shaped = shape_body(body, betas)
    with CaptureWriter(folder, overwrite) as writer:
        for time in range(MOMENTS):
            transforms = joint_transforms(shaped.joints, poses[time], translations[time])
            vertices = skin(shaped.vertices, shaped.weights, transforms)
            writer.mesh(time, vertices.numpy(), shaped.faces.numpy())
            for name, camera in cameras.items():
                image = np.full((HEIGHT, WIDTH, 3), 30 + time, np.uint8)
                mask = np.zeros((HEIGHT, WIDTH), np.uint8)
                columns, rows = project(camera, vertices)[0].round().long().unbind(-1)
                mask[rows, columns] = 255
                image[rows, columns] = (200, 100, 50)
                writer.image(name, time, image)
                writer.mask(name, time, mask)
        for (name, time), layer in (ignored or {}).items():
            writer.ignored(name, time, layer)
        arguments = {
            "name": "tiny", "body": body, "betas": betas, "poses": poses, "translations": translations,
            "cameras": cameras, "splits": SPLITS, "fps": 10.0, "background": (0.1, 0.2, 0.3), "credit": "nobody",
        }  # fmt: skip
        writer.finish(**(arguments | changes))
    return folder
