"""Adam whose large tables are updated row by row, and whose rows may each have means of their own."""

import math
from collections.abc import Callable, Iterable
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor, nn

from twofold.kernels.row_gradient import RowGradient, adam_rows
from twofold.kernels.visited_rows import visited_rows
from twofold.methods.base import Avatar
from twofold.methods.parameter_group import ParameterGroup
from twofold.recipe import TrainingConfig
from twofold.training.camera_colors import RATE, CameraColors

POOLED_VISITS = 64.0
"""Visits of all rows, weighted as in `signal_sums`, over which the share of signal is averaged."""
FEW_VISITS, ENOUGH_VISITS = 6, 10
"""Visits of a frame by which steps that shrink have at most two thirds, and five sixths, of their length (`shrink`)."""


def noise_share(visits: Float[Tensor, "rows"], beta: float) -> Float[Tensor, "rows"]:
    r"""What is left of the variance of independent gradients in Adam's mean of them.

    After $n$ visits the mean weights them by $w_i \propto \beta^{n - i}$, so

    \[ s_n = \sum_i w_i^2 = \frac{1 - \beta}{1 + \beta} \, \frac{1 - \beta^{2n}}{(1 - \beta^n)^2} \]

    >>> noise_share(torch.tensor([1.0, 1000.0]), 0.9)
    tensor([1.0000, 0.0526])

    Args:
        visits: $n$, at least one.
        beta: of the mean.
    """
    return (1 - beta) / (1 + beta) * (1 - beta ** (2 * visits)) / (1 - beta**visits) ** 2


def signal_sums(
    step: Float[Tensor, "rows *entries numbers"], noise: Float[Tensor, "rows"], beta: float
) -> Float[Tensor, "2 *entries"]:
    r"""How much of rows' gradients is the same in every visit, as a weighted sum, and the sum of weights.

    Of gradients with a mean and independent noise the share $\kappa$ of the mean in the mean square follows from
    $\hat m^2 / \hat v \approx \kappa + (1 - \kappa) s_n$, so

    \[ \hat\kappa = \frac{\hat m^2 / \hat v - s_n}{1 - s_n}, \qquad w = \Big( \frac{s_\infty}{s_n} \Big)^2 \]

    Weights are inverse variances under noise, relative to many visits. Numbers that never had a gradient say nothing
    and have no weight.

    >>> sums = signal_sums(torch.tensor([[0.0, 0.5, 0.5]]), torch.tensor([1 / 19]), 0.9)
    >>> [round(value, 3) for value in sums.tolist()]
    [0.417, 2.0]

    Args:
        step: $\hat m / \sqrt{\hat v}$ of rows with two visits or more, 0 where there never was a gradient.
        noise: $s_n$ of each row by `noise_share`.
        beta: of the mean.
    """
    s = noise.view(-1, *[1] * (step.dim() - 1))
    weight = (step != 0) * ((1 - beta) / (1 + beta) / s) ** 2
    share = (step.square() - s) / (1 - s)
    return torch.stack([(weight * share).sum((0, -1)), weight.sum((0, -1))])


def shrink(
    step: Float[Tensor, "rows *entries numbers"], share: Float[Tensor, "*entries"], noise: Float[Tensor, "rows"],
    shrinkage: float,
) -> Float[Tensor, "rows *entries numbers"]:  # fmt: skip
    r"""Steps shrunk as in Wiener's filter, with the noise counted $c$ times.

    \[ \Delta' = \max\Big(0, 1 - \frac{c}{\rho}\Big) \, \Delta, \qquad
    \rho = \frac{\kappa + (1 - \kappa) s_n}{s_n} \]

    where $\rho$ is the mean square of Adam's mean after $n$ visits, relative to that of noise alone: 1 without a
    signal, and at most $1 / s_n$. Gradients of exact poses are noise of the images' rays, and steps of full length
    would make them worse; those of poses that are off agree from visit to visit. After one visit nothing is known, and
    nothing moves if $c \ge 1$.

    >>> noise = torch.tensor([1 / 19])
    >>> shrink(torch.tensor([[1.0, -1.0]]), torch.tensor(1 / 9), noise, 1.5)
    tensor([[ 0.5000, -0.5000]])
    >>> shrink(torch.tensor([[1.0, -1.0]]), torch.tensor(0.01), noise, 1.5)
    tensor([[0., -0.]])

    Args:
        step: $\Delta$.
        share: $\kappa$ by `signal_sums`; negative where it was estimated so.
        noise: $s_n$ of each row by `noise_share`.
        shrinkage: $c$.
    """
    ratio = 1 + share[..., None] * (1 / noise.view(-1, *[1] * (step.dim() - 1)) - 1)
    return step * (1 - shrinkage / ratio.clamp_min(1e-6)).clamp_min(0)


