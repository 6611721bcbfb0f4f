"""Parameters that an optimizer treats alike."""

from dataclasses import dataclass

from torch import nn


@dataclass(frozen=True)
class ParameterGroup:
    """Trainable parameters that share a learning rate.

    Attributes:
        name: for messages.
        rate: learning rate before schedules.
        parameters: may be empty.
        by_visit: whether Adam's means of a row change only in steps that have a gradient for it (see `RowAdam`).
        decay_power: power of what the schedule multiplies all rates with; 2 lets this one fall twice as fast.
        shrinkage: factor of the noise by which steps by visits shrink (see `twofold.training.row_adam.shrink`).
    """

    name: str
    rate: float
    parameters: list[nn.Parameter]
    by_visit: bool = False
    decay_power: float = 1.0
    shrinkage: float = 0.0
