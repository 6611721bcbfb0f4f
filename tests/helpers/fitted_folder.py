"""A folder with images, masks and a body that another program fitted, as `twofold convert` imports it."""

from pathlib import Path

import numpy as np
from PIL import Image
from scipy.spatial.transform import Rotation
from tiny_capture import HEIGHT, WIDTH, stick_body

from twofold.body.skeleton import PARENTS

FRAMES = 23


def posed_reference(joints, vertices, joint_of, pose, translation):
    """Forward kinematics by a loop, for rigid parts: joints, vertices."""
    rotations, places = [], []
    for j, parent in enumerate(PARENTS):
        local = Rotation.from_rotvec(pose[j]).as_matrix()
        rotations.append(local if parent < 0 else rotations[parent] @ local)
        offset = joints[j] + translation if parent < 0 else rotations[parent] @ (joints[j] - joints[parent])
        places.append(offset if parent < 0 else places[parent] + offset)
    moved = [rotations[j] @ (v - joints[j]) + places[j] for v, j in zip(vertices, joint_of, strict=True)]
    return np.array(places), np.array(moved)


def write_fitted(folder: Path) -> None:
    """The stick figure with its arms hanging, in OpenCV's axes."""
    random = np.random.default_rng(0)
    body = stick_body()
    joint_of = body.weights.argmax(1).numpy()
    hanging = np.zeros((24, 3))
    hanging[16, 2], hanging[17, 2] = -1.0, 1.0
    joints, vertices = posed_reference(body.joints.numpy(), body.template.numpy(), joint_of, hanging, np.zeros(3))
    poses = random.normal(0, 0.15, (FRAMES, 24, 3))
    # The camera's y points down, so the person is turned upside down about x.
    poses[:, 0] = [(Rotation.from_rotvec(p) * Rotation.from_euler("x", np.pi)).as_rotvec() for p in poses[:, 0]]
    translations = random.normal((0, 0, 3.5), 0.05, (FRAMES, 3))
    intrinsics = np.array([[50.0, 0, 23.5], [0, 50, 19.5], [0, 0, 1]])
    (folder / "images").mkdir(parents=True)
    (folder / "masks").mkdir()
    for time in range(FRAMES):
        _, moved = posed_reference(joints, vertices, joint_of, poses[time], translations[time])
        pixels = moved @ intrinsics.T
        columns, rows = (pixels[:, :2] / pixels[:, 2:]).round().astype(int).T
        mask = np.zeros((HEIGHT, WIDTH), np.uint8)
        mask[rows, columns] = 255
        Image.fromarray(mask).save(folder / f"masks/{time:04d}.png")
        Image.fromarray(np.stack([mask] * 3, -1)).save(folder / f"images/{time:04d}.jpg")
    iou = np.full(FRAMES, 0.9, np.float32)
    iou[[7, 15]] = 0.6
    np.savez(
        folder / "capture.npz",
        intrinsics=intrinsics, world_to_camera=np.eye(4), poses=poses, transl=translations, rest_vertices=vertices,
        rest_joints=joints, parents=np.array(PARENTS), weights=body.weights.numpy(), faces=body.faces.numpy(),
        silhouette_iou=iou, video_frame=np.arange(FRAMES) * 3,
    )  # fmt: skip
