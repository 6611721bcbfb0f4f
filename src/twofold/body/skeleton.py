"""The posed body: joints, forward kinematics, linear blend skinning.

A body goes through three stages. `Body` is what a file holds (template and bases), `ShapedBody` has its shape
coefficients applied, `PosedBody` stands in a pose. SMPL and Anny both end in `PosedBody`, so nothing above knows which
one it was.
"""

import itertools
import math
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.autograd.function import once_differentiable

from twofold.body import kinematics_kernels as kernels
from twofold.body.blending import has_kernel, move_points, skin_vertices, weighted_transforms
from twofold.errors import TwofoldError
from twofold.geometry.rotations import axis_angle_to_matrix, rigid_inverse, rigid_transform
from twofold.npz import are_moderate

JOINT_NAMES = (
    "pelvis", "left_hip", "right_hip", "spine1", "left_knee", "right_knee", "spine2", "left_ankle", "right_ankle",
    "spine3", "left_foot", "right_foot", "neck", "left_collar", "right_collar", "head", "left_shoulder",
    "right_shoulder", "left_elbow", "right_elbow", "left_wrist", "right_wrist", "left_hand", "right_hand",
)  # fmt: skip
PARENTS = (-1, 0, 0, 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 9, 9, 12, 13, 14, 16, 17, 18, 19, 20, 21)
"""SMPL's tree; a parent always comes before its children, and the root's parent is -1."""
_PARENTS = np.array(PARENTS)

_GENERATIONS = (1, 4, 7, 10, 15, 18, 20, 22, 24)
"""Joints equally far from the root stand together in SMPL's order; here each such group begins (and the last ends)."""

MIN_SIZE, MAX_SIZE = 0.3, 3.0
"""How far a body reaches along its longest axis, metres: newborns and giants are people, other units are not."""

_SHAPES: dict[str, tuple[str | int, ...]] = {
    "template": ("V", 3), "faces": ("F", 3), "weights": ("V", 24), "joints": (24, 3),
    "shape_basis": ("V", 3, "S"), "joint_basis": (24, 3, "S"), "pose_basis": ("V", 3, "P"),
}  # fmt: skip


@dataclass(frozen=True)
class Body:
    """A statistical body in SMPL's T-pose: y up, facing +z, its left hand at +x, arms level.

    Attributes:
        name: "smpl", "anny" or a name of the user's.
        template: mean vertices, metres.
        faces: triangles, counter-clockwise from outside.
        weights: skinning weights, rows sum to 1.
        joints: mean joints, metres.
        shape_basis: change of the vertices per unit of each shape coefficient, metres.
        joint_basis: the same for the joints.
        pose_basis: SMPL's pose blend shapes, metres per element of (R_j - I), or no columns where a body has none.
    """

    name: str
    template: Float[Tensor, "V 3"]
    faces: Int[Tensor, "F 3"]
    weights: Float[Tensor, "V 24"]
    joints: Float[Tensor, "24 3"]
    shape_basis: Float[Tensor, "V 3 S"]
    joint_basis: Float[Tensor, "24 3 S"]
    pose_basis: Float[Tensor, "V 3 P"]

    @staticmethod
    def names() -> tuple[str, ...]:
        """What the arrays of a body are called."""
        return tuple(f.name for f in fields(Body))

    def arrays(self) -> dict[str, np.ndarray]:
        """Every array by its name, as a capture or a run stores it; `from_arrays` reads it back."""
        tensors = {f.name: getattr(self, f.name) for f in fields(self) if f.name != "name"}
        return {"name": np.array(self.name), **{key: value.cpu().numpy() for key, value in tensors.items()}}

    @staticmethod
    def from_arrays(arrays: "dict[str, np.ndarray]", where: str = "the body's arrays") -> "Body":
        """A body from the arrays that `arrays` gave.

        Raises:
            TwofoldError: an array is missing, has a wrong shape, or holds something that is no finite number; or see
                `require_surface`.
        """
        names = Body.names()
        missing = [name for name in names if name not in arrays]
        if missing:
            raise TwofoldError(f"{where} lacks {', '.join(missing)}; expected {', '.join(names)}.")
        numbers = {name: np.asarray(arrays[name]) for name in names if name != "name"}
        sizes: dict[str, int] = {}
        for name, shape in _SHAPES.items():
            array = numbers[name]
            for axis, size in zip(shape, array.shape, strict=False):
                if isinstance(axis, str):
                    sizes.setdefault(axis, size)
            expected = tuple(sizes.get(axis, axis) if isinstance(axis, str) else axis for axis in shape)
            if array.shape != expected:
                raise TwofoldError(f"{name} in {where} should have the shape {expected}, it has {array.shape}.")
            if array.dtype.kind not in "fiu" or not are_moderate(array):
                raise TwofoldError(f"{name} in {where} holds something that is no finite number; make the body again.")
        if sizes["P"] not in (0, 207):
            raise TwofoldError(f"pose_basis in {where} should have 207 columns or none, it has {sizes['P']}.")
        require_surface(numbers["template"], numbers["faces"], numbers["weights"], where)
        tensors = {n: torch.as_tensor(a.astype(np.float32)) for n, a in numbers.items() if n != "faces"}
        return Body(name=str(arrays["name"]), faces=torch.as_tensor(numbers["faces"].astype(np.int64)), **tensors)


