"""Writers of foreign data sets, each exactly in its real format, of one scene."""

import json
import pickle
from pathlib import Path

import numpy as np
import torch
from PIL import Image
from smpl_subject import LENS, Z_DOWN, Scene

from twofold.body.skeleton import joint_transforms
from twofold.capture.readers.body_placement import to_model_origin, to_pelvis
from twofold.geometry.rotations import axis_angle_to_matrix, matrix_to_axis_angle

FLIP = np.diag([1.0, -1.0, -1.0])


def save_image(path, array):
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(array).save(path, quality=95)


def save_object(path, value):
    path.parent.mkdir(parents=True, exist_ok=True)
    np.save(path, value)


def in_zju_world(scene: Scene) -> Scene:
    """z down, the origin somewhere on the floor."""
    return scene.in_world(Z_DOWN, torch.tensor([0.3, -0.2, -0.9], dtype=torch.float64))


def zju_parameters(scene: Scene, frame: int) -> dict[str, np.ndarray]:
    turn, shift = to_model_origin(scene.poses[frame : frame + 1, 0], scene.translations[frame : frame + 1], scene.joint)
    poses = scene.poses[frame].clone()
    poses[0] = 0
    return {
        "poses": poses.reshape(1, 72).numpy(), "shapes": scene.betas.reshape(1, 10).numpy(), "Rh": turn.numpy(),
        "Th": shift.numpy(),
    }  # fmt: skip


def zju_annotations(scene: Scene, paths: list[list[str]], lists: bool = False) -> dict:
    def form(array):
        return array.tolist() if lists else array

    cams = {
        "K": [form(k) for k, _ in scene.cameras],
        "D": [form(LENS.reshape(5, 1)) for _ in scene.cameras],
        "R": [form(view[:3, :3]) for _, view in scene.cameras],
        "T": [form(1000 * view[:3, 3:]) for _, view in scene.cameras],
    }
    kpts = np.zeros((len(scene.cameras), 25, 3))
    return {"cams": cams, "ims": [{"ims": frame, "kpts2d": kpts} for frame in paths]}


