"""What a fit makes small: errors of landmarks, directions and outlines, and what is unlike people's motion."""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from twofold.body.skeleton import JOINT_NAMES, Body
from twofold.geometry.accelerations import accelerations
from twofold.geometry.rotations import axis_angle_to_matrix
from twofold.geometry.surfaces import vertex_normals
from twofold.kernels.kdtree import search_tree
from twofold.kernels.parallel import in_parts
from twofold.prepare.fitting.body_landmarks import BodyPoints
from twofold.prepare.fitting.observations import Seen
from twofold.prepare.fitting.outlines import Outlines
from twofold.prepare.fitting.parameters import (
    Chosen,
    FittedMotion,
    Posed,
    choose,
    place_joints,
    place_points,
    pose_motion,
)

STIFFNESS = {
    "hip": 0.9, "knee": 1.2, "ankle": 0.35, "foot": 0.1, "spine": 0.35, "neck": 0.3, "collar": 0.25, "head": 0.35,
    "shoulder": 1.0, "elbow": 1.2, "wrist": 0.35, "hand": 0.05,
}  # fmt: skip
"""How far joints turn in everyday motion, radians (standard deviation); hands are not seen well enough to move."""


@dataclass(frozen=True)
class PriorWeights:
    """What is known about people before any image.

    Attributes:
        joint_acceleration: what people's joints reach in quick motion, metres per second squared.
        turn_acceleration: likewise, radians per second squared.
        smoothness: weight of both, per second.
        shape: weight of the shape coefficients' squares.
        marks: how far estimators put landmarks off where they usually mark them, metres.
        focal: how far the focal length may be off its guess (standard deviation of its logarithm).
    """

    joint_acceleration: float = 15.0
    turn_acceleration: float = 80.0
    smoothness: float = 15.0
    shape: float = 0.03
    marks: float = 0.06
    focal: float = 0.15


def project_all(
    points: Float[Tensor, "t n 3"],
    world_to_camera: Float[Tensor, "4 4"],
    intrinsics: Float[Tensor, "3 3"],
    log_focal: Float[Tensor, ""],
) -> Float[Tensor, "t n 2"]:
    """Pixels (column, row) of points; those behind the camera are taken as just before it."""
    in_camera = points @ world_to_camera[:3, :3].T + world_to_camera[:3, 3]
    depth = in_camera[..., 2:].clamp_min(0.1)
    focal = torch.stack([intrinsics[0, 0], intrinsics[1, 1]]) * log_focal.exp()
    return in_camera[..., :2] / depth * focal + intrinsics[:2, 2]


def _robust(squared: Tensor) -> Tensor:
    """Geman and McClure's: quadratic for small errors, at most 1 for large ones."""
    return squared / (1 + squared)


def landmark_term(posed: Posed, points: BodyPoints, motion: FittedMotion, seen: Seen, error: float) -> Tensor:
    """Landmarks beside where they are seen; `error` in percent of the person's height in the image."""
    places = place_points(posed, points, motion)
    loss = places.new_zeros(())
    for k in range(len(seen.pixels)):
        shown = project_all(places, seen.world_to_camera[k], seen.intrinsics[k], motion.log_focal)
        away = (shown - seen.pixels[k]) * (100 / error / seen.size[k])
        # A wide quadratic bowl beside the narrow robust one pulls back what is far off.
        squared = away.square().sum(-1)
        loss = loss + (seen.weight[k] * (_robust(squared) + 0.2 * _robust(squared / 25))).sum(-1).mean()
    return loss


LEAN_BIAS = 0.4
"""Share of a camera's pitch that the estimator does not see: it takes cameras for more level than they are. Measured on
images of synthetic subjects (`python -m benchmarks.landmark_offsets`)."""