def require_surface(
    vertices: np.ndarray, faces: np.ndarray, weights: np.ndarray, where: str, called: str = "template"
) -> None:
    """Refuses a surface that no person has, on which training would crash or ask for endless memory.

    Args:
        vertices: in the rest pose, metres, finite.
        faces: triangles.
        weights: skinning weights, one row a vertex, finite.
        where: what holds them.
        called: the vertices' name there.

    Raises:
        TwofoldError: there are no vertices or faces, faces name others, weights are negative or do not sum to 1, or
            the body is smaller or larger than people are.
    """
    if not len(vertices) or not len(faces):
        raise TwofoldError(f"{where} has no vertices or no faces; make the body again.")
    if faces.min() < 0 or faces.max() >= len(vertices):
        raise TwofoldError(f"faces in {where} name vertices outside 0..{len(vertices) - 1}; the file is damaged.")
    if weights.min() < 0:
        raise TwofoldError(
            f"weights in {where} should not be negative, the least is {weights.min():.3g}; make the body again."
        )
    sums = weights.sum(1, dtype=np.float64)
    worst = int(np.abs(sums - 1).argmax())
    if abs(sums[worst] - 1) > 1e-3:
        raise TwofoldError(
            f"Each row of weights in {where} should sum to 1, row {worst} sums to {sums[worst]:.4g}; divide the rows "
            "by their sums."
        )
    size = size_fault(vertices)
    if size:
        raise TwofoldError(f"{called} in {where} {size}; give metres.")


def size_fault(vertices: np.ndarray) -> str:
    """How a body with these vertices (metres) is no person's size, to end a sentence; empty where it is."""
    longest = float(np.ptp(vertices, axis=0).max())
    if MIN_SIZE <= longest <= MAX_SIZE:
        return ""
    return f"should make a body of {MIN_SIZE:g} to {MAX_SIZE:g} metres, it measures {longest:.3g}"


@dataclass(frozen=True)
class ShapedBody:
    """One person's body in the T-pose; see `Body` for the fields."""

    vertices: Float[Tensor, "V 3"]
    joints: Float[Tensor, "24 3"]
    faces: Int[Tensor, "F 3"]
    weights: Float[Tensor, "V 24"]
    pose_basis: Float[Tensor, "V 3 P"]


@dataclass(frozen=True)
class PosedBody:
    """A body in one pose, beside itself in the canonical pose.

    Attributes:
        vertices: posed, world, metres.
        canonical_vertices: in the canonical pose (T-pose, legs apart), metres.
        faces: triangles.
        weights: skinning weights.
        bones: transforms from canonical to posed space, one a joint (B_i of Eq. 1).
        joints: posed joints, world, metres.
        pose: the axis-angle rotations that made it, root first, radians.
    """

    vertices: Float[Tensor, "V 3"]
    canonical_vertices: Float[Tensor, "V 3"]
    faces: Int[Tensor, "F 3"]
    weights: Float[Tensor, "V 24"]
    bones: Float[Tensor, "24 4 4"]
    joints: Float[Tensor, "24 3"]
    pose: Float[Tensor, "24 3"]


def canonical_pose(dtype: torch.dtype = torch.float32, device: torch.device | str = "cpu") -> Float[Tensor, "24 3"]:
    """The pose of canonical space: all zero but the hips, turned by 30 degrees so that the legs stand apart."""
    pose = torch.zeros(24, 3, dtype=dtype, device=device)
    pose[1, 2], pose[2, 2] = math.pi / 6, -math.pi / 6
    return pose


