"""From the skeleton of a BVH file to a body: rest poses aligned, sizes matched, standing feet kept.

For each joint the rotation since a reference pose is taken,

$$
R_j = A G_j G_{j,ref}^{-1} B^{-1} S_j
$$

where G are the joint's world rotations in the frame and in the reference pose, A and B turn the file's world and the
reference pose upright (y up, facing +z), and S turns the body's own rest bone onto the reference pose's bone, so that
limbs point exactly where the file's limbs point. The reference is frame 0 where that is a T-pose, else the pose of all
zeros.

Some skeletons have no meaningful zero pose (all bones of LaFAN1 lie along x). There each limb joint's rest frame is
taken from its bone and from the motion itself: knees and elbows bend about one axis, feet stand flat.
"""

import math
from dataclasses import dataclass
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from twofold.body.bvh import Bvh, bvh_frames
from twofold.body.bvh_names import end_of, matched_joints, spine_chain
from twofold.body.bvh_rest import flat_feet_frame, hinge_frame, parent_frame
from twofold.body.foot_contacts import kept_contacts
from twofold.body.motion import UP_AXES, Motion, joint_frames, leg_length, local_poses, up_axis
from twofold.body.skeleton import JOINT_NAMES, PARENTS, ShapedBody
from twofold.errors import TwofoldError
from twofold.geometry.rotations import axis_angle_to_matrix, matrix_to_axis_angle, shortest_turn

INDEX = {name: index for index, name in enumerate(JOINT_NAMES)}

LIMBS = {"hip": "knee", "knee": "ankle", "shoulder": "elbow", "elbow": "wrist"}
"""Limb bones: from the joint that turns them to the joint at their end."""

_FURTHEST = {"hip": 40, "knee": 40, "shoulder": 105, "elbow": 105}
"""Degrees by which a limb of a usable reference pose may differ from the T-pose: legs stand, arms may hang."""

_T_POSE_WITHIN = 20
"""Degrees within which frame 0 has to be a T-pose to be the reference."""

_JUMP = 15
"""Mean change of the limbs' directions, degrees, from a T-pose that was put before a motion to its first frame."""


@dataclass(frozen=True)
class Retargeted:
    """A motion on a body, and how it got there.

    Attributes:
        motion: y up, standing on y = 0 where its feet stand.
        up: which axis points up in the file.
        leg: length of the file's legs (thigh and shin), in the file's unit.
        reference: what was taken for the T-pose, in words.
        error: largest angle between a limb of the file and of the body in any frame, degrees.
    """

    motion: Motion
    up: str
    leg: float
    reference: str
    error: float


@dataclass(frozen=True)
class _Source:
    """A file's skeleton in motion; `found` are our joints' indices, `tips` the ends of limb bones and feet."""

    rotations: Float[Tensor, "T J 3 3"]
    positions: Float[Tensor, "T J 3"]
    found: dict[str, int]
    tips: dict[str, int]
    spine: list[int]


def retarget(bvh: Bvh, body: ShapedBody, path: Path | str, up: str | None = None) -> Retargeted:
    """The motion of a BVH file on a body.

    Args:
        bvh: the file.
        body: in the T-pose.
        path: for names and messages.
        up: axis that points up, "y" or "z"; None finds it.

    Raises:
        TwofoldError: joints are missing, the skeleton has no legs to speak of, or no axis points up.
    """
    found = matched_joints(bvh.joints, path)
    tips = _tips(bvh, found, path)
    spine = spine_chain(bvh.joints, found)
    source = _Source(*bvh_frames(bvh.joints, bvh.values), found, tips, spine)
    zero = _Source(*bvh_frames(bvh.joints, torch.zeros_like(bvh.values[:1])), found, tips, spine)
    up = up or _up_axis(source, path)
    upright = torch.tensor(UP_AXES[up], dtype=torch.float64)
    leg = _leg(source, path)
    joints = body.joints.double()

    first = _part(source, slice(0, 1))
    if _furthest(first, joints) < _T_POSE_WITHIN:
        kept = source if len(bvh.values) == 1 or not _jumps(source) else _part(source, slice(1, None))
        words = "frame 0, a T-pose" + (" (left out of the motion)" if kept is not source else "")
        turned = _from_reference(kept, first, joints, upright)
        source = kept
    elif _is_reference(zero, joints):
        words, turned = "the pose of all zeros", _from_reference(source, zero, joints, upright)
    else:
        words, turned = "bones and bending axes (no T-pose)", _from_bones(source, zero, joints, upright)
    motion, toes = _placed(source, turned, joints, upright, leg_length(joints) / leg, str(path), bvh.fps)
    motion = kept_contacts(motion, joints, float(body.vertices[:, 1].min()), toes)
    return Retargeted(motion, up, leg, words, limb_error(source, motion, joints, upright))


