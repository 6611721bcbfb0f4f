"""NPC's features at query points of observation space, and the networks from these to distance and colour."""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn
from torch.nn import functional as F

from twofold.field.conditioned_radiance import ColorHead
from twofold.field.encoding import encoding_size, fourier_encoding
from twofold.field.graph import NodeLinear
from twofold.field.local_volumes import line_features
from twofold.field.points import FREE_FEATURES, PARTS, PointCloud, PosedPoints, two_hop_mask
from twofold.kernels.mlp import MLP, uniform

CANONICAL_LINES, CANONICAL_BINS = 9, 12
BONE_LINES, BONE_BINS, BONE_CODE = 2, 16, 32
BONE_COLUMNS = 3 * BONE_LINES
POINT_COLUMNS = FREE_FEATURES + 3 * CANONICAL_LINES
POINT_OCTAVES, VIEW_OCTAVES = 6, 2
SEARCHED_BOXES = 3


@torch.no_grad()
def nearest_posed_points(
    queries: Float[Tensor, "S 3"], coordinates: Float[Tensor, "S 19 3"], positions: Float[Tensor, "n 3"]
) -> Int[Tensor, "S"]:
    """The nearest posed point of each query among the points of three parts.

    The parts are those with the smallest |box coordinates| among the two-hop parts of the closest one. Distances are
    taken part by part, so no array has queries times points entries.

    Args:
        queries: world, metres.
        coordinates: box coordinates of the queries in the 19 parts.
        positions: posed points by number (slot * 19 + part), metres.
    """
    sizes = coordinates.norm(dim=-1)
    # Minus the mask: infinite for parts that are farther than two hops.
    reachable = sizes - two_hop_mask().to(sizes)[sizes.argmin(1)]
    near = reachable.topk(SEARCHED_BOXES, dim=1, largest=False).indices
    by_part = positions.unflatten(0, (-1, PARTS))
    best = torch.full_like(sizes[:, 0], torch.inf)
    found = torch.zeros_like(near[:, 0])
    for part in range(PARTS):
        index = (near == part).any(1).nonzero()[:, 0]
        if len(index):
            distance, slot = torch.cdist(queries[index], by_part[:, part]).min(1)
            closer = distance < best[index]
            index = index[closer]
            best[index], found[index] = distance[closer], slot[closer] * PARTS + part
    return found


@dataclass(frozen=True)
class PointTables:
    """Per point, what queries look up; once for a pose.

    Attributes:
        point_features: free and canonical features.
        bone_lines: tables of the bone field, one a part.
        bone_features: the bone field at the points.
        squared_radii: beta, square metres.
    """

    point_features: Float[Tensor, "n f"]
    bone_lines: Float[Tensor, "19 l k 3"]
    bone_features: Float[Tensor, "n b"]
    squared_radii: Float[Tensor, "n"]


@dataclass(frozen=True)
class QueriedFeatures:
    """Features of each query, blended over 8 neighbouring points.

    Attributes:
        point: f_p, not normalised.
        pose: f_theta, not normalised.
        bone: f_d, how the bone field differs between points and query.
        distance: f_r, how far the query lies beyond the points, away from the bone, metres.
        view: f_v, the view direction along the direction from bone to point.
        influence: sum of the neighbours' a.
    """

    point: Float[Tensor, "S f"]
    pose: Float[Tensor, "S p"]
    bone: Float[Tensor, "S b"]
    distance: Float[Tensor, "S"]
    view: Float[Tensor, "S"]
    influence: Float[Tensor, "S"]