def shape_body(body: Body, betas: Float[Tensor, "n"]) -> ShapedBody:
    """Template plus shape coefficients (as many as given, at most the body's own number)."""
    n = betas.shape[0]
    return ShapedBody(
        vertices=body.template + body.shape_basis[..., :n] @ betas,
        joints=body.joints + body.joint_basis[..., :n] @ betas,
        faces=body.faces,
        weights=body.weights,
        pose_basis=body.pose_basis,
    )


def joint_transforms(
    joints: Float[Tensor, "24 3"], pose: Float[Tensor, "*b 24 3"], translation: Float[Tensor, "*b 3"]
) -> Float[Tensor, "*b 24 4 4"]:
    """Where each joint's frame goes from the T-pose to the world: forward kinematics down SMPL's tree.

    The root turns about its own rest joint and `translation` is added afterwards, SMPL's own convention. The result
    acts on points of the T-pose (it is already relative to the rest joints).

    Where `has_kernel` says so it is one compiled loop, differentiable once.
    """
    if has_kernel(joints, pose, translation) and pose.shape[:-2] == translation.shape[:-1]:
        return _Kinematics.apply(joints, pose, translation)  # type: ignore[return-value]
    return joint_transforms_of_rotations(joints, axis_angle_to_matrix(pose), translation)


def joint_transforms_of_rotations(
    joints: Float[Tensor, "24 3"], rotations: Float[Tensor, "*b 24 3 3"], translation: Float[Tensor, "*b 3"]
) -> Float[Tensor, "*b 24 4 4"]:
    """`joint_transforms` of a pose given as rotation matrices, root first."""
    if has_kernel(joints, rotations, translation) and rotations.shape[:-3] == translation.shape[:-1]:
        return _Kinematics.apply(joints, rotations, translation)  # type: ignore[return-value]
    rest = joints.unbind()
    above = torch.stack([rest[parent] for parent in PARENTS[1:]])
    offsets = (joints[1:] - above).expand(*translation.shape[:-1], 23, 3)
    offsets = torch.cat([(joints[0] + translation)[..., None, :], offsets], -2)
    local = rigid_transform(rotations, offsets)
    chain = [local[..., 0, :, :]]
    for first, end in itertools.pairwise(_GENERATIONS):
        parents = torch.stack([chain[parent] for parent in PARENTS[first:end]], -3)
        chain += (parents @ local[..., first:end, :, :]).unbind(-3)
    world = torch.stack(chain, -3)
    moved = (world[..., :3, :3] @ joints[:, :, None])[..., 0]
    return rigid_transform(world[..., :3, :3], world[..., :3, 3] - moved)


class _Kinematics(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, joints: Tensor, turns: Tensor, translation: Tensor) -> Tensor:  # type: ignore[override]
        """Transforms [*b 24 4 4] from axis-angle vectors [*b 24 3] or rotation matrices [*b 24 3 3]."""
        joints, turns, translation = (t.detach().contiguous() for t in (joints, turns, translation))
        matrices, placed = turns, torch.empty(*translation.shape[:-1], 24, 4, 4)
        if turns.ndim == translation.ndim + 1:
            matrices = torch.empty(*turns.shape, 3)
            kernels.rotations(turns.numpy().reshape(-1, 3), matrices.numpy().reshape(-1, 3, 3))
        given = (matrices.numpy().reshape(-1, 24, 3, 3), translation.numpy().reshape(-1, 3))
        kernels.transforms(joints.numpy(), *given, _PARENTS, placed.numpy().reshape(-1, 24, 4, 4))
        ctx.save_for_backward(joints, turns, matrices, placed)
        return placed

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, by_placed: Tensor) -> tuple[Tensor | None, ...]:  # type: ignore[override]
        wanted, tensors = ctx.needs_input_grad, (*ctx.saved_tensors, by_placed.contiguous())
        joints, turns, matrices, placed, given = (tensor.detach().numpy() for tensor in tensors)
        bodies = placed.reshape(-1, 24, 4, 4)
        by_joints, by_translation = np.empty_like(joints), np.empty((len(bodies), 3), np.float32)
        by_turns = np.empty((len(bodies) if wanted[1] else 0, 24, 3, 3), np.float32)
        kernels.transforms_backward(
            joints, matrices.reshape(-1, 24, 3, 3), _PARENTS, bodies, given.reshape(-1, 24, 4, 4), wanted,
            by_joints, by_turns, by_translation,
        )  # fmt: skip
        if wanted[1] and turns.ndim < matrices.ndim:
            by_matrices, by_turns = by_turns, np.empty_like(turns)
            kernels.rotations_backward(turns.reshape(-1, 3), by_matrices.reshape(-1, 3, 3), by_turns.reshape(-1, 3))
        by_turns = by_turns.reshape(turns.shape) if wanted[1] else by_turns
        found = (by_joints, by_turns, by_translation.reshape(*placed.shape[:-3], 3))
        return tuple(torch.from_numpy(array) if one else None for array, one in zip(found, wanted, strict=True))


