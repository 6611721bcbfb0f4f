"""Multilayer perceptrons with ReLU, and the initial weights that the authors of the baselines give them.

Networks whose spatial gradient is needed are in `field.networks`; these ones only give values.
"""

import math
from collections.abc import Sequence
from typing import Literal, cast

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional as F
from torch.nn.utils import skip_init

RELU_GAIN = math.sqrt(2)
"""Gain of `xavier_bound` for a layer that a ReLU follows."""

Start = Literal["xavier", "torch"]
"""Initial weights: `xavier_bound` with zero biases, or the usual ones of `torch.nn.Linear`, U(+-1 / sqrt(fan in))."""


def xavier_bound(fan_in: int, fan_out: int, gain: float) -> float:
    """Bound of the uniform initial weights of HumanNeRF and MonoHuman: sqrt(3) g sqrt(2 / (fan_in + fan_out)).

    >>> round(xavier_bound(3, 3, gain=1.0), 6)
    1.0

    Args:
        fan_in: inputs of a unit.
        fan_out: units that an input reaches.
        gain: of the activation that follows: sqrt 2 for ReLU, 1 for none.
    """
    return math.sqrt(3) * gain * math.sqrt(2 / (fan_in + fan_out))


def uniform(shape: Sequence[int], bound: float, generator: torch.Generator | None) -> Float[Tensor, "*shape"]:
    """Numbers drawn uniformly from -bound to bound."""
    return (2 * torch.rand(tuple(shape), generator=generator) - 1) * bound


def dense_layer(
    inputs: int, outputs: int, bound: float, generator: torch.Generator | None, bias_bound: float = 0.0
) -> nn.Linear:
    """A linear layer with weights U(+-bound) and biases U(+-bias_bound)."""
    layer = cast(nn.Linear, skip_init(nn.Linear, inputs, outputs))
    with torch.no_grad():
        layer.weight.copy_(uniform((outputs, inputs), bound, generator))
        layer.bias.copy_(uniform((outputs,), bias_bound, generator))
    return layer


class MLP(nn.Module):
    """Dense layers with ReLU between them.

    Args:
        inputs: columns that differ from sample to sample.
        widths: units of each hidden layer.
        outputs: columns of the result.
        constants: input columns that are the same for all samples of a call, before the others (a pose).
        skip_layer: index of the hidden layer that sees the inputs (not the constants) again; None for none.
        skip_first: there the inputs stand before the hidden units, not after them.
        start: initial weights.
        last_bound: the last layer starts at U(+-last_bound) with zero biases instead; None for `start`.
        generator: draws the initial weights.
    """

    def __init__(
        self,
        inputs: int,
        widths: Sequence[int],
        outputs: int,
        constants: int = 0,
        skip_layer: int | None = None,
        skip_first: bool = True,
        start: Start = "xavier",
        last_bound: float | None = None,
        generator: torch.Generator | None = None,
    ) -> None:
        super().__init__()
        # Type that the layers between the first and the last compute in; None for that of the parameters.
        self.hidden_dtype: torch.dtype | None = None
        if skip_layer is not None and not 0 < skip_layer < len(widths):
            raise ValueError(f"skip_layer={skip_layer} is no hidden layer after the first of {len(widths)}")
        self.inputs, self.constants = inputs, constants
        self.skip_layer, self.skip_first = skip_layer, skip_first
        columns = [inputs + constants, *widths]
        if skip_layer is not None:
            columns[skip_layer] += inputs
        rows = [*widths, outputs]
        layers: list[nn.Linear] = []
        for index, (fan_in, fan_out) in enumerate(zip(columns, rows, strict=True)):
            is_last = index == len(widths)
            if is_last and last_bound is not None:
                layers.append(dense_layer(fan_in, fan_out, last_bound, generator))
            elif start == "xavier":
                gain = 1.0 if is_last else RELU_GAIN
                layers.append(dense_layer(fan_in, fan_out, xavier_bound(fan_in, fan_out, gain), generator))
            else:
                bound = 1 / math.sqrt(fan_in)
                layers.append(dense_layer(fan_in, fan_out, bound, generator, bound))
        self.layers = nn.ModuleList(layers)

    def forward(self, x: Float[Tensor, "S i"], constant: Float[Tensor, "c"] | None = None) -> Float[Tensor, "S o"]:
        """The last layer at each sample, without an activation; `constant` holds the inputs that all samples share."""
        return self.head(self.hidden(x, constant))

    def hidden(self, x: Float[Tensor, "S i"], constant: Float[Tensor, "c"] | None = None) -> Float[Tensor, "S w"]:
        """Activations of the last hidden layer."""
        given = 0 if constant is None else len(constant)
        if given != self.constants:
            raise ValueError(f"the network takes {self.constants} constant inputs, {given} were given")
        h = x
        for index in range(len(self.layers) - 1):
            layer = self._layer(index)
            if index == self.skip_layer:
                h = torch.cat([x, h] if self.skip_first else [h, x], -1)
            weight, bias = layer.weight, layer.bias
            if index == 0 and constant is not None:
                # The same product for all samples, so it is taken once and becomes part of the bias.
                weight, bias = weight[:, given:], bias + weight[:, :given] @ constant
            if index > 0 and self.hidden_dtype is not None:
                h, weight, bias = (t.to(self.hidden_dtype) for t in (h, weight, bias))
            h = F.relu(F.linear(h, weight, bias))
        return h.to(x.dtype)

    def head(self, hidden: Float[Tensor, "S w"]) -> Float[Tensor, "S o"]:
        """The last layer alone."""
        return self._layer(len(self.layers) - 1)(hidden)

    def _layer(self, index: int) -> nn.Linear:
        return cast(nn.Linear, self.layers[index])
