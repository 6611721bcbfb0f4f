"""A grid of signed distances that follows a field in training and finds the samples worth a query of the field."""

import torch
from jaxtyping import Float
from torch import Tensor, nn

from twofold.kernels.processes import summed_over_processes
from twofold.sampling import search_kernels as kernels
from twofold.sampling.sdf_grid import Distance, SdfGrid, differences, grid_nodes, query_nodes

_EVERY = 200
"""Steps between two queries of all nodes; at the beginning fewer, twice as many each time."""
_TRIALS = 2048
"""Places at which a new grid is compared with the field."""
_SPREAD = 3.0
"""Error of the grid in mean differences: of differences that fall off exponentially 95 % are smaller.

Samples with the least weight that counts lie one or two centimetres from the surface, so a difference beyond the error
misses samples of little weight; and the field itself is queried at what the grid finds before that is shaded."""
_RECENT = 0.1
"""Weight of the newest step in the mean difference."""
Residuals = tuple[Tensor, Tensor, Tensor]
"""See `add_residuals`."""


class TrainingGrid(nn.Module):
    """Signed distances of a field around the canonical body, corrected wherever the field is queried.

    Values and error are part of the state, so that a training that was interrupted finds the same samples.
    """

    values: Tensor
    error: Tensor

    def __init__(self, points: Float[Tensor, "n 3"], voxel: float, radius: float) -> None:
        """Of a canonical body, with a spacing, as far from its vertices as samples are mapped; metres."""
        super().__init__()
        self._nodes = grid_nodes(points, voxel, radius)
        self.register_buffer("values", self._nodes.filled(torch.zeros(len(self._nodes.positions)), 0.0).values)
        # Negative until there are values.
        self.register_buffer("error", torch.tensor(-1.0))
        self._recorded: Residuals | None = None

    def is_due(self, step: int) -> bool:
        """Whether all nodes are to be queried before this step."""
        return step % _EVERY == 0 or (step < _EVERY and step & (step - 1) == 0)

    @torch.no_grad()
    def refresh(self, distance: Distance) -> None:
        """Queries the field at all nodes."""
        self._nodes = self._nodes.to(self.values.device)
        values = query_nodes(self._nodes, distance)
        new = self._nodes.filled(values, 0.0)
        self.values.copy_(new.values)
        if float(self.error) < 0:
            places = self._nodes.near_surface(values, _TRIALS, torch.Generator().manual_seed(0))
            self.error.fill_(_SPREAD * float(differences(new, distance, places).mean()))

    @property
    def grid(self) -> SdfGrid | None:
        """The distances as they are now, or None before the first `refresh`."""
        error, low = float(self.error), self._nodes.low.to(self.values.device)
        return SdfGrid(self.values, low, self._nodes.voxel, error) if error >= 0 else None

    def recording(self, distance: Distance) -> Distance:
        """A wrapper of a field's distance that also records the residuals of the grid."""

        def recorded(x: Float[Tensor, "n 3"]) -> Float[Tensor, "n"]:
            sdf = distance(x)
            self.record(x, sdf)
            return sdf

        return recorded

    @torch.no_grad()
    def record(self, x: Float[Tensor, "n 3"], sdf: Float[Tensor, "n"]) -> None:
        """Records the residuals of the grid for `settle`: points and the field's distances there, metres."""
        grid = self.grid
        if grid is not None and len(x):
            self._recorded = add_residuals(grid, x, sdf, self._recorded)

    @torch.no_grad()
    def settle(self) -> None:
        r"""Applies the residuals recorded in a step to the nodes, and their mean to the error.

        \[ v_k \leftarrow v_k + \frac{\sum_i w_{ik} (s_i - \tilde s(x_i))}{\sum_i w_{ik}}, \qquad
            \epsilon \leftarrow 0.9 \, \epsilon + 0.1 \cdot 3 \, \overline{|s_i - \tilde s(x_i)|} \]

        with the trilinear weights $w_{ik}$ of the points $x_i$, of all processes.
        """
        grid = self.grid
        if grid is None:
            return
        # Also where this process has nothing to add: the others wait for it.
        self._recorded = self._recorded or _nothing(grid)
        pull, weight, sums = (summed_over_processes(tensor) for tensor in self._recorded)
        total, count = sums.tolist()
        if count:
            self.values += pull / weight.clamp_min(1e-6)
            self.error += _RECENT * (_SPREAD * total / count - self.error)
        for tensor in self._recorded:
            tensor.zero_()

    def take_on(self, state: dict[str, Tensor], prefix: str) -> None:
        """Puts what a run of an earlier version lacks into its state: a grid without values."""
        for name, own in self.state_dict().items():
            state.setdefault(prefix + name, own)


@torch.no_grad()
def add_residuals(
    grid: SdfGrid, x: Float[Tensor, "n 3"], sdf: Float[Tensor, "n"], recorded: Residuals | None = None
) -> Residuals:
    """Adds up by how much a grid is wrong at points, for each node around them.

    Args:
        grid: of distances.
        x: points, metres; those where the grid is not known are left out.
        sdf: what the distances there should be, metres.
        recorded: what was added up before, which is changed; None begins anew.

    Returns:
        each node's sum of weights times residuals, and of weights; sum and number of the absolute residuals.
    """
    pull, weight, sums = recorded = recorded or _nothing(grid)
    if not x.is_cuda and x.dtype == torch.float32:
        given = (t.contiguous().numpy() for t in (x, sdf.float()))
        found = kernels.collect_residuals(*given, *grid.arrays()[:3], pull.numpy(), weight.numpy())
        sums += torch.tensor(found)
        return recorded
    middle, (index, weights) = grid.interpolate(x), grid.corners(x)
    known = (~middle.isnan()).nonzero()[:, 0]
    residual = sdf.to(middle.dtype)[known] - middle[known]
    index, weights = index[known].flatten(), weights[known].to(pull.dtype)
    pull.view(-1).index_add_(0, index, (weights * residual[:, None]).to(pull.dtype).flatten())
    weight.view(-1).index_add_(0, index, weights.flatten())
    sums[0] += residual.abs().sum()
    sums[1] += len(known)
    return recorded


def _nothing(grid: SdfGrid) -> Residuals:
    """Sums of no residuals."""
    one = torch.zeros_like(grid.values)
    return one, one.clone(), torch.zeros(2, dtype=torch.float64, device=one.device)
