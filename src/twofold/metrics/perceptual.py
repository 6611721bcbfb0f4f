"""LPIPS: how different two images look to a network that knows photographs (Zhang et al. 2018).

Its weights are files that others have published and that do not come with this package; `weights_hint` says which.
"""

from pathlib import Path
from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional as F

from twofold.metrics.published_weights import (
    WeightFile,
    find_weights,
    missing_cell,
    missing_sentence,
    read_weights,
)

Network = Literal["vgg", "alex"]
"""VGG16 or AlexNet."""
VGG_FILE, ALEX_FILE = "vgg16-397923af.pth", "alexnet-owt-7be5be79.pth"
"""torchvision's networks, trained on ImageNet."""
LINEAR_FILE, ALEX_LINEAR_FILE = "vgg.pth", "alex.pth"
"""The lpips package's weights of the five feature layers, version 0.1."""
_TORCHVISION = "https://download.pytorch.org/models/"
_LPIPS = "https://github.com/richzhang/PerceptualSimilarity (lpips/weights/v0.1/{})"


def _linear(name: str, sha256: str, network: str) -> WeightFile:
    packages = (f"lpips/weights/v0.1/{name}", f"torchmetrics/functional/image/lpips_models/{name}")
    return WeightFile(name, sha256, f"the lpips package's v0.1 {network} weights", _LPIPS.format(name), packages)


FILES: dict[Network, tuple[WeightFile, WeightFile]] = {
    "vgg": (
        WeightFile(VGG_FILE, "397923af", "torchvision's VGG16", _TORCHVISION + VGG_FILE),
        _linear(LINEAR_FILE, "a78928a0af1e5f0fcb1f3b9e8f8c3a2a5a3de244d830ad5c1feddc79b8432868", "VGG"),
    ),
    "alex": (
        WeightFile(ALEX_FILE, "7be5be79", "torchvision's AlexNet", _TORCHVISION + ALEX_FILE),
        _linear(ALEX_LINEAR_FILE, "df73285e35b22355a2df87cdb6b70b343713b667eddbda73e1977e0c860835c0", "AlexNet"),
    ),
}
"""Trained network and feature layers' weights of each kind."""

_BLOCKS = ((64, 64), (128, 128), (256, 256, 256), (512, 512, 512), (512, 512, 512))
"""Channels of VGG16's convolutions; a maximum over 2 x 2 pixels stands between two blocks."""
_ALEX = ((64, 11, 4, 2), (192, 5, 1, 2), (384, 3, 1, 1), (256, 3, 1, 1), (256, 3, 1, 1))
"""AlexNet's convolutions: channels, kernel, stride, padding; each is a block of its own."""
_ALEX_POOLED = (1, 2)
"""Blocks before which AlexNet takes the maximum over 3 x 3 pixels, every second one."""
_SHIFT, _SCALE = (-0.030, -0.088, -0.188), (0.458, 0.448, 0.450)


