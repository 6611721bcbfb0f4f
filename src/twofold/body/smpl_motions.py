"""Motions of the SMPL family in npz files: SMPL, AMASS (SMPL+H and SMPL-X), AIST++, captures of this program."""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from twofold.body.foot_contacts import kept_contacts
from twofold.body.leg_ik import TOES
from twofold.body.motion import Motion, evenly_timed, joint_frames, leg_length, turned_upright, up_axis
from twofold.body.skeleton import Body, ShapedBody, shape_body
from twofold.errors import TwofoldError
from twofold.geometry.rotations import axis_angle_to_matrix, matrix_to_axis_angle
from twofold.npz import not_increasing, read_npz

SMPL_LEG = 0.78
"""Thigh and shin of SMPL's mean body, metres; where a file's body is not known, its legs are taken to be so long."""

_STRAY = 0.05
"""Metres that a resting foot seems to move where the legs that moved are not known; it is then held still."""

_LARGEST_ANGLE = 9.5
"""Radians that an axis-angle vector may have (three half turns); degrees reach far more."""

_HIGHEST_PELVIS, _FURTHEST_PELVIS = 12.0, 200.0
"""Metres above the floor (stairs, towers), and over it, that no recorded pelvis goes beyond."""


@dataclass(frozen=True)
class Layout:
    """What a kind of npz calls its arrays.

    Attributes:
        name: of the format.
        poses: arrays that together are the pose, in order, each (T, n) or of any shape that flattens to it.
        translations: names of the translation, the first one there counts.
        rates: names of the frame rate.
        columns: how many numbers a frame's pose has; of more than 72, the first 66 are the body.
        up: axis that points up where the motion does not tell.
        fps: frame rate where the file has none.
    """

    name: str
    poses: tuple[str, ...]
    translations: tuple[str, ...]
    rates: tuple[str, ...]
    columns: tuple[int, ...]
    up: str
    fps: float


_MATRICES = (216, 198)
_RATES = ("mocap_framerate", "mocap_frame_rate", "fps", "frame_rate", "framerate")

LAYOUTS = (
    Layout("AMASS SMPL-X (stage II)", ("poses",), ("trans",), _RATES, (165,), "z", 120.0),
    Layout("AMASS SMPL-X (stage II)", ("root_orient", "pose_body"), ("trans",), _RATES, (66,), "z", 120.0),
    Layout("AMASS SMPL+H", ("poses",), ("trans",), _RATES, (156,), "z", 120.0),
    Layout("AIST++", ("smpl_poses",), ("smpl_trans",), _RATES, (72,), "y", 60.0),
    Layout("capture", ("poses",), ("translations",), _RATES, (72,), "y", 30.0),
    Layout("SMPL", ("poses",), ("trans", "transl"), _RATES, (72, 66, *_MATRICES), "y", 30.0),
    Layout("SMPL", ("global_orient", "body_pose"), ("transl", "trans"), _RATES, (72, 66, *_MATRICES), "y", 30.0),
)
"""The npz formats; the first one whose pose arrays are there in the right size is taken."""


@dataclass(frozen=True)
class SmplMotion:
    """A motion from an npz, on a body, and what was found: see `MotionRead` for the fields."""

    motion: Motion
    layout: str
    frames: int
    up: str
    units: str
    notes: tuple[str, ...]


def read_smpl_motion(
    path: Path | str, body: ShapedBody, model: Body | None = None, up: str | None = None, units: str | None = None
) -> SmplMotion:
    """A motion from an npz of the SMPL family, on a body: poses as they are, the path scaled to the body's legs.

    Args:
        path: the file; nothing in it is ever unpickled.
        body: who is to move, in the T-pose.
        model: the body model; where it is SMPL, the file's betas tell how long the legs were that moved.
        up: axis that points up in the file; None finds it.
        units: of the translations, "m" or "cm"; None takes metres.

    Raises:
        TwofoldError: the file is missing, damaged, no motion, or in other units than it should be.
    """
    path = Path(path)
    arrays = _plain_arrays(path)
    layout = _layout(arrays, path)
    poses = _poses(arrays, layout, path)
    frames, notes = len(poses), list[str]()
    fps, seconds = _rate(arrays, layout, path), _seconds(arrays, layout, frames, path)
    if fps is None and seconds is None:
        fps = layout.fps
        notes.append(f"the file has no frame rate ({', '.join(_RATES[:3])}), {fps:g} fps was taken")
    translations = _translations(arrays, layout, frames, units, path)
    if translations is None:
        notes.append("the file has no translations, the body stays in place")
    betas = arrays.get("betas")
    betas = (
        None if betas is None or betas.dtype.kind not in "fiu" else torch.from_numpy(betas.astype(np.float64)).ravel()
    )
    place = torch.zeros(frames, 3, dtype=torch.float64) if translations is None else translations
    motion = Motion(path.stem, poses, place, fps or layout.fps, betas)
    if seconds is not None:
        motion = evenly_timed(motion, seconds)
        notes.append(
            f"its frames were taken at a varying rate, on average {motion.fps:.4g} fps, and are resampled to that"
        )
    found = up or up_axis(axis_angle_to_matrix(poses[:, 0])[..., 1])
    if found is None:
        found = layout.up
        notes.append(
            f"nobody stands upright long enough to tell the up axis, {found} was taken as usual in {layout.name}"
        )
    joints = body.joints.double()
    motion = turned_upright(motion, found, joints[0])
    _require_heights(motion, joints, units, path)
    name = layout.name
    if translations is None:
        motion = _dropped(motion, body)
    elif layout.name != "capture":
        motion = _scaled(motion, body, model)
    unit = {"m": "metres", "cm": "centimetres", None: "metres"}[units]
    return SmplMotion(motion, name, frames, found, unit, tuple(notes))