class PointFeatures(nn.Module):
    """Features at query points from the posed points around them (NPC Eqs. 5-9).

    a_k = exp(-|p_k - q|^2 / beta_k), and a'_k = a_k / sum a. f_p = sum a_k [free, canonical features],
    f_theta = sum a_k f_theta_k, f_d = sum a'_k (b(p_k) - b(q)), f_r = sum a'_k <q - p_k, r_k>,
    f_v = sum a'_k <view, r_k>.

    Canonical features are tables along each axis of the box (9 features, 12 bins) and per-part layers 27-32-27; the
    bone field b has tables (2 features, 16 bins) that a per-part layer makes of a code of 32, and a shared linear map
    6-6, whose bias cancels. 100,951 parameters, beside the cloud's.
    """

    def __init__(self, generator: torch.Generator | None = None) -> None:
        super().__init__()
        columns = 3 * CANONICAL_LINES
        shape = (PARTS, CANONICAL_LINES, CANONICAL_BINS, 3)
        self.canonical_lines = nn.Parameter(0.1 * torch.randn(shape, generator=generator))
        self.canonical = nn.Sequential(
            NodeLinear(PARTS, columns, 32, generator=generator),
            nn.ReLU(),
            NodeLinear(PARTS, 32, columns, generator=generator),
        )
        self.bone_codes = nn.Parameter(torch.randn(PARTS, BONE_CODE, generator=generator))
        self.bone_lines = NodeLinear(PARTS, BONE_CODE, BONE_COLUMNS * BONE_BINS, generator=generator)
        self.bone_map = nn.Linear(BONE_COLUMNS, BONE_COLUMNS)
        with torch.no_grad():
            for parameter in self.bone_map.parameters():
                parameter.copy_(uniform(parameter.shape, BONE_COLUMNS**-0.5, generator))

    def tables(self, cloud: PointCloud) -> PointTables:
        """What queries look up; it does not depend on the pose, so once for a step."""
        slots = len(cloud.positions)
        part = torch.arange(PARTS, device=cloud.positions.device).repeat(slots)
        positions = cloud.positions.flatten(0, 1)
        raw = line_features(self.canonical_lines, positions, part).unflatten(0, (slots, PARTS))
        canonical = self.canonical(raw)
        lines = self.bone_lines(self.bone_codes).unflatten(-1, (BONE_LINES, BONE_BINS, 3))
        return PointTables(
            point_features=torch.cat([cloud.features, canonical], -1).flatten(0, 1),
            bone_lines=lines,
            bone_features=line_features(lines, positions, part),
            squared_radii=cloud.squared_radii(),
        )

    def forward(
        self,
        queries: Float[Tensor, "S 3"],
        views: Float[Tensor, "S 3"],
        nearest: Int[Tensor, "S"],
        cloud: PointCloud,
        posed: PosedPoints,
        tables: PointTables,
        dropped: Bool[Tensor, "S"] | None = None,
    ) -> QueriedFeatures:
        """The features of each query.

        Args:
            queries: world, metres.
            views: unit view directions.
            nearest: point numbers from `nearest_posed_points`; their neighbours of the rest pose are blended.
            cloud: the points.
            posed: the points in the pose.
            tables: from `tables`.
            dropped: queries whose nearest point has no weight (constraints drop it with probability 0.8); where this
                is given, f_d carries no gradient.
        """
        index = cloud.neighbours[nearest]
        offset = queries[:, None] - posed.positions[index]
        exponent = -offset.square().sum(-1) / tables.squared_radii[index]
        if dropped is not None:
            is_nearest = torch.zeros_like(index, dtype=torch.bool)
            is_nearest[:, 0] = dropped
            exponent = exponent.masked_fill(is_nearest, -torch.inf)
        influence, fraction = exponent.exp(), exponent.softmax(-1)
        directions = posed.directions[index]
        bone = self._bone_difference(queries, index, fraction, cloud, posed, tables)
        return QueriedFeatures(
            point=_blend(influence, tables.point_features[index]),
            pose=_blend(influence, posed.pose_features[index]),
            bone=bone if dropped is None else bone.detach(),
            distance=(fraction * (offset * directions).sum(-1)).sum(-1),
            view=(views * _blend(fraction, directions)).sum(-1),
            influence=influence.sum(-1),
        )

    def _bone_difference(
        self,
        queries: Tensor,
        index: Tensor,
        fraction: Tensor,
        cloud: PointCloud,
        posed: PosedPoints,
        tables: PointTables,
    ) -> Tensor:
        part = index % PARTS
        rows = posed.world_to_frame[:, :3] / cloud.half_sizes[..., None]
        all_parts = (queries @ rows[..., :3].flatten(0, 1).T).unflatten(-1, (PARTS, 3)) + rows[..., 3]
        local = all_parts.gather(1, part[..., None].expand(-1, -1, 3))
        here = line_features(tables.bone_lines, local.flatten(0, 1), part.flatten()).unflatten(0, part.shape)
        return F.linear(_blend(fraction, tables.bone_features[index] - here), self.bone_map.weight)


class PointRadiance(nn.Module):
    """Signed distance and colour of queried features (NPC).

    s = MLP(encoded f_p, f_d, f_theta, f_r) with 483 inputs and three hidden layers of 256 (255,745 parameters); colour
    from its last hidden layer, the encoded f_v and the frame's code (116,099). Sines and cosines are multiplied by the
    sum of the neighbours' influences.
    """

    def __init__(self, generator: torch.Generator | None = None) -> None:
        super().__init__()
        inputs = encoding_size(POINT_OCTAVES, POINT_COLUMNS) + BONE_COLUMNS + 8 + 1
        self.distance = MLP(inputs, [256] * 3, 1, start="torch", generator=generator)
        self.color = ColorHead(encoding_size(VIEW_OCTAVES, 1), generator)

    def forward(
        self, features: QueriedFeatures, code: Float[Tensor, "c"]
    ) -> tuple[Float[Tensor, "S"], Float[Tensor, "S 3"]]:
        """Signed distance (metres) and colour; density is the Laplace density of the distance."""
        hidden = self.distance.hidden(self._inputs(features))
        view = _weighted_encoding(features.view[:, None], VIEW_OCTAVES, features.influence)
        return self.distance.head(hidden)[:, 0], self.color(hidden, view, code)

    def sdf(self, features: QueriedFeatures) -> Float[Tensor, "S"]:
        """The signed distance alone, metres."""
        return self.distance(self._inputs(features))[:, 0]

    def _inputs(self, features: QueriedFeatures) -> Tensor:
        encoded = _weighted_encoding(features.point, POINT_OCTAVES, features.influence)
        return torch.cat([encoded, features.bone, features.pose, features.distance[:, None]], -1)


def _blend(weights: Tensor, values: Tensor) -> Tensor:
    return (weights[:, None] @ values)[:, 0]


def _weighted_encoding(x: Tensor, octaves: int, influence: Tensor) -> Tensor:
    encoded = fourier_encoding(x, octaves, include_pi=False)
    columns = x.shape[-1]
    return torch.cat([encoded[:, :columns], encoded[:, columns:] * influence[:, None]], -1)