class LPIPS(nn.Module):
    r"""Perceptual distance over a network's features, version 0.1. Its weights are fixed; gradients reach the images.

    $$d(x, y) = \sum_l \frac{1}{|P_l|} \sum_{p \in P_l} \sum_c w_{lc} \big( \hat f_{lpc}(x) - \hat f_{lpc}(y) \big)^2$$

    with the features $f_l$ after the last ReLU of each block, each pixel's divided by their length.

    Args:
        channels: of the network's convolutions, block by block; VGG16's unless a test wants a small one.
        alex: AlexNet instead.

    Attributes:
        verified: whether its weights are the published ones.
    """

    def __init__(self, channels: tuple[tuple[int, ...], ...] = _BLOCKS, alex: bool = False) -> None:
        super().__init__()
        self.alex, self.verified = alex, False
        if alex:
            channels = tuple((block[0],) for block in _ALEX)
        blocks: list[nn.Module] = []
        inputs = 3
        for i, block in enumerate(channels):
            layers: list[nn.Module] = []
            kernel, stride, padding = _ALEX[i][1:] if alex else (3, 1, 1)
            for outputs in block:
                layers.append(nn.Conv2d(inputs, outputs, kernel, stride, padding))
                inputs = outputs
            blocks.append(nn.ModuleList(layers))
        self.blocks = nn.ModuleList(blocks)
        self.linear = nn.ParameterList([torch.zeros(block[-1]) for block in channels])
        self.shift = nn.Parameter(torch.tensor(_SHIFT)[:, None, None])
        self.scale = nn.Parameter(torch.tensor(_SCALE)[:, None, None])
        self.requires_grad_(False)

    def forward(
        self, first: Float[Tensor, "n 3 h w"], second: Float[Tensor, "n 3 h w"], dropout: float = 0.0,
        generator: torch.Generator | None = None,
    ) -> Float[Tensor, "n"]:  # fmt: skip
        """Distance of each pair of images, 0 for equal ones.

        Args:
            first: colours 0..1, at least 16 pixels high and wide; 31 for AlexNet.
            second: the same.
            dropout: chance of each squared difference of features to be left out; the others are scaled up to match.
            generator: draws which are left out.
        """
        least = 31 if self.alex else 16
        if min(first.shape[-2:]) < least:
            have = tuple(first.shape[-2:])
            raise ValueError(f"LPIPS needs images of at least {least} x {least} pixels, these have {have}")
        # One pass over both: convolutions are faster on larger batches.
        x = (2 * torch.cat([first, second]) - 1 - self.shift) / self.scale
        distance = torch.zeros_like(first[:, 0, 0, 0])
        for i, (block, weight) in enumerate(zip(self.blocks, self.linear, strict=True)):
            if i in (_ALEX_POOLED if self.alex else range(1, len(self.blocks))):
                x = F.max_pool2d(x, 3 if self.alex else 2, 2)
            assert isinstance(block, nn.ModuleList)
            for convolution in block:
                x = F.relu(convolution(x))
            one, other = (x / (torch.linalg.vector_norm(x, dim=1, keepdim=True) + 1e-10)).chunk(2)
            squared = (one - other).square()
            if dropout:
                chance = torch.rand(squared.shape, generator=generator, device=generator.device if generator else None)
                squared = squared * (chance.to(squared.device) >= dropout) / (1 - dropout)
            distance = distance + (squared * weight[:, None, None]).sum(1).mean((1, 2))
        return distance


def weights_hint(folder: Path | None = None, network: Network = "vgg") -> str:
    """One sentence: which files LPIPS needs, where they are published and where to put them."""
    return missing_sentence("LPIPS", FILES[network], folder)


def lpips_cell(folder: Path | None = None, network: Network = "vgg") -> str:
    """What stands in a table in place of LPIPS where its weights are absent."""
    return missing_cell(FILES[network], folder)


def load_lpips(
    folder: Path | None = None, network: Network = "vgg", unverified: bool | None = None
) -> LPIPS | None:  # fmt: skip
    """LPIPS with its published weights, or None where a file is missing; then show `weights_hint`.

    Args:
        folder: holds the two files; if None they are looked for in `weights_folder()`, in torch's cache and, the small
            one, in the installed packages lpips and torchmetrics.
        network: whose features.
        unverified: accept other weights under the same names; None as $TWOFOLD_UNVERIFIED_WEIGHTS says.

    Raises:
        TwofoldError: a file is not the published one, cannot be read, or holds something else.
    """
    found = [find_weights(file, folder, unverified) for file in FILES[network]]
    backbone, linear = found
    if backbone is None or linear is None:
        return None
    model = LPIPS(alex=network == "alex")
    convolutions = [c for block in model.blocks for c in block.modules() if isinstance(c, nn.Conv2d)]
    wanted: dict[str, Tensor] = {}
    for number, convolution in zip(_NUMBERS[network], convolutions, strict=True):
        for part in ("weight", "bias"):
            wanted[f"features.{number}.{part}"] = getattr(convolution, part)
    layers = {f"lin{i}.model.1.weight": weight for i, weight in enumerate(model.linear)}
    for file, parameters in ((backbone, wanted), (linear, layers)):
        for name, tensor in read_weights(file, {n: tuple(p.shape) for n, p in parameters.items()}).items():
            with torch.no_grad():
                parameters[name].copy_(tensor)
    model.verified = backbone.verified and linear.verified
    return model


_NUMBERS: dict[Network, tuple[int, ...]] = {
    "vgg": (0, 2, 5, 7, 10, 12, 14, 17, 19, 21, 24, 26, 28),
    "alex": (0, 3, 6, 8, 10),
}
"""Of the convolutions in torchvision's files, which number activations and poolings too."""