def _tips(bvh: Bvh, found: dict[str, int], path: Path | str) -> dict[str, int]:
    tips: dict[str, int] = {}
    for side in ("left", "right"):
        for start, end in LIMBS.items():
            tip = found.get(f"{side}_{end}", end_of(bvh.joints, found[f"{side}_{start}"]))
            if tip is None:
                raise TwofoldError(f"The skeleton in {path} ends at its {side} {start}; expected a bone beyond it.")
            tips[f"{side}_{start}"] = tip
        for start, end in (("ankle", "foot"), ("collar", "shoulder"), ("wrist", "hand")):
            if f"{side}_{start}" in found:
                tip = found.get(f"{side}_{end}", end_of(bvh.joints, found[f"{side}_{start}"]))
                if tip is not None:
                    tips[f"{side}_{start}"] = tip
    return tips


def _part(source: _Source, frames: slice) -> _Source:
    return _Source(source.rotations[frames], source.positions[frames], source.found, source.tips, source.spine)


def _middle(source: _Source) -> Float[Tensor, "T 3"]:
    """Between the hip joints."""
    return (source.positions[:, source.found["left_hip"]] + source.positions[:, source.found["right_hip"]]) / 2


def _shoulders(source: _Source) -> Float[Tensor, "T 3"]:
    return (
        source.positions[:, source.found["left_shoulder"]] + source.positions[:, source.found["right_shoulder"]]
    ) / 2


def _up_axis(source: _Source, path: Path | str) -> str:
    up = up_axis(_shoulders(source) - _middle(source))
    if up is None:
        raise TwofoldError(f"In {path} nobody stands upright long enough to tell which axis is up; give --up y or z.")
    return up


def _leg(source: _Source, path: Path | str) -> float:
    """Thigh and shin, mean of both sides, in the file's unit."""
    lengths = [
        (source.positions[0, source.tips[name]] - source.positions[0, source.found[name]]).norm()
        for name in ("left_hip", "left_knee", "right_hip", "right_knee")
    ]
    leg = float(torch.stack(lengths).sum()) / 2
    if leg < 1e-6:
        raise TwofoldError(
            f"The legs of the skeleton in {path} have no length; its OFFSETs are wrong, export it again."
        )
    return leg


def _facing(reference: _Source) -> Float[Tensor, "3 3"]:
    """The rotation that turns a reference pose upright and to +z, from its trunk and hips (B)."""
    left = reference.positions[0, reference.found["left_hip"]] - reference.positions[0, reference.found["right_hip"]]
    spine = reference.spine
    bottom = reference.positions[0, spine[0]] if len(spine) > 1 else _middle(reference)[0]
    up = _straight(_neck(reference) - bottom)
    left = _straight(left - (left @ up) * up)
    left = torch.nn.functional.normalize(left - (left @ up) * up, dim=0)
    return torch.stack([left, up, torch.linalg.cross(left, up)])


def _neck(reference: _Source) -> Float[Tensor, "3"]:
    top = reference.found.get("neck", reference.found.get("head"))
    return _shoulders(reference)[0] if top is None else reference.positions[0, top]


def _straight(vector: Float[Tensor, "3"]) -> Float[Tensor, "3"]:
    """The axis of the file that a direction means: skeletons stand along axes, but spines lean a little."""
    unit = torch.nn.functional.normalize(vector, dim=0)
    largest = int(unit.abs().argmax())
    if unit[largest].abs() < math.cos(math.radians(20)):
        return unit
    axis = torch.zeros_like(unit)
    axis[largest] = unit[largest].sign()
    return axis


def _bones(source: _Source, names: list[str]) -> Float[Tensor, "T B 3"]:
    """Directions of bones, unit."""
    starts, ends = [source.found[n] for n in names], [source.tips[n] for n in names]
    return torch.nn.functional.normalize(source.positions[:, ends] - source.positions[:, starts], dim=-1)