def visited_rows_in_torch(
    table: Float[Tensor, "rows *numbers"], first: Float[Tensor, "rows *numbers"],
    second: Float[Tensor, "rows *numbers"], gradient: Float[Tensor, "rows *numbers"], visits: Float[Tensor, "rows"],
    sums: Float[Tensor, "2 *entries"] | None, rate: float, betas: tuple[float, float], epsilon: float,
    shrinkage: float, pooled: float,
) -> None:  # fmt: skip
    """What `twofold.kernels.visited_rows.visited_rows` does, for any device and precision."""
    beta1, beta2 = betas
    seen = gradient.reshape(len(gradient), -1).abs().amax(1).nonzero()[:, 0]
    g = gradient[seen]
    visits[seen] += 1
    times = visits[seen].view(-1, *[1] * (table.dim() - 1))
    first[seen] = beta1 * first[seen] + (1 - beta1) * g
    second[seen] = beta2 * second[seen] + (1 - beta2) * g.square()
    root = (second[seen] / (1 - beta2**times)).sqrt() + epsilon
    step = first[seen] / (1 - beta1**times) / root
    if sums is not None:
        rows = step if step.dim() > 1 else step[:, None]
        known, noise = visits[seen] >= 2, noise_share(visits[seen], beta1)
        if known.any():
            new = signal_sums(rows[known], noise[known], beta1) / rows.shape[-1]
            sums.mul_(1 - (new[1] / pooled).clamp_max(1)).add_(new)
        step = shrink(rows, sums[0] / (sums[1] + 1), noise, shrinkage).view_as(step)
    table[seen] -= rate * step


def few_visits(groups: Iterable[ParameterGroup], training: TrainingConfig, times: int) -> str | None:
    """What to tell the user where corrections of poses shrink and frames are visited too seldom for that; else None.

    Args:
        groups: of the avatar.
        training: steps and images a step.
        times: that the training images show; images of one time, from several cameras, share a correction.
    """
    visits = training.steps * training.images_per_step / times
    if visits >= FEW_VISITS or not any(group.shrinkage and group.parameters for group in groups):
        return None
    enough = math.ceil(ENOUGH_VISITS * times / training.images_per_step)
    return (
        f"Each pose is seen {visits:.2g} times in {training.steps:,} steps, and correcting it takes about "
        f"{ENOUGH_VISITS}: poses will stay almost as the capture gives them. --steps {enough} corrects them."
    )


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
                elif _by_visit(parameter, group) and parameter.grad is not None:
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
        first, second = self._advanced(table)
        number = int(self.state[table]["step"])
        adam_rows(table, first, second, gradient, group["lr"], number, group["betas"], group["eps"])

    def _step_visited(self, table: nn.Parameter, group: dict[str, Any]) -> None:
        gradient, table.grad = table.grad, None
        if gradient is None:
            return
        first, second = self._advanced(table)
        state, shrinkage, sums = self.state[table], group.get("shrinkage") or 0.0, None
        if "visits" not in state:
            state["visits"] = torch.zeros(len(table), device=table.device)
        if shrinkage:
            if "signal_sums" not in state:
                state["signal_sums"] = torch.zeros(2, *table.shape[1:-1], device=table.device)
            sums = state["signal_sums"]
        step = visited_rows if _compiles(table) and _compiles(first) and _compiles(second) else visited_rows_in_torch
        step(
            table, first, second, gradient, state["visits"], sums, group["lr"], group["betas"], group["eps"], shrinkage,
            POOLED_VISITS,
        )  # fmt: skip

    def _advanced(self, table: nn.Parameter) -> tuple[Tensor, Tensor]:
        """The means of a table's gradients and of their squares, zero at first; counts the step."""
        state = self.state[table]
        if not state:
            state["step"] = torch.zeros((), dtype=torch.float32)
            state["exp_avg"], state["exp_avg_sq"] = torch.zeros_like(table), torch.zeros_like(table)
        state["step"] += 1
        return state["exp_avg"], state["exp_avg_sq"]

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """See `torch.optim.Optimizer.load_state_dict`; rows that had a gradient are known by their squares."""
        super().load_state_dict(state_dict)
        for table, gradient in self.rows.items():
            if self.state[table]:
                gradient.know(self.state[table]["exp_avg_sq"])


def _by_visit(parameter: nn.Parameter, group: dict[str, Any]) -> bool:
    """Whether rows have visits of their own. A list of numbers that all steps see needs them for shrinkage only.

    A body model without shapes has an empty list of them.
    """
    return bool(group.get("by_visit") and len(parameter) and (parameter.dim() > 1 or group.get("shrinkage")))


def _compiles(tensor: Tensor) -> bool:
    """Whether compiled loops can change a tensor in place."""
    return tensor.device.type == "cpu" and tensor.dtype == torch.float32 and tensor.is_contiguous()


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
