"""A pose from three-dimensional landmarks without any search: the trunk by registration, each limb by its direction."""

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from twofold.body.skeleton import JOINT_NAMES, PARENTS
from twofold.geometry.rotations import axis_angle_to_matrix, cross_matrix, matrix_to_axis_angle
from twofold.prepare.detections import LANDMARKS
from twofold.prepare.fitting.body_landmarks import BodyPoints

_TRUNK = ("left_shoulder", "right_shoulder", "left_hip", "right_hip")
_LIMBS = tuple(
    (f"{side}_{joint}", f"{side}_{start}", f"{side}_{end}")
    for side in ("left", "right")
    for joint, start, end in (
        ("hip", "hip", "knee"), ("knee", "knee", "ankle"), ("ankle", "heel", "foot_index"),
        ("shoulder", "shoulder", "elbow"), ("elbow", "elbow", "wrist"),
    )
)  # fmt: skip
"""Joint to turn, and the two landmarks between which its bone runs."""

_BENDS = {"shoulder": ("elbow", "wrist", 1.0), "hip": ("knee", "ankle", -1.0)}
"""Joints whose twist shows where the next one bends: that one's landmarks, and which way along z in the T-pose."""


def register(
    source: Float[Tensor, "t n 3"], target: Float[Tensor, "t n 3"], weight: Float[Tensor, "t n"]
) -> Float[Tensor, "t 3 3"]:
    """Rotations that bring points onto others best after their weighted means are taken off (Kabsch)."""
    share = (weight / weight.sum(1, keepdim=True).clamp_min(1e-9))[..., None]
    source = source - (share * source).sum(1, keepdim=True)
    target = target - (share * target).sum(1, keepdim=True)
    u, _, v = torch.linalg.svd((share * target).transpose(1, 2) @ source)
    flip = torch.ones(len(u), 3, dtype=u.dtype)
    flip[:, 2] = torch.linalg.det(u @ v)
    return u * flip[:, None] @ v


def first_pose(
    points: BodyPoints, landmarks: Float[Tensor, "t 33 3"]
) -> tuple[Float[Tensor, "t 3 3"], Float[Tensor, "t 23 3"], Bool[Tensor, "t"]]:
    """Root rotations, poses of the other joints (axis-angle), and for which frames there was anything to go by.

    Args:
        points: of the body.
        landmarks: in the world, metres about any centre; NaN where unknown. A frame without a trunk takes the
            rotation of the nearest one that has it; a limb without landmarks hangs as in the T-pose.
    """
    chosen = [LANDMARKS.index(name) for name in _TRUNK]
    seen = landmarks.isfinite().all(-1)
    known = seen[:, chosen].all(1)
    if not bool(known.any()):
        identity = torch.eye(3, dtype=landmarks.dtype).expand(len(landmarks), 3, 3)
        return identity, torch.zeros(len(landmarks), 23, 3, dtype=landmarks.dtype), known
    rest = points.place.to(landmarks)
    root = torch.zeros(len(landmarks), 3, 3, dtype=landmarks.dtype)
    there = landmarks[known][:, chosen]
    root[known] = register(rest[chosen].expand_as(there), there, torch.ones(there.shape[:2], dtype=there.dtype))
    times = torch.arange(len(landmarks))
    nearest = (times[:, None] - times[known]).abs().argmin(1)
    root = root[known][nearest]
    turns: list[Tensor] = [root] * len(PARENTS)
    local = torch.eye(3, dtype=landmarks.dtype).repeat(len(landmarks), len(PARENTS), 1, 1)
    limbs = {joint: (LANDMARKS.index(start), LANDMARKS.index(end)) for joint, start, end in _LIMBS}
    for j in range(1, len(PARENTS)):
        above = turns[PARENTS[j]]
        turns[j] = above
        if JOINT_NAMES[j] not in limbs:
            continue
        start, end = limbs[JOINT_NAMES[j]]
        wanted = (above.transpose(1, 2) @ (landmarks[:, end] - landmarks[:, start])[..., None])[..., 0]
        usable = seen[:, start] & seen[:, end] & known
        bone = (rest[end] - rest[start]).expand_as(wanted)
        turn = shortest_turns(bone, torch.nan_to_num(wanted))
        side, _, part = JOINT_NAMES[j].partition("_")
        if part in _BENDS:
            middle, tip, sign = _BENDS[part]
            from_, to = (LANDMARKS.index(f"{side}_{name}") for name in (middle, tip))
            further = (above.transpose(1, 2) @ (landmarks[:, to] - landmarks[:, from_])[..., None])[..., 0]
            forward = torch.tensor([0.0, 0.0, sign]).to(bone).expand_as(bone)
            turn = twisted(turn, bone, forward, torch.nan_to_num(wanted), torch.nan_to_num(further))
        local[:, j] = torch.where(usable[:, None, None], turn, local[:, j])
        turns[j] = above @ local[:, j]
    return root, matrix_to_axis_angle(local[:, 1:]), known


