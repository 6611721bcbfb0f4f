"""HumanNeRF's prepared folders, of ZJU-MoCap and of videos, and MonoHuman's variant with one folder for each camera.

Images and masks are called after frames; `cameras.pkl` and `mesh_infos.pkl` have an entry for each, or, before
HumanNeRF's preparation, `metadata.json` has. Of ZJU-MoCap the body is placed about the model's origin and images have
lens distortion; of videos it is placed about the pelvis, and each frame has a camera of its own.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from twofold.body.skeleton import Body
from twofold.capture.readers.body_placement import as_rows, from_model_origin, from_pelvis
from twofold.capture.readers.sequence import (
    ReadOptions,
    Sequence3D,
    SourceCamera,
    SourceImage,
    at_rest,
    camera_of,
    image_from_files,
    mean_betas,
    numbers,
    require_radians,
    same_camera,
)
from twofold.capture.readers.shape_fit import fit_betas, require_joints
from twofold.capture.readers.zju_files import require_shapes, root_joint
from twofold.capture.readers.zju_raw import subject_of
from twofold.errors import TwofoldError
from twofold.inputs import is_there, read_json
from twofold.pickles import as_dict, read_pickle

CAMERAS, MESHES, METADATA, IMAGES, MASKS = "cameras.pkl", "mesh_infos.pkl", "metadata.json", "images", "masks"
_ENDINGS = (".png", ".jpg", ".jpeg")
_CENTRED = 1e-3
"""Metres: rest joints whose pelvis is closer to the origin were moved there."""
_MAX_JSON = 256 * 2**20


@dataclass(frozen=True)
class _View:
    """One folder: the frames of one camera, as they are stored."""

    folder: Path
    names: tuple[str, ...]
    cameras: tuple[SourceCamera, ...]
    poses: Float[Tensor, "t 24 3"]
    translations: Float[Tensor, "t 3"]
    betas: Float[Tensor, "S"]
    about_origin: bool


def recognizes(folder: Path) -> bool:
    """Whether it looks like one."""
    return _is_view(folder) or bool(_views(folder))


def _is_view(folder: Path) -> bool:
    described = is_there(folder / CAMERAS) or is_there(folder / MESHES) or is_there(folder / METADATA)
    return described and is_there(folder / IMAGES)


def _views(folder: Path) -> list[Path]:
    """Folders of single cameras, in the order of their numbers."""
    if not folder.is_dir():
        return []
    found = [entry for entry in folder.iterdir() if entry.name.isdecimal() and len(entry.name) < 5]
    return sorted((entry for entry in found if _is_view(entry)), key=lambda entry: int(entry.name))


def read(folder: Path, options: ReadOptions) -> Sequence3D:
    """Reads cameras and motion, and notes where the images lie.

    Raises:
        TwofoldError: a file is missing or damaged, or of another body than the one named.
    """
    remarks: list[str] = []
    places = [folder] if _is_view(folder) else _views(folder)
    views = [_read_view(place, options, remarks) for place in places]
    names = sorted({name for view in views for name in view.names})
    poses, translations, betas = _one_motion(views, names)
    cameras: dict[str, SourceCamera] = {}
    images: dict[tuple[str, int], SourceImage] = {}
    single = len(views) == 1
    lost = 0
    for view in views:
        at = {name: place for place, name in enumerate(view.names)}
        for frame, name in enumerate(names):
            if name not in at:
                continue
            camera = _camera_name(cameras, view.cameras[at[name]], "cam" if single else f"cam_{view.folder.name}")
            image = _file(view.folder / IMAGES, name)
            mask = _file(view.folder / MASKS, name)
            if image is not None and mask is not None:
                images[camera, frame] = image_from_files(image, [mask], labels=False)
            else:
                lost += 1
    if lost:
        remarks.append(f"{lost} images of {folder.name} have no mask in {MASKS} and are left out.")
    if not images:
        raise TwofoldError(f"{views[0].folder / MASKS} has no mask of any image ({names[0]}.png and so on); get them.")
    of_zju = views[0].about_origin
    return Sequence3D(
        name=folder.resolve().name, reader="humannerf", betas=betas, poses=poses, translations=translations,
        cameras=cameras, images=images, subject=subject_of(folder) if of_zju else "", total=len(names),
        gravity=of_zju, frame_names=names, remarks=remarks,
        notes={"body_placed_about": "the model's origin" if of_zju else "the pelvis"},
    )  # fmt: skip


def _camera_name(cameras: dict[str, SourceCamera], camera: SourceCamera, stem: str) -> str:
    """The name under which a camera is known, which may have been new; several of one view are numbered."""
    same = [name for name in cameras if name == stem or name.startswith(f"{stem}_lens")]
    for name in reversed(same):
        if same_camera(cameras[name], camera):
            return name
    name = stem if not same else f"{stem}_lens{len(same) + 1}"
    cameras[name] = camera
    return name


def _one_motion(
    views: Sequence[_View], names: Sequence[str]
) -> tuple[Float[Tensor, "t 24 3"], Float[Tensor, "t 3"], Float[Tensor, "S"]]:
    """The motion that all views share."""
    first = {name: (view, place) for view in reversed(views) for place, name in enumerate(view.names)}
    chosen = [first[name] for name in names]
    poses = torch.stack([view.poses[place] for view, place in chosen])
    translations = torch.stack([view.translations[place] for view, place in chosen])
    index = {name: frame for frame, name in enumerate(names)}
    for view in views[1:]:
        shared = [(index[name], place) for place, name in enumerate(view.names) if name in index]
        for frame, place in shared:
            off = (view.translations[place] - translations[frame]).abs().max()
            off = torch.maximum(off, (view.poses[place, 1:] - poses[frame, 1:]).abs().max())
            if float(off) > 1e-3:
                raise TwofoldError(
                    f"{view.folder} and {views[0].folder} have different poses in frame {names[frame]}; give folders "
                    "that were prepared from one recording, or convert one of them alone."
                )
    return poses, translations, views[0].betas


def _read_view(folder: Path, options: ReadOptions, remarks: list[str]) -> _View:
    names = _stems(folder / IMAGES)
    if not names:
        raise TwofoldError(f"{folder / IMAGES} has no images; expected one for each frame, such as frame_000000.png.")
    if is_there(folder / CAMERAS) or is_there(folder / MESHES):
        return _from_pickles(folder, names, options.body, remarks)
    return _from_metadata(folder, names, options.body, remarks)


def _from_pickles(folder: Path, names: list[str], body: Body, remarks: list[str]) -> _View:
    views = _entries(folder / CAMERAS, names, "cameras of HumanNeRF")
    meshes = _entries(folder / MESHES, names, "body parameters of HumanNeRF")
    cameras = [
        camera_of(
            _key(entry, "intrinsics", folder / CAMERAS, name), _key(entry, "extrinsics", folder / CAMERAS, name),
            entry.get("distortions"), f"{folder / CAMERAS}, frame {name}",
        )
        for name, entry in zip(names, views, strict=True)
    ]  # fmt: skip
    shapes = {"Rh": (3,), "Th": (3,), "poses": (72,), "tpose_joints": (24, 3)}
    columns = {
        key: _column(meshes, names, key, shape, folder / MESHES) for key, shape in shapes.items()
    }  # fmt: skip
    require_radians(columns["poses"], folder / MESHES)
    require_radians(columns["Rh"], folder / MESHES)
    rest = torch.from_numpy(columns["tpose_joints"].mean(0))
    if any("beats" in entry for entry in meshes):
        given = _column(meshes, names, "beats", (None,), folder / MESHES)
        betas = torch.from_numpy(mean_betas(given, remarks))
        require_shapes(body, len(betas), folder / MESHES)
        require_joints(body, betas, rest, folder / MESHES)
    else:
        betas = fit_betas(body, rest, folder / MESHES)
        remarks.append(f"{folder.name} stores no betas; they are fitted to its rest joints.")
    about_origin = float(rest[0].norm()) > _CENTRED
    place = from_model_origin if about_origin else from_pelvis
    poses = as_rows(torch.from_numpy(columns["poses"]))
    root, translations = place(
        torch.from_numpy(columns["Rh"]), torch.from_numpy(columns["Th"]), poses[:, 0], root_joint(body, betas)
    )
    poses = torch.cat([root[:, None], poses[:, 1:]], 1)
    return _resting(folder, names, cameras, poses, translations, betas, body, about_origin)


def _from_metadata(folder: Path, names: list[str], body: Body, remarks: list[str]) -> _View:
    """The file that HumanNeRF's preparation of videos starts from: SMPL's own placement, translation zero."""
    where = folder / METADATA
    content = read_json(where, _MAX_JSON)
    if not isinstance(content, dict):
        raise TwofoldError(f"{where} should hold an object with an entry for each frame; get the file again.")
    entries = [_entry(content, name, where) for name in names]
    cameras = [
        camera_of(
            _key(entry, "cam_intrinsics", where, name), _key(entry, "cam_extrinsics", where, name), None,
            f"{where}, frame {name}",
        )
        for name, entry in zip(names, entries, strict=True)
    ]  # fmt: skip
    flat = [{key: _unwrapped(entry.get(key)) for key in ("poses", "betas")} for entry in entries]
    flat = [{key: value for key, value in entry.items() if value is not None} for entry in flat]
    poses = _column(flat, names, "poses", (72,), where)
    require_radians(poses, where)
    betas = torch.from_numpy(mean_betas(_column(flat, names, "betas", (None,), where), remarks))
    require_shapes(body, len(betas), where)
    rows = as_rows(torch.from_numpy(poses))
    return _resting(folder, names, cameras, rows, torch.zeros(len(names), 3).double(), betas, body, False)


def _unwrapped(value: Any) -> Any:
    """MonoHuman's variant has poses and betas in one more list."""
    return value[0] if isinstance(value, list) and len(value) == 1 and isinstance(value[0], list) else value