def _seconds(arrays: dict[str, np.ndarray], layout: Layout, frames: int, path: Path) -> Float[np.ndarray, "T"] | None:
    """When the frames of a capture's motion were taken, where it says so."""
    if layout.name != "capture" or "seconds" not in arrays:
        return None
    seconds = arrays["seconds"]
    fits = seconds.dtype.kind in "fiu" and seconds.shape == (frames,) and bool(np.isfinite(seconds).all())
    if not fits or not_increasing(seconds):
        raise TwofoldError(f"{path}: seconds should be {frames} increasing numbers, one for each frame.")
    return seconds.astype(np.float64)


def _plain_arrays(path: Path) -> dict[str, np.ndarray]:
    """The arrays of numbers that some layout names; whatever else the file holds is not opened."""
    wanted = {name for layout in LAYOUTS for name in (*layout.poses, *layout.translations, *layout.rates)}
    wanted |= {"betas", "smpl_scaling", "seconds"}
    return read_npz(path, wanted)


def _layout(arrays: dict[str, np.ndarray], path: Path) -> Layout:
    sizes: list[str] = []
    for layout in LAYOUTS:
        if not all(name in arrays for name in layout.poses):
            continue
        parts = [arrays[name] for name in layout.poses]
        count = sum(p[0].size for p in parts if p.ndim > 1 and len(p))
        columns = layout.columns if "trans" in layout.translations or layout.translations[0] in arrays else ()
        if count in columns:
            return layout
        sizes.append(f"{' + '.join(layout.poses)} has {count} numbers a frame (shape {parts[0].shape})")
    if sizes:
        raise TwofoldError(
            f"{sizes[-1]} in {path}, expected 72 (SMPL, 24 joints), 156 (SMPL+H), 165 (SMPL-X), 66 (body alone) or "
            "216 (24 rotation matrices); it is of another body or has a wrong joint count."
        )
    raise TwofoldError(
        f"{path} holds no motion: expected poses (T, 72) and trans (T, 3), AMASS's or AIST++'s arrays; name a motion "
        "file (AMASS's shape.npz holds none)."
    )


def _poses(arrays: dict[str, np.ndarray], layout: Layout, path: Path) -> Float[Tensor, "T 24 3"]:
    """Axis-angle poses of 24 joints; hands and what else there is stay at rest."""
    label = " + ".join(layout.poses)
    for name in layout.poses:
        if arrays[name].dtype.kind not in "fiu" or len({len(arrays[n]) for n in layout.poses}) > 1:
            raise TwofoldError(f"{name} in {path} should be numbers, a row a frame; it is {arrays[name].dtype}.")
        _require_finite(arrays[name], name, path)
    flat = np.concatenate([arrays[n].reshape(len(arrays[n]), -1) for n in layout.poses], 1).astype(np.float64)
    numbers = torch.from_numpy(flat)
    if flat.shape[1] in _MATRICES:
        matrices = numbers.unflatten(1, (-1, 3, 3))
        wrong = (matrices @ matrices.transpose(-1, -2) - torch.eye(3)).abs().amax()
        if wrong > 0.02 or (torch.linalg.det(matrices) < 0).any():
            raise TwofoldError(
                f"{label} in {path} should hold rotation matrices (R R^T = I), it differs by {float(wrong):.2g}; "
                "give (T, 24, 3, 3) matrices or (T, 72) axis-angle vectors."
            )
        vectors = matrix_to_axis_angle(matrices)
    else:
        vectors = numbers[:, : 72 if flat.shape[1] == 72 else 66].unflatten(1, (-1, 3))
    largest = float(vectors.norm(dim=-1).max())
    if largest > _LARGEST_ANGLE:
        raise TwofoldError(
            f"Rotations of {label} in {path} reach {largest:.3g}, expected axis-angle vectors in radians (up to 3.14); "
            "they look like degrees, convert them with np.radians."
        )
    rest = torch.zeros(len(vectors), 24 - vectors.shape[1], 3, dtype=torch.float64)
    return torch.cat([vectors, rest], 1)