def _limb_names(*kinds: str) -> list[str]:
    return [f"{side}_{start}" for start in (kinds or LIMBS) for side in ("left", "right")]


def _rest_bones(joints: Float[Tensor, "24 3"], names: list[str]) -> Float[Tensor, "B 3"]:
    ends = [INDEX[n.replace(n.partition("_")[2], LIMBS[n.partition("_")[2]])] for n in names]
    return torch.nn.functional.normalize(joints[ends] - joints[[INDEX[n] for n in names]], dim=-1)


def _angles(a: Tensor, b: Tensor) -> Tensor:
    """Degrees between directions."""
    return torch.atan2(torch.linalg.cross(a, b.expand_as(a), dim=-1).norm(dim=-1), (a * b).sum(-1)).rad2deg()


def _furthest(reference: _Source, joints: Float[Tensor, "24 3"]) -> float:
    """Largest angle between a limb of a reference pose and of the T-pose, degrees."""
    names = _limb_names()
    return float(_angles(_bones(reference, names)[0] @ _facing(reference).T, _rest_bones(joints, names)).max())


def _is_reference(zero: _Source, joints: Float[Tensor, "24 3"]) -> bool:
    angles = {
        kind: _angles(_bones(zero, _limb_names(kind))[0] @ _facing(zero).T, _rest_bones(joints, _limb_names(kind)))
        for kind in LIMBS
    }
    return all(float(angles[kind].max()) < _FURTHEST[kind] for kind in LIMBS)


def _jumps(source: _Source) -> bool:
    directions = _bones(source, _limb_names())
    return float(_angles(directions[1], directions[0]).mean()) > _JUMP


def _from_reference(
    source: _Source, reference: _Source, joints: Float[Tensor, "24 3"], upright: Float[Tensor, "3 3"]
) -> Float[Tensor, "T 24 3 3"]:
    """World rotations of all joints from the change since a reference pose."""
    facing = _facing(reference)
    names = _limb_names()
    turns = shortest_turn(_rest_bones(joints, names), _bones(reference, names)[0] @ facing.T)
    aligned = dict(zip(names, turns, strict=True))
    for side in ("left", "right"):
        aligned[f"{side}_wrist"] = aligned[f"{side}_hand"] = aligned[f"{side}_elbow"]
    eye = torch.eye(3, dtype=torch.float64)
    turned: dict[int, Tensor] = {}
    for name, joint in source.found.items():
        change = upright @ source.rotations[:, joint] @ reference.rotations[0, joint].T @ facing.T
        turned[INDEX[name]] = change @ aligned.get(name, eye)
    changes = [upright @ source.rotations[:, j] @ reference.rotations[0, j].T @ facing.T for j in source.spine]
    return _filled(turned, changes)


def _from_bones(
    source: _Source, zero: _Source, joints: Float[Tensor, "24 3"], upright: Float[Tensor, "3 3"]
) -> Float[Tensor, "T 24 3 3"]:
    """World rotations of all joints where no reference pose is known.

    The trunk's are taken as from the zero pose (a spine lies straight there), the limbs' from their bones and from how
    they bend in the motion.
    """
    facing = _facing(zero)
    turned = {
        INDEX[name]: upright @ source.rotations[:, source.found[name]] @ facing.T
        for name in ("pelvis", "neck", "head")
        if name in source.found
    }
    spine = [upright @ source.rotations[:, j] @ facing.T for j in source.spine]
    chest = spine[-1] if spine else turned[0]
    world = upright @ source.rotations
    for side in ("left", "right"):
        above = turned[0]
        for upper, lower in (("hip", "knee"), ("shoulder", "elbow")):
            names = [f"{side}_{upper}", f"{side}_{lower}"]
            if upper == "shoulder":
                above = _with_parent(source, f"{side}_collar", world, chest, joints, upright, turned)
            bones = _bones(source, names) @ upright.T
            for i, name in enumerate(names):
                rest = _rest_bones(joints, [name])[0]
                frame = hinge_frame(world[:, source.found[name]], bones, bones[:, i], rest, upper, side, above)
                turned[INDEX[name]] = above = world[:, source.found[name]] @ frame
            if upper == "hip" and f"{side}_ankle" in source.tips:
                ankle, tip = source.found[f"{side}_ankle"], source.tips[f"{side}_ankle"]
                heights = source.positions[:, [ankle, tip]] @ upright.T
                rest = joints[INDEX[f"{side}_foot"]] - joints[INDEX[f"{side}_ankle"]]
                frame = flat_feet_frame(world[:, ankle], heights, rest, leg_length(joints) / _leg(source, "the file"))
                turned[INDEX[f"{side}_ankle"]] = world[:, ankle] @ frame
                if f"{side}_foot" in source.found:
                    toes = world[:, source.found[f"{side}_foot"]]
                    turned[INDEX[f"{side}_foot"]] = toes @ parent_frame(toes, None, rest, world[:, ankle] @ frame)
            elif upper == "shoulder":
                _with_parent(source, f"{side}_wrist", world, above, joints, upright, turned)
    return _filled(turned, spine)


