"""Where the landmarks of a person sit on a body model, whichever model it is."""

from collections.abc import Callable
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from twofold.body.skeleton import JOINT_NAMES, Body
from twofold.prepare.detections import LANDMARKS


@dataclass(frozen=True)
class BodyPoints:
    """Points that ride on the joints' frames, in the order of `LANDMARKS`.

    Attributes:
        joint: whose frame carries each point.
        place: in the T-pose of the mean shape, metres.
        basis: change per unit of each shape coefficient, metres.
    """

    joint: Int[Tensor, "33"]
    place: Float[Tensor, "33 3"]
    basis: Float[Tensor, "33 3 S"]


def body_points(body: Body) -> BodyPoints:
    """The landmarks of a body in SMPL's T-pose: joints for the limbs, places on the skin for face and feet.

    Estimators mark no joint exactly; what is left over is fitted (see `twofold.prepare.fitting.fit`).
    """
    vertices, joints = body.template, body.joints
    place = torch.zeros(len(LANDMARKS), 3)
    basis = torch.zeros(len(LANDMARKS), 3, body.shape_basis.shape[-1])
    carrier = torch.zeros(len(LANDMARKS), dtype=torch.int64)

    def put(name: str, joint: str, at: Tensor, change: Tensor) -> None:
        k = LANDMARKS.index(name)
        place[k], basis[k], carrier[k] = at, change, JOINT_NAMES.index(joint)

    def on_skin(name: str, joint: str, vertex: int) -> None:
        put(name, joint, vertices[vertex], body.shape_basis[vertex])

    head = _region(body, "head")
    middle = joints[[JOINT_NAMES.index("left_shoulder"), JOINT_NAMES.index("right_shoulder")], 0].mean()
    aside = (vertices[:, 0] - middle).abs()
    nose = _extreme(vertices, head & (aside < aside[head].min() + 0.02), lambda v: v[:, 2])
    height = vertices[nose, 1]
    on_skin("nose", "head", nose)
    for side, sign in (("left", 1.0), ("right", -1.0)):
        for name, across, up in ((f"{side}_eye_inner", 0.018, 0.036), (f"{side}_eye", 0.032, 0.036),
                                 (f"{side}_eye_outer", 0.045, 0.034), (f"mouth_{side}", 0.025, -0.035)):  # fmt: skip
            target = torch.stack([middle + sign * across, height + up])
            on_skin(name, "head", _front_of(vertices, head, target))
        level = (vertices[:, 1] - height).abs() < 0.03
        on_skin(f"{side}_ear", "head", _extreme(vertices, head & level, lambda v, s=sign: s * v[:, 0]))
        for part in ("shoulder", "elbow", "wrist", "hip", "knee", "ankle"):
            j = JOINT_NAMES.index(f"{side}_{part}")
            put(f"{side}_{part}", f"{side}_{part}", joints[j], body.joint_basis[j])
        wrist, hand = (JOINT_NAMES.index(f"{side}_{part}") for part in ("wrist", "hand"))
        # Palms face down in the T-pose, thumbs forward.
        for finger, along, forward in (("index", 1.0, 0.022), ("pinky", 0.9, -0.035), ("thumb", 0.6, 0.045)):
            at = joints[wrist] + along * (joints[hand] - joints[wrist]) + forward * joints.new_tensor([0.0, 0.0, 1.0])
            change = body.joint_basis[wrist] + along * (body.joint_basis[hand] - body.joint_basis[wrist])
            put(f"{side}_{finger}", f"{side}_wrist", at, change)
        foot = _region(body, f"{side}_ankle", f"{side}_foot")
        sole = foot & (vertices[:, 1] < vertices[foot, 1].min() + 0.05)
        on_skin(f"{side}_heel", f"{side}_ankle", _extreme(vertices, sole, lambda v: -v[:, 2]))
        on_skin(f"{side}_foot_index", f"{side}_ankle", _extreme(vertices, sole, lambda v: v[:, 2]))
    return BodyPoints(carrier, place, basis)


def _region(body: Body, *names: str) -> Bool[Tensor, "V"]:
    """The vertices that follow some joints most; where a body has none, those that are nearest to them."""
    chosen = [JOINT_NAMES.index(name) for name in names]
    follows = body.weights[:, chosen].sum(1) > 0.5
    if bool(follows.any()):
        return follows
    away = torch.cdist(body.template, body.joints)
    return away[:, chosen].amin(1) <= torch.maximum(away.amin(1), away[:, chosen].min())


def _extreme(vertices: Float[Tensor, "V 3"], where: Bool[Tensor, "V"], along: Callable[[Tensor], Tensor]) -> int:
    """The vertex that is farthest along some direction among those of a region."""
    return int(along(vertices).masked_fill(~where, -torch.inf).argmax())


def _front_of(vertices: Float[Tensor, "V 3"], where: Bool[Tensor, "V"], target: Float[Tensor, "2"]) -> int:
    """The foremost vertex of a region near a place (x, y) seen from the front."""
    away = (vertices[:, :2] - target).norm(dim=1)
    near = where & (away < torch.clamp(away[where].min(), min=0.0) + 0.012)
    return int(vertices[:, 2].masked_fill(~near, -torch.inf).argmax())
