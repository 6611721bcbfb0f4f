"""NPC's points: a cloud on the person's surface, grouped by body part, and how a pose moves it.

Arrays have one row for each slot and one column for each of the 19 rigid parts (`RIGID_PARTS`); a point's number is
slot * 19 + part.
"""

import math
from collections.abc import Collection
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn
from torch.nn import functional as F

from twofold.body.blending import move_points, weighted_transforms
from twofold.body.skeleton import JOINT_NAMES
from twofold.errors import TwofoldError
from twofold.field.bone_boxes import RIGID_PARTS, TWO_HOPS, assign_to_boxes, bone_frames
from twofold.field.graph import NodeLinear, PoseGraph
from twofold.geometry.rotations import rigid_inverse

PARTS = len(RIGID_PARTS)
FREE_FEATURES = 9
POSE_INPUTS, POSE_FEATURES = 66, 8
INITIAL_RADIUS = 5e-4
"""Initial beta of a point's influence exp(-d^2 / beta), square metres."""
OFFSET_SCALE, MAX_OFFSET = 0.01, 0.04
"""Unit of the learned offsets, and the length from which they are discarded; metres."""
WHOLE_DIRECTION = (0, 9, 15)
"""Parts whose direction from bone to point keeps its component along the bone."""
_HIDDEN = 96


def farthest_points(points: Float[Tensor, "n 3"], count: int) -> Int[Tensor, "count"]:
    r"""Indices of points chosen one after the other, each the farthest from those before; begins with the first point.

    \[ i_{k+1} = \arg\max_i \min_{j \le k} \lVert x_i - x_{i_j} \rVert \]

    >>> farthest_points(torch.tensor([[0.0, 0, 0], [0.4, 0, 0], [1.0, 0, 0]]), 3)
    tensor([0, 2, 1])

    Raises:
        ValueError: fewer than `count` points are given.
    """
    if len(points) < count:
        raise ValueError(f"{count} points cannot be chosen from {len(points)}")
    chosen = torch.zeros(count, dtype=torch.long, device=points.device)
    distances = (points - points[0]).square().sum(-1)
    for index in range(1, count):
        chosen[index] = distances.argmax()
        distances = torch.minimum(distances, (points - points[chosen[index]]).square().sum(-1))
    return chosen


def choose_positions(
    coordinates: Float[Tensor, "n 19 3"], half_sizes: Float[Tensor, "19 3"], count: int = 200,
    unseen: Collection[int] = (), instead: Float[Tensor, "b 19 3"] | None = None,
) -> Float[Tensor, "count 19 3"]:  # fmt: skip
    r"""Box coordinates of `count` surface points for each part, as far from each other as can be.

    \[ \{ u_{jk} \} \subset \{ u_j : x \text{ in box } j \} \text{ by farthest points of } S_j u_j \]

    Each point belongs to the nearest box that holds it (`assign_to_boxes`); points in no box are left out. The authors'
    programs choose 1000 of each part first and 200 of these later, which are the same 200.

    Args:
        coordinates: of points on the surface that DANBO found (rest pose), in the boxes of the rigid parts.
        half_sizes: of these boxes, metres.
        count: points of each part.
        unseen: parts that no image shows, where DANBO's surface is of no use.
        instead: points that stand for the surface there.

    Raises:
        TwofoldError: a part has fewer points.
    """
    part = assign_to_boxes(coordinates, half_sizes)
    other = part[:0] if instead is None else assign_to_boxes(instead, half_sizes)
    columns = []
    for index, joint in enumerate(RIGID_PARTS):
        own = coordinates[part == index, index]
        if instead is not None and index in unseen:
            own = instead[other == index, index]
        if len(own) < count:
            raise TwofoldError(
                f"NPC needs {count} surface points for each body part, the {JOINT_NAMES[joint]} has {len(own)}; train "
                "its first stage longer (method.first_steps), on more frames that show this part, or with fewer points "
                "(method.points)."
            )
        columns.append(own[farthest_points(own * half_sizes[index], count)])
    return torch.stack(columns, 1)


