"""The unknowns of a fit, and what a body with given unknowns looks like in every frame at once.

Poses are relative to SMPL's T-pose. The root's rotation is a small turn on top of a first guess, because people who
face the camera stand half a turn away from the camera's axes, where axis-angle vectors jump.
"""

from dataclasses import dataclass, field, replace

import torch
from jaxtyping import Float, Int
from torch import Tensor

from twofold.body.skeleton import Body, joint_transforms
from twofold.geometry.rotations import axis_angle_to_matrix, matrix_to_axis_angle, rigid_transform
from twofold.prepare.fitting.body_landmarks import BodyPoints


@dataclass(frozen=True)
class FittedMotion:
    """A body through a clip; tensors to be optimised.

    Attributes:
        guess: first guess of the root's rotation, fixed.
        root: turn on top of `guess`, axis-angle, radians.
        pose: the other joints, axis-angle, radians.
        translation: SMPL's own (the root turns about its rest joint, then this is added), metres, while
            `log_distance` is 0.
        betas: shape coefficients.
        marks: by how much the estimator's landmarks lie off the body's, in the carrying joint's frame, metres.
        log_focal: natural logarithm of the factor by which the focal length differs from the first guess.
        log_distance: likewise of the distance from the world's origin, where the one camera of a clip stands.
        slope: of the vertical against the camera's axes, along x and z; zeros where nothing in the clip tells it.
    """

    guess: Float[Tensor, "t 3 3"]
    root: Float[Tensor, "t 3"]
    pose: Float[Tensor, "t 23 3"]
    translation: Float[Tensor, "t 3"]
    betas: Float[Tensor, "S"]
    marks: Float[Tensor, "33 3"]
    log_focal: Float[Tensor, ""]
    log_distance: Float[Tensor, ""]
    slope: Float[Tensor, "2"] = field(default_factory=lambda: torch.zeros(2))

    def __len__(self) -> int:
        return len(self.root)

    def __getitem__(self, times: slice) -> "FittedMotion":
        return replace(
            self, guess=self.guess[times], root=self.root[times], pose=self.pose[times],
            translation=self.translation[times],
        )  # fmt: skip

    def full_pose(self) -> Float[Tensor, "t 24 3"]:
        """Axis-angle rotations as a capture stores them, root first, radians."""
        root = matrix_to_axis_angle(axis_angle_to_matrix(self.root) @ self.guess)
        return torch.cat([root[:, None], self.pose], 1)

    def settled(self, body: Body) -> "FittedMotion":
        """The same motion with the distance told by the translations."""
        root = body.joints[0] + body.joint_basis[0, :, : len(self.betas)] @ self.betas
        moved = (root + self.translation) * self.log_distance.exp() - root
        return replace(self, translation=moved, log_distance=torch.zeros_like(self.log_distance))

    def detached(self) -> "FittedMotion":
        """The same numbers, to start another optimisation from."""
        return FittedMotion(**{name: value.detach().clone() for name, value in vars(self).items()})


@dataclass(frozen=True)
class Posed:
    """A moving body, ready to place any of its points.

    Attributes:
        transforms: from the T-pose to the world, one for each joint and frame.
        vertices: T-pose vertices of this shape, metres.
    """

    transforms: Float[Tensor, "t 24 4 4"]
    vertices: Float[Tensor, "V 3"]

    def place(self, chosen: "Chosen") -> Float[Tensor, "t n 3"]:
        """World positions of some vertices, metres."""
        matrices = (chosen.weights @ self.transforms[:, :, :3].flatten(2)).unflatten(-1, (3, 4))
        # Multiplied out: thousands of tiny matrix products are slow.
        places = self.vertices[chosen.index]
        return (matrices[..., :3] * places[..., None, :]).sum(-1) + matrices[..., 3]


@dataclass(frozen=True)
class Chosen:
    """Some vertices of a body, the same in every frame (`n`) or others at each (`t n`).

    Attributes:
        index: which.
        weights: their skinning weights.
    """

    index: Int[Tensor, "*t n"]
    weights: Float[Tensor, "*t n 24"]


def root_of(body: Body, betas: Float[Tensor, "S"]) -> Float[Tensor, "3"]:
    """Rest position of the root joint of this shape, metres."""
    return body.joints[0] + body.joint_basis[0, :, : len(betas)] @ betas


def choose(body: Body, index: Int[Tensor, "*t n"]) -> Chosen:
    """Vertices by their numbers."""
    return Chosen(index, body.weights[index])


def pose_motion(body: Body, motion: FittedMotion) -> Posed:
    """The body in every frame (pose blend shapes are left out: they are millimetres, the landmarks' error is not)."""
    n = motion.betas.shape[0]
    joints = body.joints + body.joint_basis[..., :n] @ motion.betas
    vertices = body.template + body.shape_basis[..., :n] @ motion.betas
    still = torch.zeros_like(motion.root)
    local = joint_transforms(joints, torch.cat([still[:, None], motion.pose], 1), still)
    rotation = axis_angle_to_matrix(motion.root) @ motion.guess
    shift = (joints[0] + motion.translation) * motion.log_distance.exp() - (rotation @ joints[0])
    return Posed(rigid_transform(rotation, shift)[:, None] @ local, vertices)


def place_points(posed: Posed, points: BodyPoints, motion: FittedMotion) -> Float[Tensor, "t 33 3"]:
    """World positions of the landmarks, with what the estimator puts them off by, metres."""
    n = motion.betas.shape[0]
    rest = points.place + points.basis[..., :n] @ motion.betas + motion.marks
    carried = posed.transforms[:, points.joint]
    return (carried[..., :3, :3] * rest[:, None]).sum(-1) + carried[..., :3, 3]


def place_joints(posed: Posed, body: Body, motion: FittedMotion) -> Float[Tensor, "t 24 3"]:
    """World positions of the joints, metres."""
    n = motion.betas.shape[0]
    joints = body.joints + body.joint_basis[..., :n] @ motion.betas
    return (posed.transforms[..., :3, :3] * joints[:, None]).sum(-1) + posed.transforms[..., :3, 3]
