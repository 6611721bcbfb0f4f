"""NPC's background: a colour for each pixel of the training camera, conditioned on the frame's code."""

import torch
from jaxtyping import Float
from torch import Tensor, nn

from twofold.field.conditioned_radiance import CODE_SIZE
from twofold.field.encoding import encoding_size, fourier_encoding
from twofold.kernels.mlp import MLP

PIXEL_OCTAVES = 5


class PixelBackground(nn.Module):
    """b + MLP(encoded pixel, b, code) with two hidden layers of 256 (105,987 parameters)."""

    def __init__(self, generator: torch.Generator | None = None) -> None:
        super().__init__()
        inputs = encoding_size(PIXEL_OCTAVES, 2) + 3
        self.network = MLP(inputs, [256, 256], 3, CODE_SIZE, start="torch", generator=generator)

    def forward(
        self, pixels: Float[Tensor, "R 2"], background: Float[Tensor, "R 3"], code: Float[Tensor, "c"]
    ) -> Float[Tensor, "R 3"]:
        """Colours of the background at pixels.

        Args:
            pixels: (column, row) over the image's width and height, 0..1.
            background: colour behind the person that is known beforehand, 0..1.
            code: of the frame.
        """
        encoded = fourier_encoding(pixels, PIXEL_OCTAVES, include_pi=False)
        return background + self.network(torch.cat([encoded, background], -1), code)