def two_hop_mask() -> Float[Tensor, "19 19"]:
    r"""Zero where a part (row) may be moved by another (column), minus infinity elsewhere: added to skinning logits.

    \[ m_{ij} = 0 \text{ where } j \in N(i), \text{ else } -\infty \]

    with the parts $N(i)$ that `TWO_HOPS` names.

    >>> mask = two_hop_mask()
    >>> mask.shape, float(mask.diagonal().abs().max()), float(mask.min())
    (torch.Size([19, 19]), 0.0, -inf)
    """
    mask = torch.full((PARTS, PARTS), -torch.inf)
    for row, part in enumerate(RIGID_PARTS):
        mask[row, [RIGID_PARTS.index(other) for other in TWO_HOPS[part]]] = 0
    return mask


@dataclass(frozen=True)
class PosedPoints:
    """The cloud in a pose; everything with n = slots * 19 rows, by point number.

    Attributes:
        positions: world, metres; offsets of 4 cm and more are left out.
        offsets: what the pose adds to skinning, before any are left out, metres.
        pose_features: f_theta of each point.
        directions: r, from the bone to the point, world, unit length; no gradient.
        world_to_frame: to the bone-aligned frame of each part.
    """

    positions: Float[Tensor, "n 3"]
    offsets: Float[Tensor, "n 3"]
    pose_features: Float[Tensor, "n 8"]
    directions: Float[Tensor, "n 3"]
    world_to_frame: Float[Tensor, "19 4 4"]


class PointCloud(nn.Module):
    """What is learned of each point: position, skinning logits, radius, free features; 32 numbers a point.

    The logits start at 1 / sqrt(distance to the joint), the features at N(0, 0.1^2).

    Args:
        positions: box coordinates of the points.
        joints: of the rest pose, metres.
        half_sizes: of all 24 boxes, metres; they stay as DANBO left them.
        neighbours: how many nearest points of the rest pose, the point itself among them, are blended.
        generator: draws the features.
    """

    half_sizes: Tensor
    rotations: Tensor
    origins: Tensor
    neighbours: Tensor

    def __init__(
        self,
        positions: Float[Tensor, "m 19 3"],
        joints: Float[Tensor, "24 3"],
        half_sizes: Float[Tensor, "24 3"],
        neighbours: int = 8,
        generator: torch.Generator | None = None,
    ) -> None:
        super().__init__()
        rigid, frames, slots = list(RIGID_PARTS), bone_frames(joints), len(positions)
        self.register_buffer("half_sizes", half_sizes[rigid].clone())
        self.register_buffer("rotations", frames.rotations[rigid])
        self.register_buffer("origins", frames.origins[rigid])
        self.positions = nn.Parameter(positions.clone())
        rest = self.rest_points().detach().flatten(0, 1)
        distances = torch.cdist(rest, joints[rigid]).clamp_min(1e-6)
        self.logits = nn.Parameter(distances.rsqrt().unflatten(0, (slots, PARTS)))
        self.radii = nn.Parameter(torch.full((slots, PARTS), math.log(math.expm1(INITIAL_RADIUS))))
        self.features = nn.Parameter(0.1 * torch.randn(slots, PARTS, FREE_FEATURES, generator=generator))
        self.register_buffer("neighbours", nearest_neighbours(rest, neighbours))

    def rest_points(self) -> Float[Tensor, "m 19 3"]:
        """The points in the rest pose, metres."""
        in_frame = self.positions * self.half_sizes
        return (in_frame[..., None, :] @ self.rotations)[..., 0, :] + self.origins

    def squared_radii(self) -> Float[Tensor, "n"]:
        """beta = softplus(radius) of each point, square metres."""
        return F.softplus(self.radii).flatten()

    @torch.no_grad()
    def directions(self) -> Float[Tensor, "m 19 3"]:
        """r: unit vectors from bone to point in each part's frame; across the bone, but whole for three parts."""
        vectors = self.positions * self.half_sizes
        keep = torch.tensor([part in WHOLE_DIRECTION for part in RIGID_PARTS], device=vectors.device)
        along = vectors[..., 2:] * keep[:, None]
        return F.normalize(torch.cat([vectors[..., :2], along], -1), dim=-1)