def blend_shapes(shaped: ShapedBody, pose: Float[Tensor, "24 3"]) -> Float[Tensor, "V 3"]:
    """T-pose vertices with the pose blend shapes of `pose` added (SMPL; nothing is added for a body without)."""
    if shaped.pose_basis.shape[-1] == 0:
        return shaped.vertices
    rotations = axis_angle_to_matrix(pose[1:])
    identity = torch.eye(3, dtype=pose.dtype, device=pose.device)
    return shaped.vertices + shaped.pose_basis @ (rotations - identity).flatten()


def skin(
    points: Float[Tensor, "n 3"], weights: Float[Tensor, "n J"], transforms: Float[Tensor, "J 4 4"]
) -> Float[Tensor, "n 3"]:
    """Linear blend skinning: each point moved by the weighted mean of the transforms."""
    return move_points(points, weighted_transforms(weights, transforms))


def pose_body(
    shaped: ShapedBody,
    pose: Float[Tensor, "24 3"],
    translation: Float[Tensor, "3"],
    rest_joints: Float[Tensor, "24 3"] | None = None,
) -> PosedBody:
    """The body in a pose, its canonical twin, and the bone transforms between the two.

    Args:
        shaped: the person's body.
        pose: axis-angle, root first, radians.
        translation: SMPL's own, metres.
        rest_joints: joints of the T-pose from which the bones leave canonical space, metres; None takes the body's. The
            release has those of the shape as given, whatever the shape was corrected to.
    """
    rest_pose = canonical_pose(pose.dtype, pose.device)
    to_canonical = joint_transforms(shaped.joints, rest_pose, torch.zeros_like(translation))
    from_canonical = to_canonical
    if rest_joints is not None:
        from_canonical = joint_transforms(rest_joints, rest_pose, torch.zeros_like(translation))
    to_world = joint_transforms(shaped.joints, pose, translation)
    posed_joints = (to_world[:, :3, :3] @ shaped.joints[:, :, None])[..., 0] + to_world[:, :3, 3]
    return PosedBody(
        vertices=skin_vertices(blend_shapes(shaped, pose), shaped.weights, to_world),
        canonical_vertices=skin_vertices(blend_shapes(shaped, rest_pose), shaped.weights, to_canonical),
        faces=shaped.faces,
        weights=shaped.weights,
        bones=to_world @ rigid_inverse(from_canonical),
        joints=posed_joints,
        pose=pose,
    )


def movements(
    shaped: ShapedBody, before: tuple[Float[Tensor, "n 24 3"], Float[Tensor, "n 3"]],
    after: tuple[Float[Tensor, "n 24 3"], Float[Tensor, "n 3"]], every: int = 16,
) -> Float[Tensor, "n"]:  # fmt: skip
    """How far the surface moves between two lists of poses and translations, metres: the largest way of a vertex.

    Every 16th vertex is looked at: those beside it move alike. Pose blend shapes are left out; between poses that are
    close to each other they change by fractions of a millimetre.
    """
    points, weights = shaped.vertices[::every], shaped.weights[::every]
    found: list[Tensor] = []
    for part in range(0, len(before[0]), 64):
        first, second = (tuple(t[part : part + 64] for t in poses) for poses in (before, after))
        transforms = joint_transforms(shaped.joints, *second) - joint_transforms(shaped.joints, *first)
        moved = torch.einsum("njab,vb->njva", transforms[..., :3, :3], points) + transforms[..., None, :3, 3]
        found.append(torch.einsum("njva,vj->nva", moved, weights).norm(dim=-1).amax(-1))
    return torch.cat(found)