def estimator_tilt(slope: Float[Tensor, "2"]) -> Float[Tensor, "3 3"]:
    r"""Rotation that corrects the estimator's landmarks in space for the pitch that it does not see.

    \[ R = \exp\big( -0.4 \arctan(s_z) \, [e_x]_\times \big) \]

    >>> estimator_tilt(torch.zeros(2)).tolist()
    [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]
    """
    angle = -LEAN_BIAS * slope[1].atan()
    return axis_angle_to_matrix(torch.stack([angle, torch.zeros_like(angle), torch.zeros_like(angle)]))


_BONES = (
    (11, 13), (13, 15), (12, 14), (14, 16), (23, 25), (25, 27), (24, 26), (26, 28), (11, 12), (23, 24), (11, 23),
    (12, 24), (29, 31), (30, 32), (7, 8), (7, 0), (8, 0),
)  # fmt: skip
"""Pairs of landmarks with a direction worth knowing."""


def direction_term(posed: Posed, points: BodyPoints, motion: FittedMotion, seen: Seen, error: float) -> Tensor:
    """Bones that run another way than the estimator's; `error` as the length of the difference of unit vectors."""
    places = place_points(posed, points, motion)
    start, end = (torch.tensor([bone[side] for bone in _BONES]) for side in (0, 1))
    own = torch.nn.functional.normalize(places[:, end] - places[:, start], dim=-1)
    loss = places.new_zeros(())
    for k in range(len(seen.space)):
        other = torch.nn.functional.normalize(seen.space[k][:, end] - seen.space[k][:, start], dim=-1)
        other = other @ estimator_tilt(motion.slope).T
        weight = seen.space_weight[k][:, end] * seen.space_weight[k][:, start]
        if len(seen.space) == len(seen.weight):
            weight = weight * (seen.weight[k][:, end] * seen.weight[k][:, start]).sqrt()
        squared = (own - other).square().sum(-1) / error**2
        loss = loss + (weight * _robust(squared / 2)).sum(-1).mean()
    return loss / len(seen.space)


def prior(
    body: Body,
    posed: Posed,
    motion: FittedMotion,
    fps: float,
    weights: PriorWeights,
    offsets: Float[Tensor, "33 3"] | None = None,
    seconds: Float[Tensor, "t"] | None = None,
) -> Tensor:
    """How unlike people's shapes, poses and motion this is; `offsets` are the estimator's usual ones.

    `seconds` tells when each frame was seen, where the times are not even.
    """
    spread = motion.pose.new_tensor([STIFFNESS[name.split("_")[-1].rstrip("123")] for name in JOINT_NAMES[1:]])
    loss = 0.05 * (motion.pose / spread[:, None]).square().sum((1, 2)).mean()
    loss = loss + 2.0 * _limits(motion.pose).mean()
    joints = place_joints(posed, body, motion)
    if len(motion) > 2:
        # Small bodies move less; without their height taken out, a guess about it would win by shrinking the person.
        height = posed.vertices[:, 1].amax() - posed.vertices[:, 1].amin()
        change = accelerations(joints, fps, seconds) * (1.7 / height / weights.joint_acceleration)
        turns = torch.cat([motion.root[:, None], motion.pose], 1)
        turning = accelerations(turns, fps, seconds) / weights.turn_acceleration
        # The motion's own smoothness is one piece of evidence per second, each image one per frame.
        weight = weights.smoothness / fps
        loss = loss + weight * (_gentle(change) + _gentle(turning))
    loss = loss + weights.shape * motion.betas.square().sum()
    marks = motion.marks if offsets is None else motion.marks - offsets
    loss = loss + (marks / weights.marks).square().sum() / 3
    return loss + (motion.log_focal / weights.focal).square()


def _gentle(change: Float[Tensor, "t n 3"]) -> Tensor:
    """Quadratic for what is usual, linear for the quick."""
    squared = change.square().sum(-1)
    return ((1 + squared).sqrt() - 1).mean() * 2