def _require_finite(array: np.ndarray, name: str, path: Path) -> None:
    if not np.isfinite(array).all():
        frame = int(np.argwhere(~np.isfinite(array))[0][0])
        raise TwofoldError(f"{name} in {path} holds NaN or infinity in frame {frame}; repair or leave out that frame.")


def _rate(arrays: dict[str, np.ndarray], layout: Layout, path: Path) -> float | None:
    name = next((name for name in layout.rates if name in arrays), None)
    if name is None:
        return None
    value = arrays[name]
    if value.size != 1 or value.dtype.kind not in "fiu" or not 0.1 <= float(value.reshape(-1)[0]) <= 10_000:
        raise TwofoldError(
            f"{name} in {path} should be frames per second (30, 120), it is {value.ravel()[:3].tolist()}."
        )
    return float(value.reshape(-1)[0])


def _translations(
    arrays: dict[str, np.ndarray], layout: Layout, frames: int, units: str | None, path: Path
) -> Float[Tensor, "T 3"] | None:
    """In metres; None where there are none."""
    name = next((name for name in layout.translations if name in arrays), None)
    if name is None:
        return None
    array = arrays[name]
    if array.ndim > 2:
        array = array.reshape(len(array), -1)
    if array.shape != (frames, 3) or array.dtype.kind not in "fiu":
        raise TwofoldError(
            f"{name} in {path} should have the shape ({frames}, 3), a row a frame; it has {array.shape}."
        )
    _require_finite(array, name, path)
    scaled = torch.from_numpy(array.astype(np.float64)) * (0.01 if units == "cm" else 1.0)
    scaling = arrays.get("smpl_scaling")
    if layout.name == "AIST++" and scaling is not None and scaling.size == 1 and scaling.dtype.kind in "fiu":
        scaled = scaled / float(scaling.reshape(-1)[0])
    return scaled


def _require_heights(motion: Motion, joints: Float[Tensor, "24 3"], units: str | None, path: Path) -> None:
    """Translations that no person makes are of another unit."""
    path_of_pelvis = motion.translations + joints[0]
    height = float(path_of_pelvis[:, 1].abs().median())
    width = float((path_of_pelvis.amax(0) - path_of_pelvis.amin(0)).max())
    if height > _HIGHEST_PELVIS or width > _FURTHEST_PELVIS:
        given = "centimetres (--units cm)" if units == "cm" else "metres"
        advice = "give metres" if units == "cm" else "if they are centimetres, give --units cm"
        raise TwofoldError(
            f"Translations in {path} put the pelvis {height:.3g} m high and {width:.3g} m apart, expected {given} with "
            f"a pelvis about 1 m above the floor; {advice}."
        )
    if units == "cm" and height < 0.05 and width < 0.05:
        raise TwofoldError(
            f"With --units cm the pelvis in {path} stays within {100 * width:.2g} cm, {100 * height:.2g} cm above the "
            "floor; its translations are metres already, leave --units out."
        )


def _scaled(motion: Motion, body: ShapedBody, model: Body | None) -> Motion:
    """The path scaled from the legs that moved to the body's, standing feet kept."""
    joints = body.joints.double()
    if model is not None and model.name == "smpl" and motion.betas is not None:
        count = min(len(motion.betas), model.shape_basis.shape[-1])
        source, still = shape_body(model, motion.betas[:count].float()).joints.double(), 0.0
    else:
        # Nobody knows the source's skeleton: the target's own, at the size of SMPL's mean body.
        source, still = joints[0] + (joints - joints[0]) * (SMPL_LEG / leg_length(joints)), _STRAY
    scale = leg_length(joints) / leg_length(source)
    _, positions = joint_frames(source, motion)
    toes = positions[:, list(TOES)] * scale
    rest_middle, own_middle = ((j[1] + j[2]) / 2 - j[0] for j in (source, joints))
    roots = axis_angle_to_matrix(motion.poses[:, 0].double())
    middle = (motion.translations + source[0] + roots @ rest_middle) * scale
    moved = replace(motion, translations=middle - roots @ own_middle - joints[0])
    return kept_contacts(moved, joints, float(body.vertices[:, 1].min()), toes, still)


def _dropped(motion: Motion, body: ShapedBody) -> Motion:
    """The motion with its lower foot on the floor in every frame."""
    joints = body.joints.double()
    _, positions = joint_frames(joints, motion)
    rise = float(joints[list(TOES), 1].mean()) - float(body.vertices[:, 1].min())
    lower = positions[:, list(TOES), 1].amin(1) - rise
    return replace(motion, translations=motion.translations - lower[:, None] * torch.tensor([0.0, 1.0, 0.0]))
