"""Signed distances of a field in training, tabulated every some steps: they find the samples of the steps between."""

from collections.abc import MutableMapping

import torch
from jaxtyping import Float
from torch import Tensor, nn

from twofold.sampling.sdf_grid import KNOWN_BELOW, Distance, SdfGrid, grid_nodes, query_nodes

VOXEL = 0.015
"""Spacing of the nodes, metres: of finer ones there are more than the steps between two tables pay for."""
_COVERED = 0.99
"""Share of the nodes near the surface that a table's error covers."""
_UNKNOWN = 6e4
"""What a node without a distance holds: half-precision numbers end there."""
_NEVER = 1.0
"""Error of a table that nothing is known of, metres."""


class TrainingGrid(nn.Module):
    r"""A field's distances at the nodes of a grid, as they were some steps ago, in the pose of one training frame.

    A step needs the field in another pose, after more steps. Two tables in a row differ by both, so what they differ by
    near the surface is the error to expect:

    \[ \epsilon = Q_{0.99}\left( |\tilde s_k(x_n) - \tilde s_{k-1}(x_n)| : |\tilde s_k(x_n)| < h \right) \]

    over the nodes $x_n$, $h$ apart. Distances and error are stored with a run, so a resumed one repeats its steps.
    """

    values: Float[Tensor, "X Y Z"]
    error: Float[Tensor, ""]

    def __init__(self, canonical: Float[Tensor, "V 3"], radius: float, every: int) -> None:
        """Nothing is known yet.

        Args:
            canonical: vertices of the canonical body, metres.
            radius: how far from these nodes lie, metres.
            every: steps between two tables.
        """
        super().__init__()
        self.radius, self.every = radius, every
        self._nodes = grid_nodes(canonical, VOXEL, radius)
        self.register_buffer("values", torch.full(self._nodes.shape, _UNKNOWN, dtype=torch.float16))
        self.register_buffer("error", torch.tensor(_NEVER))
        self._ready: tuple[tuple[int, int], SdfGrid] | None = None

    def is_due(self, step: int) -> bool:
        """Whether a table is to be made before this step; on GPUs, where rays are followed otherwise, never."""
        return step > 0 and step % self.every == 0 and not self.values.is_cuda

    @torch.no_grad()
    def refresh(self, distance: Distance) -> None:
        """Tabulates the field, and compares that with the table before."""
        new = query_nodes(self._nodes, distance)
        old = self.values.flatten()[self._nodes.flat].float()
        near = (new.abs() < VOXEL) & (old < KNOWN_BELOW)
        change = (new - old)[near].abs()
        self.error.fill_(change.quantile(_COVERED) if len(change) else _NEVER)
        self.values.view(-1)[self._nodes.flat] = new.half()

    def grid(self) -> SdfGrid | None:
        """The table; None until two agree well enough to rule out samples."""
        if float(self.error) > self.radius / 3:
            return None
        version = id(self.values), self.values._version
        if self._ready is None or self._ready[0] != version:
            self._ready = version, SdfGrid(self.values.float(), self._nodes.low, VOXEL, float(self.error))
        return self._ready[1]

    def take_on(self, state: MutableMapping[str, Tensor], prefix: str) -> None:
        """Gives up a stored table whose grid is another, as rounding on another machine may make it."""
        if state[f"{prefix}values"].shape != self.values.shape:
            state[f"{prefix}values"] = torch.full_like(self.values, _UNKNOWN)
            state[f"{prefix}error"] = torch.full_like(self.error, _NEVER)
