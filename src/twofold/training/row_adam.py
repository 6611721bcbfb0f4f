"""Adam whose large tables are updated row by row."""

from collections.abc import Callable, Iterable
from typing import Any

import torch
from torch import nn

from twofold.kernels.row_gradient import RowGradient, adam_rows


class RowAdam(torch.optim.Adam):
    """Adam; parameters with a `RowGradient` are updated by it, and make the same steps."""

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
        return super().step(closure)

    def _step_rows(self, table: nn.Parameter, group: dict[str, Any]) -> None:
        gradient = self.rows[table]
        if table.grad is not None:
            # Operations that know nothing of rows leave an ordinary gradient.
            gradient.add(table.grad)
            table.grad = None
        state = self.state[table]
        if not state:
            if not gradient.marks.any():
                return
            state["step"] = torch.zeros((), dtype=torch.float32)
            state["exp_avg"], state["exp_avg_sq"] = torch.zeros_like(table), torch.zeros_like(table)
        state["step"] += 1
        moments = state["exp_avg"], state["exp_avg_sq"]
        adam_rows(table, *moments, gradient, group["lr"], int(state["step"]), group["betas"], group["eps"])

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """See `torch.optim.Optimizer.load_state_dict`; rows that have had a gradient are known by their moments."""
        super().load_state_dict(state_dict)
        for table, gradient in self.rows.items():
            if self.state[table]:
                gradient.know(self.state[table]["exp_avg_sq"])
