"""Writers of the results of pose estimators, each exactly in its real format, of one scene before one camera."""

import collections
import json

import joblib
import numpy as np
import torch
from smpl_subject import Scene

from twofold.capture.readers.body_placement import moved_world, to_model_origin
from twofold.geometry.rotations import axis_angle_to_matrix


def in_camera(scene: Scene, camera: int = 0) -> tuple[torch.Tensor, torch.Tensor]:
    """Poses and translations in the camera's axes, SMPL's own placement."""
    view = torch.from_numpy(scene.cameras[camera][1])
    count = len(scene.poses)
    root, moved = moved_world(
        view[:3, :3].expand(count, 3, 3),
        view[:3, 3].expand(count, 3),
        scene.poses[:, 0],
        scene.translations,
        scene.joint,
    )
    return torch.cat([root[:, None], scene.poses[:, 1:]], 1), moved


def beside(translations):
    """Where somebody else stands."""
    return translations + torch.tensor([1.5, 0.0, 0.5]).double()


def write_romp(folder, scene, names, skip=(), ids=False, video=False):
    """An npz file for each image with somebody, or one for a video; a second person in the first half."""
    poses, places = in_camera(scene)
    folder.mkdir(parents=True, exist_ok=True)
    everything = {}
    for t, name in enumerate(names):
        if t in skip:
            continue
        several = t < len(names) // 2
        theta = np.stack([np.zeros(72), poses[t].reshape(72).numpy()] if several else [poses[t].reshape(72).numpy()])
        trans = np.stack([beside(places)[t].numpy(), places[t].numpy()] if several else [places[t].numpy()])
        p = len(theta)
        result = {
            "smpl_thetas": theta.astype("f4"), "global_orient": theta[:, :3].astype("f4"),
            "body_pose": theta[:, 3:].astype("f4"), "cam": np.ones((p, 3), "f4"), "cam_trans": trans.astype("f4"),
            "smpl_betas": np.stack([scene.betas.numpy() + 0.01 * t] * p).astype("f4"),
            "verts": np.zeros((p, 60, 3), "f4"), "joints": np.zeros((p, 71, 3), "f4"),
            "pj2d_org": np.zeros((p, 71, 2), "f4"), "center_confs": np.ones(p, "f4"),
        } | ({"track_ids": np.array([7, 3][-p:])} if ids else {})  # fmt: skip
        everything[f"some/where/{name}.jpg"] = result
        if not video:
            np.savez(folder / f"{name}.npz", results=np.array(result, dtype=object))
    if video or not skip:
        np.savez(
            folder / "video_results.npz", results=np.array(everything, dtype=object), sequence_results=np.array({})
        )
    return folder / "video_results.npz" if video else folder


def write_phalp(path, scene, names, skip=(), compress=3):
    """joblib's file of 4D-Humans: two people, the second one only predicted now and then."""
    poses, places = in_camera(scene)
    content = {}
    for t, name in enumerate(names):
        matrices = axis_angle_to_matrix(poses[t]).numpy().astype("f4")
        smpl = {"global_orient": matrices[:1], "body_pose": matrices[1:], "betas": scene.betas.numpy().astype("f4")}
        camera = places[t].numpy().astype("f4")
        there = 0 if t not in skip else 2
        content[f"outputs/_DEMO/me/img/{name}.jpg"] = {
            "time": t, "shot": 0, "frame_path": name, "tid": [2, 5], "bbox": [np.zeros(4), np.zeros(4)],
            "tracked_time": [there, 0 if t < 3 else 1], "smpl": [smpl, smpl], "camera": [camera, camera + 1],
            "camera_bbox": [camera, camera], "center": [np.zeros(2)] * 2, "scale": [1.0, 1.0],
            "size": [np.array([48, 48])] * 2,
            "conf": [0.9, 0.8], "mask": [[{"size": [48, 48], "counts": b"abc"}]] * 2, "tracked_ids": [2, 5],
        }  # fmt: skip
    joblib.dump(content, path, compress=compress)
    return path


def write_wham(path, scene, skip=()):
    """joblib's file of WHAM: two people by number."""
    poses, places = in_camera(scene)
    kept = [t for t in range(len(poses)) if t not in skip]
    content = collections.defaultdict(dict)
    for person, chosen, shift in ((0, kept[:3], 1.0), (1, kept, 0.0)):
        content[person]["pose"] = poses[chosen].reshape(-1, 72).numpy().astype("f4")
        content[person]["trans"] = places[chosen].numpy().astype("f4") + np.float32(shift)
        content[person]["pose_world"] = content[person]["pose"]
        content[person]["trans_world"] = content[person]["trans"]
        content[person]["betas"] = np.stack([scene.betas.numpy()] * len(chosen)).astype("f4")
        content[person]["verts"] = np.zeros((len(chosen), 60, 3), "f4")
        content[person]["frame_ids"] = np.array(chosen)
    joblib.dump(content, path)
    return path


def write_smplx(path, pelvis=(0.01, -0.35, 0.02)):
    """An SMPL-X model whose pelvis is there for all shapes."""
    regressor = np.zeros((55, 70))
    regressor[:, 0] = 1
    template = np.zeros((70, 3))
    template[0] = pelvis
    np.savez(path, v_template=template, shapedirs=np.zeros((70, 3, 400)), J_regressor=regressor)
    return path


def write_gvhmr(path, scene, pelvis=(0.01, -0.35, 0.02)):
    """torch's file of GVHMR, poses of SMPL-X."""
    poses, places = in_camera(scene)
    count = len(poses)
    incam = {
        "global_orient": poses[:, 0].float(), "body_pose": poses[:, 1:22].reshape(count, 63).float(),
        "betas": torch.zeros(count, 10), "transl": (places + scene.joint - torch.tensor(pelvis)).float(),
    }  # fmt: skip
    k = torch.eye(3).repeat(count, 1, 1)
    k[:, 0, 0] = k[:, 1, 1] = 70.0
    k[:, :2, 2] = 24.0
    content = {
        "smpl_params_incam": incam,
        "smpl_params_global": incam,
        "K_fullimg": k,
        "net_outputs": {"x": torch.ones(9)},
    }
    torch.save(content, path)  # noqa: TID251 - as GVHMR does
    return path


def write_easymocap(folder, scene, root=True, annots=False):
    """A JSON file for each image, two people."""
    poses, places = in_camera(scene)
    folder.mkdir(parents=True, exist_ok=True)
    turns, shifts = to_model_origin(poses[:, 0], places, scene.joint)
    for t in range(len(poses)):
        flat = poses[t].clone()
        flat[0] = 0
        row = flat.reshape(72).tolist()[0 if root else 3 :]
        me = {
            "id": 4,
            "Rh": [turns[t].tolist()],
            "Th": [shifts[t].tolist()],
            "poses": [row],
            "shapes": [scene.betas.tolist()],
        }
        people = [me] if t else [{**me, "id": 9, "Th": [[9.0, 9.0, 9.0]]}, me]
        (folder / f"{t:06d}.json").write_text(json.dumps({"annots": people} if annots else people))
    return folder