def nearest_neighbours(points: Float[Tensor, "n 3"], count: int) -> Int[Tensor, "n count"]:
    r"""The nearest `count` points of each point; itself first.

    $k$ indices of each point that minimise the distance $\lVert x_i - x_j \rVert$, itself first.

    >>> nearest_neighbours(torch.tensor([[0.0, 0, 0], [1.0, 0, 0], [3.0, 0, 0]]), 2)
    tensor([[0, 1],
            [1, 0],
            [2, 1]])
    """
    distances = torch.cdist(points, points)
    distances.fill_diagonal_(-1)
    return distances.topk(count, dim=1, largest=False).indices


class PointDeformation(nn.Module):
    """The cloud in a pose: skinning over two-hop parts, and offsets that depend on the pose (NPC).

    weights = softmax(logits + blend(p)) over the two-hop parts; p_lbs = sum_k w_k T_k p_c; with (alpha, gamma) of each
    part from the pose graph, z = ReLU(lin p) alpha + gamma, two ReLU layers of 96, (f_theta, d) = lin z;
    offset = R (0.01 d), left out where it is 4 cm or longer.

    Parameters: pose graph 1,464,256; offsets 381,425; blending 34,409.
    """

    mask: Tensor

    def __init__(self, generator: torch.Generator | None = None) -> None:
        super().__init__()
        self.pose_graph = PoseGraph(POSE_INPUTS, 2 * _HIDDEN, RIGID_PARTS, generator=generator)
        self.first = NodeLinear(PARTS, 3, _HIDDEN, generator=generator)
        self.hidden = nn.ModuleList([NodeLinear(PARTS, _HIDDEN, _HIDDEN, generator=generator) for _ in range(2)])
        self.last = NodeLinear(PARTS, _HIDDEN, POSE_FEATURES + 3, generator=generator)
        with torch.no_grad():
            self.last.weight.copy_(0.01 * torch.randn(self.last.weight.shape, generator=generator))
            self.last.bias.zero_()
        self.blending = nn.Sequential(
            NodeLinear(PARTS, 3, 32, generator=generator),
            nn.ReLU(),
            NodeLinear(PARTS, 32, 32, generator=generator),
            nn.ReLU(),
            NodeLinear(PARTS, 32, PARTS, generator=generator),
        )
        self.register_buffer("mask", two_hop_mask(), persistent=False)

    def forward(
        self, cloud: PointCloud, features: Float[Tensor, "24 i"], posed: Float[Tensor, "24 4 4"]
    ) -> PosedPoints:
        """The cloud in a pose.

        Args:
            cloud: the points.
            features: of the pose, `field.graph.pose_features` with 5 octaves.
            posed: rest pose to posed, one a joint (`joint_transforms`).
        """
        transforms = posed[list(RIGID_PARTS)]
        weights = (cloud.logits + self.blending(cloud.positions) + self.mask).softmax(-1)
        skinned = move_points(cloud.rest_points(), weighted_transforms(weights, transforms))
        # A vector of a part's frame is turned to the world by the frame's rest rotation undone, then the bone's.
        turns = transforms[:, :3, :3] @ cloud.rotations.transpose(-1, -2)
        pose_features, offsets = self._offsets(cloud.positions, features)
        offsets = (turns @ offsets[..., None])[..., 0]
        kept = offsets * (offsets.detach().norm(dim=-1, keepdim=True) < MAX_OFFSET)
        directions = (turns.detach() @ cloud.directions()[..., None])[..., 0]
        rest_to_frame = torch.eye(4, dtype=posed.dtype, device=posed.device).repeat(PARTS, 1, 1)
        rest_to_frame[:, :3, :3] = cloud.rotations
        rest_to_frame[:, :3, 3] = -(cloud.rotations @ cloud.origins[..., None])[..., 0]
        return PosedPoints(
            positions=(skinned + kept).flatten(0, 1),
            offsets=offsets.flatten(0, 1),
            pose_features=pose_features.flatten(0, 1),
            directions=directions.flatten(0, 1),
            world_to_frame=rest_to_frame @ rigid_inverse(transforms),
        )

    def _offsets(self, positions: Tensor, features: Tensor) -> tuple[Tensor, Tensor]:
        """f_theta, and the offsets in each part's frame, metres."""
        scale, shift = self.pose_graph(features).split(_HIDDEN, -1)
        h = self.first(positions).relu() * scale + shift
        for layer in self.hidden:
            h = layer(h).relu()
        out = self.last(h)
        return out[..., :POSE_FEATURES], OFFSET_SCALE * out[..., POSE_FEATURES:]
