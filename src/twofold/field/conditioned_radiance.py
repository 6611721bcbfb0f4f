"""Density and colour networks that see the view and a code for each frame (DANBO, NPC, PM-Avatar)."""

import math

import torch
from jaxtyping import Float
from torch import Tensor, nn

from twofold.field.output import RadianceOutput
from twofold.kernels.mlp import MLP, dense_layer

CODE_SIZE = 128
"""Numbers of a frame's code; when rendering a new pose the mean over the training frames is used."""


class ColorHead(nn.Module):
    """Colour from a hidden layer: c = 1.002 sigmoid(MLP(code, linear(h), view)) - 0.001.

    The slight excess over 0..1 lets pure black and white be reached. 65,792 parameters for the linear map of 256, and
    a hidden layer of 128.

    Args:
        view_size: columns of the encoded view.
        generator: draws the initial weights.
    """

    def __init__(self, view_size: int, generator: torch.Generator | None = None) -> None:
        super().__init__()
        bound = 1 / math.sqrt(256)
        self.feature = dense_layer(256, 256, bound, generator, bound)
        self.network = MLP(256 + view_size, [128], 3, CODE_SIZE, start="torch", generator=generator)

    def forward(
        self, hidden: Float[Tensor, "S 256"], view: Float[Tensor, "S v"], code: Float[Tensor, "c"]
    ) -> Float[Tensor, "S 3"]:
        """Colours, -0.001 to 1.001.

        Args:
            hidden: last hidden layer of the density network.
            view: encoded view direction of each sample.
            code: of the frame.
        """
        color = self.network(torch.cat([self.feature(hidden), view], -1), code)
        return 1.002 * color.sigmoid() - 0.001


class ConditionedRadiance(nn.Module):
    """Density ReLU(MLP(x) + noise) and colour of a feature.

    Eight hidden layers of 256, the input again before the sixth. With the colour head there
    are 679,812 parameters for DANBO (195 inputs, view of 27) and 971,780 for PM-Avatar (768, 16).

    Args:
        inputs: columns of the feature.
        view_size: columns of the encoded view.
        generator: draws the initial weights.
    """

    def __init__(self, inputs: int, view_size: int, generator: torch.Generator | None = None) -> None:
        super().__init__()
        self.density = MLP(inputs, [256] * 8, 1, skip_layer=5, start="torch", generator=generator)
        self.color = ColorHead(view_size, generator)

    def forward(
        self,
        feature: Float[Tensor, "S i"],
        view: Float[Tensor, "S v"],
        code: Float[Tensor, "c"],
        generator: torch.Generator | None = None,
    ) -> RadianceOutput:
        """Density per metre and colour.

        Args:
            feature: of each sample.
            view: encoded view direction of each sample.
            code: of the frame.
            generator: draws noise N(0, 1) onto the density before its ReLU (training); None adds none.
        """
        hidden = self.density.hidden(feature)
        raw = self.density.head(hidden)[:, 0]
        if generator is not None:
            noise = torch.randn(raw.shape, generator=generator, dtype=raw.dtype, device=generator.device)
            raw = raw + noise.to(raw.device)
        return RadianceOutput(raw.relu(), self.color(hidden, view, code))
