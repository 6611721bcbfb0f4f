"""Adam whose large tables are updated row by row, and whose rows may each have means of their own."""

from collections.abc import Callable, Iterable
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor, nn

from twofold.kernels.row_gradient import RowGradient, adam_rows
from twofold.methods.base import Avatar
from twofold.recipe import TrainingConfig
from twofold.training.camera_colors import RATE, CameraColors

KNOWN_VISITS = 3
"""Visits after which a row's mean gradient is compared with its noise."""
POOLED_VISITS = 64
"""Visits of all rows over which that comparison is averaged."""


def signal_to_noise(
    step: Float[Tensor, "rows *entries numbers"], visits: Float[Tensor, "rows"], beta: float
) -> Float[Tensor, "1 *entries 1"]:
    r"""How much larger rows' mean gradients are than gradients of independent noise would have left them.

    After $n$ visits Adam's mean $\hat m$ weights them by $w_i \propto \beta^{n - i}$, and of noise alone it has the
    variance $s_n \hat v$, so

    \[ \rho = \operatorname{mean}\Big(\frac{\hat m^2}{s_n \hat v}\Big), \qquad
    s_n = \sum_i w_i^2 = \frac{1 - \beta}{1 + \beta} \, \frac{1 - \beta^{2n}}{(1 - \beta^n)^2} \]

    over the rows and the last axis is about 1 for noise, and larger where visits agree.

    >>> signal_to_noise(torch.full((2, 3), 0.5), torch.tensor([1.0, 1.0]), 0.9)
    tensor([[0.2500]])

    Args:
        step: $\hat m / \sqrt{\hat v}$.
        visits: of each row, at least one.
        beta: of the mean.
    """
    n = visits.view(-1, *[1] * (step.dim() - 1))
    noise = (1 - beta) / (1 + beta) * (1 - beta ** (2 * n)) / (1 - beta**n) ** 2
    return (step.square() / noise).mean((0, -1), keepdim=True)


def shrink(
    step: Float[Tensor, "rows *entries numbers"], ratio: Float[Tensor, "1 *entries 1"], shrinkage: float
) -> Float[Tensor, "rows *entries numbers"]:
    r"""Steps shrunk as in Wiener's filter, with the noise counted $c$ times.

    \[ \Delta' = \max\Big(0, 1 - \frac{c}{\rho}\Big) \, \Delta \]

    Gradients of exact poses are noise of the images' rays, and steps of full length would make them worse; those of
    poses that are off agree from visit to visit.

    >>> shrink(torch.tensor([[1.0, -1.0]]), torch.tensor([[3.0]]), 1.5)
    tensor([[ 0.5000, -0.5000]])
    >>> shrink(torch.tensor([[1.0, -1.0]]), torch.tensor([[1.2]]), 1.5)
    tensor([[0., -0.]])

    Args:
        step: $\Delta$.
        ratio: $\rho$ of `signal_to_noise`.
        shrinkage: $c$.
    """
    return step * (1 - shrinkage / ratio.clamp_min(1e-6)).clamp_min(0)


