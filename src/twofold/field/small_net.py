"""The small network of a feature grid's branch: two hidden layers, and their reverse pass by hand."""

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from twofold.field.fused import Net


class SmallNet(nn.Module):
    """Two hidden layers whose input gradient is a second, hand-written pass."""

    def __init__(
        self, inputs: int, width: int, outputs: int, condition: int, generator: torch.Generator | None
    ) -> None:
        """He-initialised layers; the last one starts near zero, so a branch starts as a small correction."""
        super().__init__()
        self.first = nn.Linear(inputs, width)
        self.second = nn.Linear(width, width)
        self.last = nn.Linear(width, outputs)
        self.condition = nn.Linear(condition, width, bias=False) if condition else None
        for layer, gain in ((self.first, 1.0), (self.second, 1.0), (self.last, 0.1)):
            nn.init.kaiming_normal_(layer.weight, generator=generator)
            layer.weight.data *= gain
            nn.init.zeros_(layer.bias)
        if self.condition is not None:
            nn.init.kaiming_normal_(self.condition.weight, generator=generator)

    def forward(self, x: Tensor, condition: Tensor | None) -> tuple[Tensor, tuple[Tensor, Tensor]]:
        """Outputs and the tape that `pullback` needs."""
        first, bias, *_ = self.at(condition)
        a = F.relu(F.linear(x, first, bias))
        b = F.relu(self.second(a))
        return self.last(b), (a, b)

    def at(self, condition: Tensor | None) -> Net:
        """Weight and bias of each layer, with the condition in the first bias."""
        bias = self.first.bias
        if self.condition is not None and condition is not None:
            # One pose a call: its part of the first layer is a bias, not a column of every sample.
            bias = bias + self.condition(condition)
        return self.first.weight, bias, self.second.weight, self.second.bias, self.last.weight, self.last.bias

    def pullback(self, tape: tuple[Tensor, Tensor], cotangent: Tensor) -> Tensor:
        """Cotangent of the input from that of the output."""
        a, b = tape
        u = (cotangent @ self.last.weight) * (b > 0)
        return ((u @ self.second.weight) * (a > 0)) @ self.first.weight
