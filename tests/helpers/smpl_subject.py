"""A person with an SMPL file of their own, seen by a ring of cameras: what data sets are written of."""

import functools
import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np
import torch
from smpl_files import model
from tiny_person import person_body

from twofold.body.skeleton import PARENTS, Body, pose_body, shape_body
from twofold.body.smpl import read_smpl
from twofold.capture.readers.body_placement import moved_world
from twofold.capture.types import Capture
from twofold.geometry.cameras import Camera, project
from twofold.geometry.lens import pixel_places, resampler, undistorted_pixels
from twofold.geometry.raster import rasterize

LENS = np.array([-0.28, 0.12, 0.001, -0.0005, -0.02])
"""As strong as ZJU-MoCap's."""
Z_DOWN = torch.tensor([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]], dtype=torch.float64)
"""From a world with y up to one with z down, as most of ZJU-MoCap has it."""


def smpl_arrays(body: Body, seed: int = 0) -> dict[str, np.ndarray]:
    """The arrays of an SMPL file whose body this is, with ten shapes and pose blend shapes where it has none."""
    random = np.random.default_rng(seed)
    template = body.template.double().numpy()
    v = len(template)
    regressor = np.zeros((24, v))
    for row, joint in zip(regressor, body.joints.double().numpy(), strict=True):
        near = np.linalg.norm(template - joint, axis=1).argsort()[:30]  # local, as SMPL's
        system = np.concatenate([template[near].T, np.ones((1, 30))])
        row[near] = np.linalg.lstsq(system, np.append(joint, 1.0), rcond=None)[0]
    waves, phases = random.normal(size=(10, 3, 3)) * 3, random.uniform(0, 6, (10, 3))
    shapes = np.stack([0.008 * np.sin(template @ waves[k] + phases[k]) for k in range(10)], -1)
    poses = 0.02 * np.sin(template @ random.normal(size=(3, 207)) * 4)[:, None] * random.normal(size=(1, 3, 207))
    parents = np.array([PARENTS, range(24)])
    return {
        "v_template": template, "shapedirs": shapes, "posedirs": 0.3 * poses, "J_regressor": regressor,
        "weights": body.weights.double().numpy(), "f": body.faces.numpy().astype(np.uint32),
        "kintree_table": np.where(parents < 0, 2**32 - 1, parents).astype(np.uint32),
    }  # fmt: skip


@dataclass(frozen=True)
class Scene:
    """The ground truth.

    Attributes:
        smpl: the file.
        body: in it.
        betas: of this person.
        poses: T x 24 x 3, in a world with y up, float64.
        translations: T x 3.
        cameras: K, world-to-camera, of images without distortion, float64.
        size: rows and columns.
        shown: image and mask without distortion, by camera and frame; None to render.
    """

    smpl: Path
    body: Body
    betas: torch.Tensor
    poses: torch.Tensor
    translations: torch.Tensor
    cameras: list[tuple[np.ndarray, np.ndarray]]
    size: int
    shown: Callable[[int, int], tuple[np.ndarray, np.ndarray]] | None = None

    @cached_property
    def joint(self) -> torch.Tensor:
        """Rest position of the root joint."""
        return self.rest_joints[0]

    @cached_property
    def rest_joints(self) -> torch.Tensor:
        return self.body.joints.double() + self.body.joint_basis.double() @ self.betas.double()

    def vertices(self, frame: int) -> torch.Tensor:
        """Ground-truth vertices, float64."""
        shaped = shape_body(self.body, self.betas.float())
        shaped = replace(
            shaped, vertices=shaped.vertices.double(), joints=self.rest_joints,
            weights=shaped.weights.double(), pose_basis=shaped.pose_basis.double(),
        )  # fmt: skip
        return pose_body(shaped, self.poses[frame], self.translations[frame]).vertices

    def camera(self, index: int) -> Camera:
        k, view = self.cameras[index]
        return Camera(torch.from_numpy(view), torch.from_numpy(k), self.size, self.size)

    def pixels(self, index: int, frame: int) -> np.ndarray:
        return project(self.camera(index), self.vertices(frame))[0].numpy()

    def image(self, index: int, frame: int) -> tuple[np.ndarray, np.ndarray]:
        """Colours and mask (0 or 255) without distortion."""
        if self.shown is not None:
            return self.shown(index, frame)
        camera = self.camera(index)
        camera = replace(camera, world_to_camera=camera.world_to_camera.float(), intrinsics=camera.intrinsics.float())
        hits = rasterize(camera, self.vertices(frame).float(), self.body.faces)
        corners = self.body.faces[hits.face]
        place = (self.body.template[corners] * hits.barycentric[..., None]).sum(1)
        image = np.full((self.size * self.size, 3), (20, 40, 60), np.uint8)
        image[hits.pixel.numpy()] = (128 + 120 * torch.sin(7 * place)).numpy().astype(np.uint8)
        mask = np.zeros(self.size * self.size, np.uint8)
        mask[hits.pixel.numpy()] = 255
        return image.reshape(self.size, self.size, 3), mask.reshape(self.size, self.size)

    def filmed(self, index: int, frame: int) -> tuple[np.ndarray, np.ndarray]:
        """The same through a lens with distortion."""
        image, mask = self.image(index, frame)
        ideal = undistorted_pixels(self.cameras[index][0], LENS, pixel_places(*[np.arange(self.size)] * 2))
        bend = resampler(ideal)
        return bend(image), np.where(bend(mask[..., None])[..., 0] > 127, 255, 0).astype(np.uint8)

    def in_world(self, rotation: torch.Tensor, shift: torch.Tensor) -> "Scene":
        """The same scene in a world whose points X are at rotation X + shift."""
        count = len(self.poses)
        root, moved = moved_world(
            rotation.expand(count, 3, 3), shift.expand(count, 3), self.poses[:, 0], self.translations, self.joint
        )
        change = np.eye(4)
        change[:3, :3], change[:3, 3] = rotation.numpy(), shift.numpy()
        cameras = [(k, view @ np.linalg.inv(change)) for k, view in self.cameras]
        return replace(
            self, poses=torch.cat([root[:, None], self.poses[:, 1:]], 1), translations=moved, cameras=cameras,
            shown=self.image,
        )  # fmt: skip


