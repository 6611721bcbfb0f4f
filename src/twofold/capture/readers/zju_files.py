"""The small files that ZJU-MoCap and its refined version share: `annots.npy` and the parameters of each frame."""

import os
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from twofold.body.skeleton import Body, pose_body, shape_body
from twofold.capture.readers.body_placement import as_rows, from_model_origin
from twofold.capture.readers.sequence import SourceCamera, camera_of, mean_betas, numbers, require_radians
from twofold.errors import TwofoldError
from twofold.inputs import is_there
from twofold.npy import read_npy
from twofold.pickles import as_dict

ANNOTATIONS = "annots.npy"
_MAX_OPCODES = 10_000_000
"""Of `annots.npy`: the longest recording names 50,000 images."""
_MAX_FRAMES = 100_000
_MILLIMETRES = 50.0
"""Translations beyond it are millimetres; a camera 50 metres away, or 5 centimetres from the origin, does not occur."""
_SAME_SURFACE = 0.005
"""Metres: vertices made by the same model agree to a tenth of it."""
_ANNOTATIONS_WORDS = "ZJU-MoCap's annotations"
_PARAMETER_WORDS = "SMPL parameters of one frame"


@dataclass(frozen=True)
class Parameters:
    """The motion in parameter files.

    Attributes:
        betas: mean over the frames.
        poses: axis-angle, root first, radians.
        translations: SMPL's own, metres.
        missing: frames without a file, in which the motion repeats its neighbour.
    """

    betas: Float[Tensor, "S"]
    poses: Float[Tensor, "t 24 3"]
    translations: Float[Tensor, "t 3"]
    missing: list[int]


def read_annotations(folder: Path) -> tuple[list[SourceCamera], list[list[str]], list[str]]:
    """Cameras, the relative path of each frame's image of each camera, and remarks.

    Raises:
        TwofoldError: `annots.npy` is damaged or lacks something.
    """
    where = folder / ANNOTATIONS
    content = as_dict(read_npy_large(where), where, _ANNOTATIONS_WORDS)
    for key in ("cams", "ims"):
        if key not in content:
            raise TwofoldError(f"{where} lacks `{key}`; ZJU-MoCap's has `cams` and `ims`. Get the file again.")
    remarks: list[str] = []
    return _cameras(content["cams"], where, remarks), _image_paths(content["ims"], where), remarks


def read_npy_large(where: Path) -> Any:
    """`annots.npy`, which may have many parts."""
    return read_npy(where, _ANNOTATIONS_WORDS, max_opcodes=_MAX_OPCODES)


def _cameras(cams: Any, where: Path, remarks: list[str]) -> list[SourceCamera]:
    if not isinstance(cams, dict) or any(key not in cams for key in "KDRT"):
        raise TwofoldError(f"`cams` in {where} should hold K, D, R and T, one of each for every camera.")
    counts = {key: len(cams[key]) if hasattr(cams[key], "__len__") else 0 for key in "KDRT"}
    if len(set(counts.values())) != 1 or not counts["K"]:
        words = ", ".join(f"{key} {count}" for key, count in counts.items())
        raise TwofoldError(f"`cams` in {where} should have as many K, D, R and T as cameras; it has {words}.")
    shifts = [_column(cams["T"][i], 3, f"T of camera {i}", where) for i in range(counts["T"])]
    millimetres = max(float(np.linalg.norm(shift)) for shift in shifts) > _MILLIMETRES
    if not millimetres:
        remarks.append(f"The translations of the cameras in {where} are metres already, not millimetres.")
    cameras: list[SourceCamera] = []
    for i, shift in enumerate(shifts):
        view = np.eye(4)
        view[:3, :3] = numbers(cams["R"][i], (3, 3), f"R of camera {i}", where)
        view[:3, 3] = shift / 1000 if millimetres else shift
        bent = _column(cams["D"][i], 5, f"D of camera {i}", where)
        cameras.append(camera_of(cams["K"][i], view, bent, f"{where}, camera {i}"))
    return cameras


def _column(value: Any, length: int, what: str, where: Path) -> Float[np.ndarray, "n"]:
    """A vector that may be a row, a column or flat."""
    try:
        flat = np.asarray(value).ravel()
    except ValueError:
        flat = np.asarray([None])
    return numbers(flat, (length,), what, where)


def _image_paths(ims: Any, where: Path) -> list[list[str]]:
    if not isinstance(ims, list) or len(ims) > _MAX_FRAMES:
        raise TwofoldError(f"`ims` in {where} should be a list with one entry a frame, it is {type(ims).__name__}.")
    frames: list[list[str]] = []
    for i, entry in enumerate(ims):
        paths = entry.get("ims") if isinstance(entry, dict) else None
        paths = paths.tolist() if isinstance(paths, np.ndarray) else paths
        if not isinstance(paths, list) or not all(isinstance(path, str) for path in paths):
            raise TwofoldError(f"Frame {i} in {where} should list its images' paths under `ims`; get the file again.")
        for path in paths:
            if os.path.isabs(path) or ".." in re.split(r"[/\\]", path) or "\0" in path:
                raise TwofoldError(f"{where} names the image {path!r}, which lies outside of its folder.")
        frames.append([path.replace("\\", "/") for path in paths])
    return frames