def write_zju(folder: Path, scene: Scene, from_one: bool = False, masks=("mask", "mask_cihp")) -> Path:
    """CoreView_377 and its like, or, counted from 1, CoreView_313 and 315."""
    scene = in_zju_world(scene)
    subject = folder.name.removeprefix("CoreView_")
    numbers = [*range(1, 20), 22, 23] if from_one else [*range(1, 24)]
    names = [f"Camera ({n})" if from_one else f"Camera_B{n}" for n in numbers][: len(scene.cameras)]
    paths = []
    for t in range(len(scene.poses)):
        row = []
        for name in names:
            inner = name.replace(" ", "_")
            stem = f"CoreView_{subject}_{inner}_{t + 1:04d}_2019-08-23_16-{t:02d}-50.592" if from_one else f"{t:06d}"
            row.append(f"{name}/{stem}.jpg")
        paths.append(row)
    for t in range(len(scene.poses)):
        for c, path in enumerate(paths[t]):
            image, mask = scene.filmed(c, t)
            save_image(folder / path, image)
            parts = np.where(mask > 0, 1 + (np.arange(mask.size).reshape(mask.shape) // 7) % 18, 0).astype(np.uint8)
            half = np.where(np.arange(mask.shape[0])[:, None] < mask.shape[0] // 2, mask // 255, 0).astype(np.uint8)
            for kind in masks:
                labels = {"mask": mask // 255, "mask_cihp": parts, "half": half}[kind]
                save_image((folder / kind / path).with_suffix(".png"), labels)
        save_object(folder / "new_params" / f"{t + from_one}.npy", zju_parameters(scene, t))
        old = zju_parameters(scene, t)
        old["poses"] = old["poses"] + 0.05
        save_object(folder / "params" / f"{t + from_one}.npy", old)
        save_object(folder / "new_vertices" / f"{t + from_one}.npy", scene.vertices(t).numpy())
    save_object(folder / "annots.npy", zju_annotations(scene, paths, lists=from_one))
    return folder


def write_zju_refined(folder: Path, scene: Scene) -> Path:
    """Refined ZJU-MoCap, the paths in its annotations being those of the old files."""
    scene = in_zju_world(scene)
    for t in range(len(scene.poses)):
        for c in range(len(scene.cameras)):
            image, mask = scene.filmed(c, t)
            save_image(folder / "images" / f"{c:02d}" / f"{t:06d}.jpg", image)
            save_image(folder / "mask" / f"{c:02d}" / f"{t:06d}.png", mask)
        save_object(folder / "smpl_params" / f"{t}.npy", zju_parameters(scene, t))
        save_object(folder / "smpl_vertices" / f"{t}.npy", scene.vertices(t).numpy())
    paths = [[f"Camera_B{c + 1}/{t:06d}.jpg" for c in range(len(scene.cameras))] for t in range(len(scene.poses))]
    save_object(folder / "annots.npy", zju_annotations(scene, paths))
    return folder


def write_humannerf(folder: Path, scene: Scene, camera: int = 0, wild: bool = False, beats: bool = False) -> Path:
    """One camera; of ZJU-MoCap with distortion, else with the translation in the camera of each frame."""
    scene = scene if wild else in_zju_world(scene)
    k, view = scene.cameras[camera]
    count = len(scene.poses)
    rest = scene.rest_joints
    cameras, meshes = {}, {}
    for t in range(count):
        name = f"{t:05d}_frame" if wild else f"frame_{t:06d}"
        image, mask = scene.image(camera, t) if wild else scene.filmed(camera, t)
        save_image(folder / "images" / f"{name}.png", image)
        save_image(folder / "masks" / f"{name}.png", np.repeat(mask[..., None], 3, -1))
        poses = scene.poses[t].clone()
        root, shift = poses[:1].clone(), scene.translations[t : t + 1]
        poses[0] = 0
        transforms = joint_transforms(rest, poses, torch.zeros(3).double())
        joints = (transforms[:, :3, :3] @ rest[:, :, None])[..., 0] + transforms[:, :3, 3]
        if wild:
            carried = view.copy()  # the body's translation
            carried[:3, 3] += view[:3, :3] @ shift[0].numpy()
            cameras[name] = {"intrinsics": k.astype("f4"), "extrinsics": carried.astype("f4")}
            turn, place = to_pelvis(root, torch.zeros(1, 3).double(), rest[0])
            offset = rest[0]
        else:
            cameras[name] = {"intrinsics": k.astype("f4"), "extrinsics": view, "distortions": LENS.astype("f4")}
            turn, place = to_model_origin(root, shift, rest[0])
            offset = torch.zeros(3).double()
        meshes[name] = {
            "Rh": turn[0].numpy().astype("f4"), "Th": place[0].numpy().astype("f4"),
            "poses": poses.reshape(72).numpy().astype("f4"), "joints": (joints - offset).numpy().astype("f4"),
            "tpose_joints": (rest - offset).numpy().astype("f4"),
        } | ({"beats": scene.betas.numpy()} if beats else {})  # fmt: skip
    for name, content in (("cameras", cameras), ("mesh_infos", meshes), ("canonical_joints", {"joints": rest.numpy()})):
        (folder / f"{name}.pkl").write_bytes(pickle.dumps(content))
    (folder / "config.yaml").write_text("dataset:\n  subject: '387'\n")
    return folder


def write_monohuman(folder: Path, scene: Scene) -> Path:
    """One folder for each camera, with betas."""
    for c in range(len(scene.cameras)):
        write_humannerf(folder / str(c), scene, c, beats=True)
    return folder


def write_metadata(folder: Path, scene: Scene, camera: int = 0, wrapped: bool = False) -> Path:
    """What HumanNeRF's preparation of videos starts from."""
    k, view = scene.cameras[camera]
    entries = {}
    for t in range(len(scene.poses)):
        image, mask = scene.image(camera, t)
        save_image(folder / "images" / f"{t:05d}.png", image)
        save_image(folder / "masks" / f"{t:05d}.png", mask)
        carried = view.copy()
        carried[:3, 3] += view[:3, :3] @ scene.translations[t].numpy()
        poses, betas = scene.poses[t].reshape(72).tolist(), scene.betas.tolist()
        entries[f"{t:05d}"] = {
            "poses": [poses] if wrapped else poses, "betas": [betas] if wrapped else betas,
            "cam_intrinsics": k.tolist(), "cam_extrinsics": carried.tolist(),
        }  # fmt: skip
    (folder / "metadata.json").write_text(json.dumps(entries))
    return folder


def centred(scene: Scene, camera: int, frame: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Pose (72), translation and world-to-camera as Vid2Avatar's preparation makes them, step by step."""
    _, view = scene.cameras[camera]
    joint = scene.joint.numpy()
    rotation, offset = view[:3, :3], view[:3, 3]
    pose = scene.poses[frame].clone()
    pose[0] = matrix_to_axis_angle(torch.from_numpy(FLIP @ rotation) @ axis_angle_to_matrix(pose[0]))
    shift = FLIP @ scene.translations[frame].numpy()
    moved = rotation @ (scene.translations[frame].numpy() + joint) + offset - scene.translations[frame].numpy()
    moved = moved - FLIP @ joint
    one = Scene(scene.smpl, scene.body, scene.betas, pose[None], torch.from_numpy(shift)[None], scene.cameras, 1)
    corners = one.vertices(0).numpy()
    centre = -(corners.max(0) + corners.min(0)) / 2
    extrinsics = np.eye(4)
    extrinsics[:3, :3], extrinsics[:3, 3] = FLIP, moved - FLIP @ centre
    return pose.reshape(72).numpy(), shift + centre, extrinsics


def write_vid2avatar(folder: Path, scene: Scene, camera: int = 0) -> Path:
    k4 = np.eye(4)
    k4[:3, :3] = scene.cameras[camera][0]
    poses, shifts, views = zip(*(centred(scene, camera, t) for t in range(len(scene.poses))), strict=True)
    radius = 1.1 * max(np.linalg.norm(v[:3, :3].T @ v[:3, 3]) for v in views)
    scale = np.diag([radius / 3] * 3 + [1]).astype("f4")
    for t in range(len(poses)):
        image, mask = scene.image(camera, t)
        save_image(folder / "image" / f"{t:04d}.png", image)
        save_image(folder / "mask" / f"{t:04d}.png", mask)
    np.save(folder / "poses.npy", np.stack(poses))
    np.save(folder / "normalize_trans.npy", np.stack(shifts))
    np.save(folder / "mean_shape.npy", scene.betas.numpy())
    worlds = {t: k4 @ v for t, v in enumerate(views)}
    np.savez(folder / "cameras.npz", **{f"cam_{t}": m for t, m in worlds.items()})
    np.savez(
        folder / "cameras_normalize.npz",
        **{f"world_mat_{t}": m for t, m in worlds.items()}, **{f"scale_mat_{t}": scale for t in worlds},
    )  # fmt: skip
    return folder


def write_hdf5(folder: Path, scene: Scene, kind: str = "vid2avatar", cut: int = 8, every: int = 3) -> Path:
    """The training file and those of novel views and poses beside it; returns the first."""
    import h5py

    others = range(1, len(scene.cameras))
    parts = {
        "training": [(0, t) for t in range(cut)],
        "novel_view": [(c, t) for t in range(0, cut, every) for c in others],
        "novel_pose": [(c, t) for t in range(cut, len(scene.poses)) for c in others],
    }
    folder.mkdir(parents=True, exist_ok=True)
    for part, shown in parts.items():
        with h5py.File(folder / f"377_{part}.h5", "w") as file:
            for name, array in {**hdf5_images(scene, shown, kind), **HDF5_KINDS[kind](scene, shown)}.items():
                rows = name in ("images", "imgs", "masks", "masks_samp")
                array = array if array.dtype.kind in "uS" else array.astype("f4" if array.dtype.kind == "f" else "i8")
                packed = {"chunks": (1, *array.shape[1:]), "compression": "gzip"} if rows else {}
                file.create_dataset(name, data=array, **packed)
    return folder / "377_training.h5"


def hdf5_images(scene, shown, kind):
    images, masks = zip(*(scene.image(c, t) for c, t in shown), strict=True)
    n, pixels = len(shown), scene.size**2
    mask = (np.stack(masks) > 0).astype(np.uint8).reshape(n, pixels, 1)
    return {
        "imgs" if kind == "npc" else "images": np.stack(images).reshape(n, pixels, 3),
        "masks": mask,
        "img_shape": np.array([n, scene.size, scene.size, 3], np.int32),
        "frames_name": np.array([f"{t:06d}_{c}.jpg".encode() for c, t in shown], "S32"),
    }


def hdf5_vid2avatar(scene, shown):
    found = [centred(scene, c, t) for c, t in shown]
    k4 = np.eye(4)
    products = []
    for (c, _), (_, _, view) in zip(shown, found, strict=True):
        k4[:3, :3] = scene.cameras[c][0]
        products.append(k4 @ view)
    return {
        "cameras": np.stack(products), "scales": np.stack([np.eye(4)] * len(shown)),
        "mean_shape": scene.betas.numpy(), "normalize_trans": np.stack([shift for _, shift, _ in found]),
        "poses": np.stack([pose for pose, _, _ in found]), "joints": np.stack([joints(scene, *f[:2]) for f in found]),
    }  # fmt: skip


def joints(scene, pose, shift):
    transforms = joint_transforms(scene.rest_joints, torch.from_numpy(pose.reshape(24, 3)), torch.from_numpy(shift))
    return ((transforms[:, :3, :3] @ scene.rest_joints[:, :, None])[..., 0] + transforms[:, :3, 3]).numpy()


def hdf5_humannerf(scene, shown):
    found = [centred(scene, c, t) for c, t in shown]
    k4 = [np.pad(scene.cameras[c][0], (0, 1)) + np.diag([0, 0, 0, 1]) for c, _ in shown]
    poses = np.stack([pose for pose, _, _ in found])
    turns = poses[:, :3].copy()
    poses[:, :3] = 0
    rest = (scene.rest_joints - scene.joint).numpy()
    return {
        "cameras_K": np.stack(k4), "cameras_E": np.stack([view for _, _, view in found]), "meshes_Rh": turns,
        "meshes_Th": np.stack([shift + scene.joint.numpy() for _, shift, _ in found]), "meshes_pose": poses,
        "meshes_joints": np.stack([rest] * len(shown)), "meshes_tpose_joints": np.stack([rest] * len(shown)),
        "cl_joints": rest, "smpl_shape": scene.betas.numpy(),
    }  # fmt: skip


def hdf5_npc(scene, shown):
    found = [centred(scene, c, t) for c, t in shown]
    skeletons, points = [], []
    for pose, shift, _ in found:
        transforms = joint_transforms(
            scene.rest_joints, torch.from_numpy(pose.reshape(24, 3)), torch.from_numpy(shift)
        ).numpy()
        places = joints(scene, pose, shift)
        bones = np.tile(np.eye(4), (24, 1, 1))
        bones[:, :3, :3], bones[:, :3, 3] = transforms[:, :3, :3], places
        skeletons.append(np.linalg.inv(bones))
        points.append(places)
    n = len(shown)
    flip = np.diag([1.0, -1, -1, 1])
    return {
        "c2ws": np.stack([np.linalg.inv(view) @ flip for _, _, view in found]),
        "focals": np.stack([scene.cameras[c][0][[0, 1], [0, 1]] for c, _ in shown]),
        "centers": np.stack([scene.cameras[c][0][:2, 2] for c, _ in shown]),
        "skts": np.stack(skeletons), "kp3d": np.stack(points), "img_pose_indices": np.arange(n),
        "kp_idxs": np.arange(n),
        "bones": np.repeat(np.stack([pose[None, :3] for pose, _, _ in found]), 24, 1), "betas": np.zeros((0,)),
        "rest_pose": (scene.rest_joints - scene.joint).numpy(), "cyls": np.zeros((n, 5)),
    }  # fmt: skip


HDF5_KINDS = {"vid2avatar": hdf5_vid2avatar, "humannerf": hdf5_humannerf, "npc": hdf5_npc}