def ring(count: int, size: int, distance: float = 2.5) -> list[tuple[np.ndarray, np.ndarray]]:
    """Cameras around the person, each with a focal length of its own."""
    found = []
    for i in range(count):
        angle = 2 * math.pi * i / count + 0.2
        c, s = math.cos(angle), math.sin(angle)
        rotation = np.array([[c, 0, -s], [0, -1.0, 0], [-s, 0, -c]])
        view = np.eye(4)
        view[:3, :3] = rotation
        view[:3, 3] = np.array([0.0, 0.0, distance]) - rotation @ [0.03, -0.4, 0.0]
        focal = (1.05 + 0.01 * (i % 3)) * size
        middle = (size - 1) / 2
        k = np.array([[focal, 0, middle + 0.7], [0, focal * 1.01, middle - 0.4], [0, 0, 1]])
        found.append((k, view))
    return found


def motion(frames: int) -> tuple[torch.Tensor, torch.Tensor]:
    """Turns, swings arms and legs; every frame differs from every other one."""
    t = torch.linspace(0, 1, frames, dtype=torch.float64)
    poses = torch.zeros(frames, 24, 3, dtype=torch.float64)
    poses[:, 0, 1] = 0.9 * torch.sin(5 * t) + 0.2
    poses[:, 0, 0] = 0.1 * t
    for joint, axis, amount in ((1, 0, 0.4), (2, 0, -0.4), (16, 2, -0.9), (17, 2, 0.8), (18, 1, 0.6), (12, 1, 0.3)):
        poses[:, joint, axis] = amount * torch.sin(4 * t + joint) + 0.1 * t
    return poses, torch.stack([0.1 * t, 0.02 * torch.sin(6 * t), 0.15 * (1 - t)], -1)


def write_smpl(path: Path, body: Body | None = None, seed: int = 0) -> Path:
    np.savez(path, **smpl_arrays(body or person_body(), seed))
    return path


def make_scene(folder: Path, frames: int = 10, cameras: int = 3, size: int = 64) -> Scene:
    smpl = write_smpl(folder / "smpl.npz")
    betas = torch.from_numpy(np.random.default_rng(3).normal(size=10) * 0.8)
    poses, translations = motion(frames)
    scene = Scene(smpl, read_smpl(smpl), betas, poses, translations, ring(cameras, size), size)
    return replace(scene, shown=functools.cache(scene.image))  # several data sets show it


def scene_of(capture: Capture, folder: Path) -> Scene:
    """A scene of a capture (of the studio): its body as an SMPL file of one shape, its images as they are."""
    shaped = shape_body(capture.body, capture.betas)
    plain = replace(
        capture.body, template=shaped.vertices, joints=shaped.joints,
        shape_basis=torch.zeros(len(shaped.vertices), 3, 0), joint_basis=torch.zeros(24, 3, 0),
    )  # fmt: skip
    arrays = smpl_arrays(plain)
    arrays["posedirs"] = (
        capture.body.pose_basis.double().numpy()
        if capture.body.pose_basis.shape[-1]
        else np.zeros_like(arrays["posedirs"])
    )
    np.savez(folder / "smpl.npz", **arrays)
    frames = {(f.camera_name, f.frame_index): f for split in capture.splits.values() for f in split}
    names = sorted({name for name, _ in frames})
    times = sorted({time for _, time in frames})
    by_time = {time: next(f for (_, t), f in frames.items() if t == time) for time in times}

    def shown(camera: int, frame: int) -> tuple[np.ndarray, np.ndarray]:
        found = frames[names[camera], times[frame]]
        image = (255 * found.image()).round().numpy().astype(np.uint8)
        return image, (255 * (found.mask() > 0.5)).numpy().astype(np.uint8)

    cameras = [next(f.camera for (n, _), f in frames.items() if n == name) for name in names]
    return Scene(
        folder / "smpl.npz", read_smpl(folder / "smpl.npz"), torch.zeros(10).double(),
        torch.stack([by_time[t].pose for t in times]).double(),
        torch.stack([by_time[t].translation for t in times]).double(),
        [(c.intrinsics.double().numpy(), c.world_to_camera.double().numpy()) for c in cameras],
        cameras[0].height, shown,
    )  # fmt: skip


__all__ = ["LENS", "Z_DOWN", "Scene", "make_scene", "model", "scene_of", "smpl_arrays", "write_smpl"]
