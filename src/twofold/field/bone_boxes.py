"""One box around each bone, in coordinates that move with the bone (DANBO, NPC, PM-Avatar).

A point's box coordinates are its coordinates in the bone-aligned frame divided by the box's half-sizes; inside a box
all three lie in -1..1. Joints follow SMPL's order.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn
from torch.nn import functional as F

from twofold.body.skeleton import PARENTS
from twofold.geometry.rotations import rigid_inverse, rigid_transform, shortest_turn

RIGID_PARTS = (0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 13, 14, 15, 16, 17, 18, 19, 20, 21)
"""Joints whose boxes hold the person in DANBO and NPC: all but toes, neck and hands."""
TWO_HOPS: dict[int, tuple[int, ...]] = {
    0: (0, 1, 2, 3, 4, 5, 6), 1: (0, 1, 2, 3, 4, 7), 2: (0, 1, 2, 3, 5, 8), 3: (0, 1, 2, 3, 6, 9), 4: (0, 1, 4, 7),
    5: (0, 2, 5, 8), 6: (0, 3, 6, 9, 13, 14), 7: (1, 4, 7), 8: (2, 5, 8), 9: (3, 6, 9, 13, 14, 15, 16, 17),
    13: (6, 9, 13, 14, 16, 18), 14: (6, 9, 13, 14, 17, 19), 15: (9, 13, 14, 15), 16: (9, 13, 16, 18, 20),
    17: (9, 14, 17, 19, 21), 18: (13, 16, 18, 20), 19: (14, 17, 19, 21), 20: (16, 18, 20), 21: (17, 19, 21),
}  # fmt: skip
"""For each rigid part, the parts that may move its points or are searched too: two steps along the skeleton (NPC)."""
MIN_SCALE = 0.95
"""A learned half-size does not fall below this fraction of its initial value."""
WINDOW_SHARPNESS = 2.0

_LEGS, _TORSO, _ARMS = (1, 2, 4, 5, 7, 8, 10, 11), (0, 3, 6, 9), (13, 14, 16, 17, 18, 19, 20, 21, 22, 23)
_ENDS = (10, 11, 22, 23)
_NECK, _HEAD = 12, 15
_KNEES, _SHOULDERS = (4, 5), (16, 17)


@dataclass(frozen=True)
class BoneFrames:
    """The bone-aligned frame of each joint, in the rest pose.

    The frame of a joint with exactly one child has its origin in the middle of the bone and +z along it. Joints with
    no child or several keep their own axes and origin.

    Attributes:
        rotations: from the rest pose's axes to the frame's.
        origins: of the frames, rest pose, metres.
    """

    rotations: Float[Tensor, "24 3 3"]
    origins: Float[Tensor, "24 3"]

    def world_to_frame(self, posed: Float[Tensor, "24 4 4"]) -> Float[Tensor, "24 4 4"]:
        """The transform from the world to each joint's frame, in a pose.

        Args:
            posed: rest pose to posed, one a joint (`joint_transforms`).
        """
        rest_to_frame = rigid_transform(self.rotations, -(self.rotations @ self.origins[..., None])[..., 0])
        return rest_to_frame @ rigid_inverse(posed)


def bone_frames(joints: Float[Tensor, "24 3"]) -> BoneFrames:
    r"""The bone-aligned frames of a skeleton whose rest joints (metres) are given.

    \[ x_{frame} = R_j (x - o_j), \qquad o_j = \tfrac12 (J_j + J_{child}), \qquad R_j (J_{child} - J_j) \parallel e_z \]

    >>> joints = torch.rand(24, 3, generator=torch.Generator().manual_seed(0))
    >>> frames = bone_frames(joints)
    >>> bone = frames.rotations[18] @ (joints[20] - joints[18])  # the left elbow has one child, the wrist
    >>> bool(bone[:2].abs().max() < 1e-6), bool(torch.equal(frames.origins[18], (joints[18] + joints[20]) / 2))
    (True, True)
    """
    rotations, origins = [], []
    for joint in range(24):
        children = _children(joint)
        if len(children) == 1:
            rotations.append(_rotation_to_z(joints[children[0]] - joints[joint]))
            origins.append((joints[joint] + joints[children[0]]) / 2)
        else:
            rotations.append(torch.eye(3, dtype=joints.dtype, device=joints.device))
            origins.append(joints[joint])
    return BoneFrames(torch.stack(rotations), torch.stack(origins))


def initial_half_sizes(joints: Float[Tensor, "24 3"]) -> Float[Tensor, "24 3"]:
    r"""Half-sizes (x, y, z) of the boxes in their frames, from the proportions of the skeleton, metres.

    >>> joints = torch.zeros(24, 3)
    >>> joints[4, 0], joints[5, 0], joints[7, 0], joints[7, 1] = 0.2, -0.2, 0.2, -1.0
    >>> initial_half_sizes(joints)[4]  # left knee: half the distance of the knees, and 4/5 of the shin
    tensor([0.2000, 0.2000, 0.8000])

    With k the distance of the knees and s that of the shoulders, x = y = k/2 for legs, s/2 for the torso, 2k/5 for
    collars, arms and hands. z is 4/5 of the bone to the child (the mean of several), and the length of the parent's
    bone for feet and hands. Neck and head have x = 3s/10, y = 7s/20 (head 3s/5) and z = 3/10 of the largest other z.

    Args:
        joints: of the rest pose, metres.
    """
    knees, shoulders = ((joints[a] - joints[b]).norm() for a, b in (_KNEES, _SHOULDERS))
    lengths = [(joints[j] - joints[max(PARENTS[j], 0)]).norm() for j in range(24)]
    sizes: dict[int, list[Tensor]] = {}
    for group, across in ((_LEGS, 0.5 * knees), (_TORSO, 0.5 * shoulders), (_ARMS, 0.4 * knees)):
        for joint in group:
            along = lengths[joint]
            if joint not in _ENDS:
                along = 0.8 * torch.stack([lengths[child] for child in _children(joint)]).mean()
            sizes[joint] = [across, across, along]
    largest = torch.stack([size[2] for size in sizes.values()]).max()
    sizes[_NECK] = [0.3 * shoulders, 0.35 * shoulders, 0.3 * largest]
    sizes[_HEAD] = [0.3 * shoulders, 0.6 * shoulders, 0.3 * largest]
    return torch.stack([torch.stack(sizes[joint]) for joint in range(24)])


class BoxSizes(nn.Module):
    """Learned half-sizes, max(size, 0.95 initial size); gradients pass straight through the maximum. 72 parameters."""

    minimum: Tensor

    def __init__(self, initial: Float[Tensor, "24 3"]) -> None:
        super().__init__()
        self.sizes = nn.Parameter(initial.clone())
        self.register_buffer("minimum", MIN_SCALE * initial)

    def forward(self) -> Float[Tensor, "24 3"]:
        """The half-sizes, metres."""
        return self.sizes + (torch.maximum(self.sizes, self.minimum) - self.sizes).detach()


def box_coordinates(
    points: Float[Tensor, "S 3"], world_to_frame: Float[Tensor, "J 4 4"], half_sizes: Float[Tensor, "J 3"]
) -> Float[Tensor, "S J 3"]:
    r"""Coordinates of points in every box.

    \[ u_j = S_j^{-1} M_j x \]

    with the transform $M_j$ into the frame of box $j$ and its half-sizes on the diagonal of $S_j$.

    >>> box_coordinates(torch.tensor([[1.0, 2.0, 3.0]]), torch.eye(4)[None], torch.tensor([[1.0, 2.0, 4.0]]))
    tensor([[[1.0000, 1.0000, 0.7500]]])

    Args:
        points: world, metres.
        world_to_frame: of the boxes that matter, see `BoneFrames.world_to_frame`.
        half_sizes: of these boxes, metres.
    """
    # One product for all boxes: the scale goes into the transform.
    rows = world_to_frame[:, :3] / half_sizes[..., None]
    flat = points @ rows[..., :3].flatten(0, 1).T
    return flat.unflatten(-1, (len(rows), 3)) + rows[..., 3]


def inside_boxes(coordinates: Float[Tensor, "*b 3"]) -> Bool[Tensor, "*b"]:
    r"""Whether all three box coordinates lie in -1..1.

    \[ \max_i |u_i| \le 1 \]

    >>> inside_boxes(torch.tensor([[0.0, -1.0, 0.5], [0.0, 1.1, 0.0]]))
    tensor([ True, False])
    """
    return (coordinates.abs() <= 1).all(-1)


def box_window(coordinates: Float[Tensor, "*b 3"]) -> Float[Tensor, "*b"]:
    r"""exp(-2 (x^6 + y^6 + z^6)): one in the middle of a box, 0.14 at the middle of a face, nothing outside.

    \[ w = e^{-2 (u_x^6 + u_y^6 + u_z^6)} \]

    >>> box_window(torch.tensor([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]]))
    tensor([1.0000, 0.1353])
    """
    squared = coordinates.square()
    return torch.exp(-WINDOW_SHARPNESS * (squared * squared * squared).sum(-1))


def assign_to_boxes(
    coordinates: Float[Tensor, "S J 3"], half_sizes: Float[Tensor, "J 3"], tries: int = 5
) -> Int[Tensor, "S"]:
    r"""The box that each point belongs to: of the `tries` with the nearest centres, the nearest that holds it; else -1.

    \[ j = \arg\min_{j : \max_i |u_{ji}| \le 1} \lVert S_j u_j \rVert \]

    >>> assign_to_boxes(torch.tensor([[[2.0, 0.0, 0.0], [0.9, 0.0, 0.0]]]), torch.tensor([[0.1] * 3, [1.0] * 3]))
    tensor([1])

    Args:
        coordinates: box coordinates of the points.
        half_sizes: of the boxes, metres.
        tries: how many boxes are looked at.
    """
    distances = (coordinates * half_sizes).norm(dim=-1)
    order = distances.argsort(1)[:, :tries]
    holds = inside_boxes(coordinates).gather(1, order)
    first = holds.int().argmax(1, keepdim=True)
    return torch.where(holds.any(1), order.gather(1, first)[:, 0], -1)


def _children(joint: int) -> list[int]:
    return [child for child, parent in enumerate(PARENTS) if parent == joint]


def _rotation_to_z(direction: Tensor) -> Tensor:
    """The shortest rotation that takes a direction to +z; half a turn about x for -z."""
    identity = torch.eye(3, dtype=direction.dtype, device=direction.device)
    if F.normalize(direction, dim=0)[2] < -1 + 1e-6:
        return identity * direction.new_tensor([1, -1, -1])
    return shortest_turn(direction, identity[2])