def shortest_turns(start: Float[Tensor, "t 3"], end: Float[Tensor, "t 3"]) -> Float[Tensor, "t 3 3"]:
    """The smallest rotations from directions to directions; none where one has no length or they are opposite."""
    start = start / start.norm(dim=-1, keepdim=True).clamp_min(1e-9)
    end = end / end.norm(dim=-1, keepdim=True).clamp_min(1e-9)
    normal, cosine = torch.linalg.cross(start, end), (start * end).sum(-1)
    k = cross_matrix(normal)
    turn = torch.eye(3, dtype=start.dtype) + k + k @ k / (1 + cosine).clamp_min(1e-3)[:, None, None]
    defined = (cosine > -0.99) & (end.norm(dim=-1) > 0.5)
    return torch.where(defined[:, None, None], turn, torch.eye(3, dtype=start.dtype))


def twisted(
    turn: Float[Tensor, "t 3 3"],
    bone: Float[Tensor, "t 3"],
    bend: Float[Tensor, "t 3"],
    wanted: Float[Tensor, "t 3"],
    further: Float[Tensor, "t 3"],
) -> Float[Tensor, "t 3 3"]:
    """Turns of a limb's first joint with the twist that its second joint needs to bend the way it can.

    Args:
        turn: brings `bone` to `wanted`.
        bone: direction of the first bone at rest.
        bend: to where the second bone moves when it bends, at rest.
        wanted: direction of the first bone.
        further: direction of the second bone; nearly straight limbs tell nothing and keep their `turn`.
    """
    axis, plain = _unit(wanted), _unit(further)
    aside = plain - (plain * axis).sum(-1, keepdim=True) * axis
    own = (turn @ bend[..., None])[..., 0]
    own = _unit(own - (own * axis).sum(-1, keepdim=True) * axis)
    target = _unit(aside)
    angle = torch.atan2((torch.linalg.cross(own, target) * axis).sum(-1), (own * target).sum(-1))
    # From straight to bent the twist sets in smoothly.
    angle = angle * ((aside.norm(dim=-1) - 0.15) / 0.3).clamp(0, 1)
    return axis_angle_to_matrix(axis * angle[:, None]) @ turn


def _unit(vector: Float[Tensor, "t 3"]) -> Float[Tensor, "t 3"]:
    return vector / vector.norm(dim=-1, keepdim=True).clamp_min(1e-9)


def first_translation(
    moved: Float[Tensor, "t n 3"],
    pixels: Float[Tensor, "c t n 2"],
    weight: Float[Tensor, "c t n"],
    world_to_camera: Float[Tensor, "c 4 4"],
    intrinsics: Float[Tensor, "c 3 3"],
) -> Float[Tensor, "t 3"]:
    """Shifts after which points project where they are seen, by linear least squares.

    Args:
        moved: the points, turned but not shifted, metres.
        pixels: where they are seen (finite numbers everywhere; those of no weight do not count).
        weight: how much each counts.
        world_to_camera: of each camera.
        intrinsics: pixels.
    """
    # u (r3.x + t3) = fx (r1.x + t1) + cx (r3.x + t3), linear in the shift; the camera's depth is left as a factor.
    rotation, shift = world_to_camera[:, :3, :3], world_to_camera[:, :3, 3]
    seen = torch.einsum("cij,tnj->ctni", rotation, moved) + shift[:, None, None]
    focal = torch.stack([intrinsics[:, 0, 0], intrinsics[:, 1, 1]], -1)
    ray = (pixels - intrinsics[:, None, None, :2, 2]) / focal[:, None, None]
    rows = ray[..., None] * rotation[:, None, None, 2:3] - rotation[:, None, None, :2]
    right = seen[..., :2] - ray * seen[..., 2:]
    rows, right = rows * weight[..., None, None], right * weight[..., None]
    normal = torch.einsum("ctnki,ctnkj->tij", rows, rows)
    normal = normal + 1e-8 * torch.eye(3, dtype=normal.dtype)
    return torch.linalg.solve(normal, torch.einsum("ctnki,ctnk->ti", rows, right))