def _with_parent(
    source: _Source, name: str, world: Float[Tensor, "T J 3 3"], above: Float[Tensor, "T 3 3"],
    joints: Float[Tensor, "24 3"], upright: Float[Tensor, "3 3"], turned: dict[int, Tensor],
) -> Float[Tensor, "T 3 3"]:  # fmt: skip
    """A joint that hardly turns against its parent on average (collar, wrist), put into `turned`."""
    if name not in source.found:
        return above
    end = {"collar": "shoulder", "wrist": "hand"}[name.partition("_")[2]]
    rest = joints[INDEX[f"{name.partition('_')[0]}_{end}"]] - joints[INDEX[name]]
    bone = _bones(source, [name])[:, 0] @ upright.T if name in source.tips else None
    turned[INDEX[name]] = world[:, source.found[name]] @ parent_frame(world[:, source.found[name]], bone, rest, above)
    return turned[INDEX[name]]


def _filled(turned: dict[int, Tensor], spine: list[Tensor]) -> Float[Tensor, "T 24 3 3"]:
    """All 24 world rotations: the spine's three from however many there are, others without a source as the parent."""
    full = dict(turned)
    if spine:
        full[3] = spine[0] if len(spine) > 1 else _halfway(turned[0], spine[0])
        middle = (len(spine) - 1) / 2
        full[6] = _halfway(spine[math.floor(middle)], spine[math.ceil(middle)])
        full[9] = spine[-1]
    for joint, parent in enumerate(PARENTS):
        if joint not in full:
            full[joint] = full[parent]
    return torch.stack([full[joint] for joint in range(24)], 1)


def _halfway(a: Float[Tensor, "T 3 3"], b: Float[Tensor, "T 3 3"]) -> Float[Tensor, "T 3 3"]:
    return a @ axis_angle_to_matrix(matrix_to_axis_angle(a.transpose(-1, -2) @ b) / 2)


def _placed(
    source: _Source, turned: Float[Tensor, "T 24 3 3"], joints: Float[Tensor, "24 3"], upright: Float[Tensor, "3 3"],
    scale: float, path: str, fps: float,
) -> tuple[Motion, Float[Tensor, "T 2 3"]]:  # fmt: skip
    """The motion with the middle of the hips on the source's scaled path, and the scaled paths of its toes."""
    rest_middle = (joints[1] + joints[2]) / 2 - joints[0]
    middle = _middle(source) @ upright.T * scale
    translations = middle - (turned[:, 0] @ rest_middle) - joints[0]
    ends = [source.tips.get(f"{side}_ankle", source.found[f"{side}_ankle"]) for side in ("left", "right")]
    toes = source.positions[:, ends] @ upright.T * scale
    return Motion(Path(path).stem, local_poses(turned), translations, fps), toes


def limb_error(source: _Source, motion: Motion, joints: Float[Tensor, "24 3"], upright: Float[Tensor, "3 3"]) -> float:
    """Largest angle between a limb of the file, by its own forward kinematics, and of the body, degrees."""
    names = _limb_names()
    rotations, _ = joint_frames(joints, motion)
    rest = _rest_bones(joints, names)
    ours = (rotations[:, [INDEX[n] for n in names]] @ rest[..., None])[..., 0]
    return float(_angles(ours, _bones(source, names) @ upright.T).max())