class RowAdam(torch.optim.Adam):
    """Adam; parameters with a `RowGradient` are updated by it, and make the same steps.

    In groups marked `by_visit` the means of a row's gradients change only in steps that have a gradient for it. A table
    of frames of which each step sees one needs that: else the mean of a frame's gradients has long decayed when the
    frame comes again, each gradient moves it by ten rates whatever its size, and noise is never averaged.

    Steps of such a table may shrink where its gradients are noise (`shrink`).
    """

    def __init__(
        self, groups: Iterable[dict[str, Any]], rows: dict[nn.Parameter, RowGradient], betas: tuple[float, float],
        eps: float,
    ) -> None:  # fmt: skip
        """Groups as for `torch.optim.Adam`; `rows` may be empty."""
        super().__init__(groups, betas=betas, eps=eps, fused=True)
        self.rows = rows

    @torch.no_grad()
    def step(self, closure: Callable[[], float] | None = None) -> float | None:  # type: ignore[override]
        """One step of all parameters."""
        for group in self.param_groups:
            for parameter in group["params"]:
                if parameter in self.rows:
                    self._step_rows(parameter, group)
                elif group.get("by_visit") and parameter.dim() > 1 and parameter.grad is not None:
                    self._step_visited(parameter, group)
        return super().step(closure)

    def _step_rows(self, table: nn.Parameter, group: dict[str, Any]) -> None:
        gradient = self.rows[table]
        if table.grad is not None:
            # Operations that know nothing of rows leave an ordinary gradient.
            gradient.add(table.grad)
            table.grad = None
        if not self.state[table] and not gradient.marks.any():
            return
        first, second, step = self._advanced(table)
        adam_rows(table, first, second, gradient, group["lr"], step, group["betas"], group["eps"])

    def _step_visited(self, table: nn.Parameter, group: dict[str, Any]) -> None:
        gradient, (beta1, beta2) = table.grad, group["betas"]
        if gradient is None:
            return
        first, second, _ = self._advanced(table)
        count = self.state[table].setdefault("visits", torch.zeros(len(table), device=table.device))
        seen = gradient.flatten(1).abs().amax(1).nonzero()[:, 0]
        g, table.grad = gradient[seen], None
        count[seen] += 1
        times = count[seen].view(-1, *[1] * (table.dim() - 1))
        first[seen] = beta1 * first[seen] + (1 - beta1) * g
        second[seen] = beta2 * second[seen] + (1 - beta2) * g.square()
        root = (second[seen] / (1 - beta2**times)).sqrt() + group["eps"]
        step = first[seen] / (1 - beta1**times) / root
        if group.get("shrinkage"):
            step = self._shrunk(table, step, count, seen, group)
        table[seen] -= group["lr"] * step

    def _shrunk(self, table: nn.Parameter, step: Tensor, count: Tensor, seen: Tensor, group: dict[str, Any]) -> Tensor:
        """The steps of the rows seen, shrunk by what all rows' last visits say of signal and noise."""
        entries = (1, *table.shape[1:-1], 1)
        state = self.state[table]
        ratio = state.setdefault("signal_to_noise", torch.ones(entries, device=table.device))
        known = count[seen] >= KNOWN_VISITS
        rows = float(known.sum())
        if rows:
            total = float((count - KNOWN_VISITS + 1).clamp_min(0).sum())
            found = signal_to_noise(step[known], count[seen][known], group["betas"][0])
            ratio += min(rows * max(1 / (total + 1), 1 / POOLED_VISITS), 1.0) * (found - ratio)
        return shrink(step, ratio, group["shrinkage"])

    def _advanced(self, table: nn.Parameter) -> tuple[Tensor, Tensor, int]:
        """The means of a table's gradients and of their squares, zero at first, and the number of this step."""
        state = self.state[table]
        if not state:
            state["step"] = torch.zeros((), dtype=torch.float32)
            state["exp_avg"], state["exp_avg_sq"] = torch.zeros_like(table), torch.zeros_like(table)
        state["step"] += 1
        return state["exp_avg"], state["exp_avg_sq"], int(state["step"])

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """See `torch.optim.Optimizer.load_state_dict`; rows that had a gradient are known by their squares."""
        super().load_state_dict(state_dict)
        for table, gradient in self.rows.items():
            if self.state[table]:
                gradient.know(self.state[table]["exp_avg_sq"])


def make_optimizer(
    avatar: Avatar, config: TrainingConfig, colors: CameraColors | None = None, alone: bool = True
) -> torch.optim.Optimizer:
    """Adam with one learning rate a parameter group, the training cameras' colours last.

    Large tables are updated row by row where a process trains `alone`.
    """
    groups = [
        {
            "params": g.parameters,
            "lr": g.rate,
            "name": g.name,
            "by_visit": g.by_visit,
            "decay_power": g.decay_power,
            "shrinkage": g.shrinkage,
        }
        for g in avatar.parameter_groups()
        if g.parameters
    ]
    if colors is not None:
        own = list(colors.parameters())
        groups.append({"params": own, "lr": RATE, "name": "camera colours", "by_visit": False, "decay_power": 1.0})
    # Clipping, and the mean over processes, need ordinary gradients.
    rows = avatar.row_gradients(collect=alone and config.clip == 0)
    return RowAdam(groups, rows, config.adam_betas, config.adam_epsilon)