def _resting(
    folder: Path,
    names: Sequence[str],
    cameras: Sequence[SourceCamera],
    poses: Float[Tensor, "t 24 3"],
    translations: Float[Tensor, "t 3"],
    betas: Float[Tensor, "S"],
    body: Body,
    about_origin: bool,
) -> _View:
    """A view whose camera stands still; where each frame has its own, the body moves instead."""
    views = torch.from_numpy(np.stack([camera.world_to_camera for camera in cameras]))
    if float((views - views[0]).abs().max()) > 1e-6:
        rest, poses, translations = at_rest(views, poses, translations, root_joint(body, betas))
        cameras = [SourceCamera(c.intrinsics, c.distortion, rest.numpy()) for c in cameras]
    return _View(folder, tuple(names), tuple(cameras), poses, translations, betas, about_origin)


def _entries(where: Path, names: Sequence[str], what: str) -> list[dict[str, Any]]:
    content = as_dict(read_pickle(where, what), where, what)
    return [_entry(content, name, where) for name in names]


def _entry(content: Mapping[Any, Any], name: str, where: Path) -> dict[str, Any]:
    entry = content.get(name)
    if not isinstance(entry, dict):
        some = ", ".join(str(key) for key in list(content)[:2]) or "nothing"
        raise TwofoldError(
            f"{where} has no entry for the image {name} (it has {some}, ...); images and file belong to different sets."
        )
    return entry


def _key(entry: Mapping[str, Any], key: str, where: Path, name: str) -> Any:
    if key not in entry:
        raise TwofoldError(f"Frame {name} in {where} lacks {key}; it has {', '.join(map(str, entry)) or 'nothing'}.")
    return entry[key]


def _column(
    entries: Sequence[Mapping[str, Any]], names: Sequence[str], key: str, shape: tuple[int | None, ...], where: Path
) -> Float[np.ndarray, "t ..."]:
    rows = [
        numbers(_key(entry, key, where, name), shape, f"{key} of frame {name}", where)
        for name, entry in zip(names, entries, strict=True)
    ]
    if len({row.shape for row in rows}) > 1:
        raise TwofoldError(f"{key} in {where} has another length in some frames; get the file again.")
    return np.stack(rows)


def _stems(folder: Path) -> list[str]:
    """Names of the images without ending, sorted."""
    if not folder.is_dir():
        return []
    return sorted({entry.stem for entry in folder.iterdir() if entry.suffix.lower() in _ENDINGS})


def _file(folder: Path, stem: str) -> Path | None:
    found = [folder / f"{stem}{ending}" for ending in _ENDINGS]
    return next((file for file in found if is_there(file)), None)
