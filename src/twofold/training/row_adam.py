"""Adam whose large tables are updated row by row, and whose rows may each have means of their own."""

from collections.abc import Callable, Iterable
from typing import Any

import torch
from torch import Tensor, nn

from twofold.kernels.row_gradient import RowGradient, adam_rows
from twofold.methods.base import Avatar
from twofold.recipe import TrainingConfig
from twofold.training.camera_colors import RATE, CameraColors


class RowAdam(torch.optim.Adam):
    """Adam; parameters with a `RowGradient` are updated by it, and make the same steps.

    In groups marked `by_visit` the means of a row's gradients change only in steps that have a gradient for it. A table
    of frames of which each step sees one needs that: else the mean of a frame's gradients has long decayed when the
    frame comes again, each gradient moves it by ten rates whatever its size, and noise is never averaged.
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
        table[seen] -= group["lr"] * first[seen] / (1 - beta1**times) / root

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
        {"params": g.parameters, "lr": g.rate, "name": g.name, "by_visit": g.by_visit, "decay_power": g.decay_power}
        for g in avatar.parameter_groups()
        if g.parameters
    ]
    if colors is not None:
        own = list(colors.parameters())
        groups.append({"params": own, "lr": RATE, "name": "camera colours", "by_visit": False, "decay_power": 1.0})
    # Clipping, and the mean over processes, need ordinary gradients.
    rows = avatar.row_gradients(collect=alone and config.clip == 0)
    return RowAdam(groups, rows, config.adam_betas, config.adam_epsilon)