def read_parameters(
    folder: Path, files: Sequence[str], body: Body, vertices: Path | None, remarks: list[str]
) -> Parameters:
    """The motion of every frame.

    Args:
        folder: with one npy file a frame.
        files: their names, frame by frame; one that is missing at the end ends the motion.
        body: whose parameters these are.
        vertices: folder with the posed vertices, by which the first frame is verified; None where there is none.
        remarks: what the user should know is added.

    Raises:
        TwofoldError: a file is damaged, of another model or in other units; or the vertices are not this body's.
    """
    there = [is_there(folder / name) for name in files]
    if not any(there):
        raise TwofoldError(
            f"{folder} has no parameter file of any frame ({', '.join(files[:2])} and so on); get it again."
        )
    count = len(files) - there[::-1].index(True)
    if count < len(files):
        remarks.append(f"{folder} ends {len(files) - count} frames before the images; the rest is left out.")
    rows: list[dict[str, np.ndarray]] = []
    missing: list[int] = []
    for frame in range(count):
        if not there[frame]:
            missing.append(frame)
            continue
        rows.append(read_frame(folder / files[frame]))
    known = [frame for frame in range(count) if there[frame]]
    nearest = np.abs(np.subtract.outer(np.arange(count), known)).argmin(1)
    if missing:
        remarks.append(f"{folder} lacks the parameters of {len(missing)} frames, which are left out.")
    betas = torch.from_numpy(mean_betas(np.stack([row["shapes"] for row in rows]), remarks))
    require_shapes(body, len(betas), folder)
    joint = root_joint(body, betas)
    columns = {key: torch.from_numpy(np.stack([row[key] for row in rows])[nearest]) for key in ("poses", "Rh", "Th")}
    poses = as_rows(columns["poses"])
    root, translations = from_model_origin(columns["Rh"], columns["Th"], poses[:, 0], joint)
    poses = torch.cat([root[:, None], poses[:, 1:]], 1)
    found = Parameters(betas, poses, translations, missing)
    if vertices is not None:
        _verify(found, body, vertices / files[known[0]], known[0], folder, remarks)
    return found


def read_frame(where: Path) -> dict[str, np.ndarray]:
    """`poses` (72), `shapes`, `Rh` and `Th` of one file.

    Raises:
        TwofoldError: it is damaged, of another model, or in degrees.
    """
    content = as_dict(read_npy(where, _PARAMETER_WORDS), where, _PARAMETER_WORDS)
    missing = [key for key in ("poses", "shapes", "Rh", "Th") if key not in content]
    if missing:
        raise TwofoldError(
            f"{where} lacks {', '.join(missing)}; a file of SMPL parameters has poses, shapes, Rh and Th."
        )
    row: dict[str, np.ndarray] = {}
    for key, length in (("poses", 72), ("shapes", None), ("Rh", 3), ("Th", 3)):
        flat = np.asarray(content[key]).ravel() if _is_array(content[key]) else content[key]
        if key == "poses" and isinstance(flat, np.ndarray) and len(flat) != length:
            model = {87: "SMPL-X", 156: "SMPL-H", 165: "SMPL-X", 66: "SMPL-H"}.get(len(flat))
            words = f", as {model} has it" if model else ""
            raise TwofoldError(f"poses in {where} has {len(flat)} numbers{words}, expected SMPL's 72.")
        row[key] = numbers(flat, (length,), key, where)
    require_radians(np.concatenate([row["poses"], row["Rh"]]).reshape(-1, 3), where)
    return row


def _is_array(value: Any) -> bool:
    try:
        return np.asarray(value).dtype != object
    except ValueError:
        return False


def root_joint(body: Body, betas: Float[Tensor, "S"]) -> Float[Tensor, "3"]:
    """Rest position of the root joint of this shape, metres, in double precision."""
    return body.joints[0].double() + body.joint_basis[0].double()[:, : len(betas)] @ betas.double()


def require_shapes(body: Body, count: int, where: object) -> None:
    """Refuses more shape coefficients than the body has.

    Raises:
        TwofoldError: there are more.
    """
    if count > body.shape_basis.shape[-1]:
        raise TwofoldError(
            f"{where} has {count} shape coefficients, the body {body.shape_basis.shape[-1]}; name the SMPL file that "
            "they belong to with --body."
        )


def _verify(found: Parameters, body: Body, file: Path, frame: int, folder: Path, remarks: list[str]) -> None:
    """Compares the posed body with the vertices that the data set's authors made of the same parameters."""
    if not is_there(file):
        return
    theirs = numbers(read_npy(file, "posed vertices"), (None, 3), "vertices", file)
    ours = pose_body(
        shape_body(body, found.betas.float()), found.poses[frame].float(), found.translations[frame].float()
    ).vertices
    if len(theirs) != len(ours):
        raise TwofoldError(
            f"{file} has {len(theirs)} vertices, the body {len(ours)}; name the SMPL file that they were made with "
            "by --body."
        )
    off = float((ours.double() - torch.from_numpy(theirs)).norm(dim=-1).mean())
    if off > _SAME_SURFACE:
        raise TwofoldError(
            f"The parameters in {folder} do not make the vertices in {file.parent}: they are {1000 * off:.0f} mm off. "
            "Either --body is another SMPL file (ZJU-MoCap's is the neutral one), or these are the old parameters "
            "(`params`), which were fitted without pose blend shapes."
        )
    remarks.append(f"The body agrees with {file.parent.name}/{file.name} to {1000 * off:.2f} mm.")