def _limits(pose: Float[Tensor, "t 23 3"]) -> Float[Tensor, "t"]:
    """How far knees and elbows bend the wrong way or sideways, radians squared, summed."""
    loss = pose.new_zeros(len(pose))
    for side, sign in (("left", 1.0), ("right", -1.0)):
        knee, elbow = (pose[:, JOINT_NAMES.index(f"{side}_{joint}") - 1] for joint in ("knee", "elbow"))
        loss = loss + (-knee[:, 0]).clamp_min(0).square() * 20 + (knee[:, 1:] / 0.25).square().sum(-1) * 0.3
        loss = loss + (knee[:, 0] - 2.6).clamp_min(0).square() * 20
        # In the T-pose a bent left elbow turns about -y, a right one about +y.
        bend = -sign * elbow[:, 1]
        loss = loss + (-bend).clamp_min(0).square() * 20 + (bend - 2.6).clamp_min(0).square() * 20
        loss = loss + (elbow[:, 2] / 0.4).square() * 0.3
    return loss


def match_rims(
    body: Body, motion: FittedMotion, seen: Seen, k: int, outlines: Outlines, searched: Chosen
) -> tuple[Chosen, Float[Tensor, "t p"]]:
    """For each point of a mask's outline the vertex on the body's rim that belongs there, and whether any does."""
    with torch.no_grad():
        posed = pose_motion(body, motion)
        camera = seen.world_to_camera[k]
        places = posed.place(searched)
        shown = project_all(places, camera, seen.intrinsics[k], motion.log_focal)
        rest = vertex_normals(posed.vertices, body.faces)[searched.index]
        matrices = (searched.weights @ posed.transforms[:, :, :3].flatten(2)).unflatten(-1, (3, 4))
        normals = (matrices[..., :3] * rest[:, None]).sum(-1) @ camera[:3, :3].T
        rays = places @ camera[:3, :3].T + camera[:3, 3]
        across = (normals * rays).sum(-1) / (rays.norm(dim=-1) * normals.norm(dim=-1)).clamp_min(1e-9)
        # A rim that looks another way counts as a tenth of the person's height farther off.
        scale = 0.1 * float(seen.size[k])
        found = torch.zeros(outlines.points.shape[:2], dtype=torch.int64)
        weight = torch.zeros(outlines.points.shape[:2])

        def match(begin: int, end: int) -> None:
            for t in range(begin, end):
                rim = torch.nonzero(across[t].abs() < 0.35)[:, 0]
                if len(rim) == 0 or not outlines.known[t]:
                    continue
                flat = torch.nn.functional.normalize(normals[t, rim, :2], dim=-1)
                tree = search_tree(torch.cat([shown[t, rim], flat * scale], -1).numpy(), quick=True)
                away, index = tree.query(torch.cat([outlines.points[t], outlines.normals[t] * scale], -1).numpy())
                found[t] = rim[torch.from_numpy(index)]
                weight[t] = torch.from_numpy(away < 1.5 * scale).float()

        in_parts(len(found), match, 8, long=True)
        weight = weight * (outlines.normals.norm(dim=-1) > 0.5)
    return choose(body, searched.index[found]), weight


def outline_term(
    posed: Posed,
    motion: FittedMotion,
    seen: Seen,
    k: int,
    outlines: Outlines,
    rims: Chosen,
    weight: Float[Tensor, "t p"],
    skin: Chosen,
    error: float,
) -> Tensor:
    """How far the body's rim is from the mask's outline, and its skin outside the mask; `error` in percent."""
    scale = 100 / error / seen.size[k]
    rim = project_all(posed.place(rims), seen.world_to_camera[k], seen.intrinsics[k], motion.log_focal)
    along = ((rim - outlines.points) * outlines.normals).sum(-1) * scale
    shown = project_all(posed.place(skin), seen.world_to_camera[k], seen.intrinsics[k], motion.log_focal)
    beyond = outlines.away(shown) * scale
    return (weight * _robust(along.square())).mean() + (outlines.known[:, None] * _robust(beyond.square())).mean()
