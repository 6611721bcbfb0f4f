"""DANBO's field: pose-dependent features in a small factorised volume around each bone."""

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn

from twofold.field.bone_boxes import RIGID_PARTS, box_window
from twofold.field.graph import GraphLinear, NodeLinear, PoseGraph

FEATURES, BINS = 5, 16
VOLUME_COLUMNS = 3 * FEATURES
POSE_INPUTS = 66


def line_features(
    lines: Float[Tensor, "J f k 3"], coordinates: Float[Tensor, "n 3"], part: Int[Tensor, "n"]
) -> Float[Tensor, "n C"]:
    r"""Linear interpolation in tables along each axis of a box: f features of x, then of y, then of z (C = 3 f).

    \[ h(u) = (1 - f) L_k + f L_{k+1}, \qquad k + f = \tfrac12 (u + 1)(n - 1) \]

    The first and last of the k bins lie at -1 and 1; coordinates beyond take these.

    >>> lines = torch.tensor([[0.0, 4.0], [0.0, 8.0]]).T[None, None].expand(1, 1, 2, 2)
    >>> line_features(torch.cat([lines, lines[..., :1]], -1), torch.tensor([[0.0, -1.0, 1.0]]), torch.tensor([0]))
    tensor([[2., 0., 4.]])

    Args:
        lines: f features at k bins of 3 axes, for J parts.
        coordinates: box coordinates.
        part: whose tables each row is looked up in.
    """
    parts, features, bins, _ = lines.shape
    table = lines.permute(0, 3, 2, 1).reshape(parts * 3 * bins, features)
    place = (coordinates.clamp(-1, 1) + 1) * ((bins - 1) / 2)
    low = place.detach().floor().clamp_max(bins - 2).long()
    fraction = (place - low)[..., None]
    rows = low + bins * (3 * part[:, None] + torch.arange(3, device=part.device))
    below, above = table[rows.flatten()], table[rows.flatten() + 1]
    mixed = torch.lerp(below, above, fraction.expand(-1, -1, features).flatten(0, 1))
    return mixed.unflatten(0, (-1, 3)).flatten(1)


class LocalVolumes(nn.Module):
    """A feature of 15 numbers for each sample, blended over the boxes that hold it (DANBO Eqs. 3-7).

    h_j = [tables along each axis at x_j] exp(-2 sum x_j^6); p_j = inside_j (1.002 sigmoid(a_j) - 0.001) with a a graph
    network of all h; the feature is the sum of p_j h_j over the rigid parts. The tables come from a graph network of
    the pose: 5 features, 16 bins, 3 axes a joint. 1,736,704 parameters for the pose and 38,264 for the blending.
    """

    def __init__(self, generator: torch.Generator | None = None) -> None:
        super().__init__()
        self.pose_graph = PoseGraph(POSE_INPUTS, VOLUME_COLUMNS * BINS, generator=generator)
        self.blending = nn.ModuleList(
            [
                GraphLinear(VOLUME_COLUMNS, 32, generator=generator),
                NodeLinear(24, 32, 32, generator=generator),
                NodeLinear(24, 32, 1, generator=generator),
            ]
        )

    def tables(self, features: Float[Tensor, "24 i"]) -> Float[Tensor, "24 f k 3"]:
        """The volumes' tables in a pose, once for all samples; see `field.graph.pose_features` (5 octaves)."""
        return self.pose_graph(features).unflatten(-1, (FEATURES, BINS, 3))

    def forward(
        self,
        tables: Float[Tensor, "24 f k 3"],
        coordinates: Float[Tensor, "S 24 3"],
        inside: Bool[Tensor, "S 24"],
    ) -> tuple[Float[Tensor, "S C"], Float[Tensor, "S 24"]]:
        """The blended feature (15 columns), and the probabilities p that blend it.

        Args:
            tables: of the pose.
            coordinates: box coordinates of the samples; only samples inside some box need be given.
            inside: which boxes hold them.
        """
        part = torch.arange(24, device=coordinates.device).repeat(len(coordinates))
        looked_up = line_features(tables, coordinates.flatten(0, 1), part).unflatten(0, (-1, 24))
        local = looked_up * box_window(coordinates)[..., None]
        h = local
        for index, layer in enumerate(self.blending):
            h = layer(h) if index == 0 else layer(h.relu())
        probability = inside * (1.002 * h[..., 0].sigmoid() - 0.001)
        rigid = list(RIGID_PARTS)
        return (probability[:, rigid, None] * local[:, rigid]).sum(1), probability
