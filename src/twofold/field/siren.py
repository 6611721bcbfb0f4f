"""Layers with sines for activations (SIREN, Sitzmann et al. 2020), plain and modulated by other numbers."""

import math

import torch
from jaxtyping import Float
from torch import Tensor, nn

from twofold.kernels.mlp import dense_layer

MODULATION_SCALE, MODULATION_OFFSET = 15.0, 30.0


def siren_bound(inputs: int, frequency: float) -> float:
    r"""Bound of the uniform initial weights of a layer after the first: sqrt(6 / inputs) / frequency.

    \[ \frac{1}{\omega} \sqrt{6 / n} \]

    >>> siren_bound(6, frequency=4.0)
    0.25
    """
    return math.sqrt(6 / inputs) / frequency


def siren_linear(
    inputs: int, outputs: int, frequency: float, generator: torch.Generator | None = None, is_first: bool = False
) -> nn.Linear:
    r"""A linear layer whose weights start at U(+-1 / inputs) for a first layer, else U(+-`siren_bound`).

    \[ W \sim U(\pm 1 / n) \text{ in a first layer, else } U\Big(\pm \tfrac{1}{\omega} \sqrt{6 / n}\Big),
    \qquad b \sim U(\pm 1 / \sqrt n) \]

    >>> layer = siren_linear(6, 500, frequency=4.0, generator=torch.Generator().manual_seed(0))
    >>> bool(0.24 < layer.weight.abs().max() <= 0.25)
    True

    Biases start at U(+-1 / sqrt(inputs)).
    """
    bound = 1 / inputs if is_first else siren_bound(inputs, frequency)
    return dense_layer(inputs, outputs, bound, generator, 1 / math.sqrt(inputs))


class SineLayer(nn.Module):
    """sin(w (W x + b)) with a fixed frequency w; see `siren_linear` for the initial weights."""

    def __init__(
        self,
        inputs: int,
        outputs: int,
        frequency: float,
        generator: torch.Generator | None = None,
        is_first: bool = False,
    ) -> None:
        super().__init__()
        self.linear = siren_linear(inputs, outputs, frequency, generator, is_first)
        self.frequency = frequency

    def forward(self, x: Float[Tensor, "*b i"]) -> Float[Tensor, "*b o"]:
        """The layer's activations."""
        return torch.sin(self.frequency * self.linear(x))


def modulated_sine(
    x: Float[Tensor, "*b n"], frequency: Float[Tensor, "*b n"], phase: Float[Tensor, "*b n"]
) -> Float[Tensor, "*b n"]:
    r"""sin((15 f + 30) x + phase): a layer's frequencies and phases come from another network (pi-GAN, PM-Avatar).

    \[ \sin\big((15 f + 30) x + \phi\big) \]

    >>> modulated_sine(torch.ones(1), torch.tensor([-2.0]), torch.zeros(1))
    tensor([0.])
    """
    return torch.sin((MODULATION_SCALE * frequency + MODULATION_OFFSET) * x + phase)
