"""LPIPS: how different two images look to a network that knows photographs (Zhang et al. 2018).

Its weights are two files that others have published and that do not come with this package; `weights_hint` says which.
"""

import os
from collections.abc import Iterable
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional as F

from twofold.errors import TwofoldError
from twofold.inputs import require_file

VGG_FILE = "vgg16-397923af.pth"
"""torchvision's VGG16, trained on ImageNet."""
LINEAR_FILE = "vgg.pth"
"""The lpips package's weights of the five feature layers, version 0.1."""
VGG_ADDRESS = "https://download.pytorch.org/models/vgg16-397923af.pth"
LINEAR_ADDRESS = "https://github.com/richzhang/PerceptualSimilarity (lpips/weights/v0.1/vgg.pth)"

_BLOCKS = ((64, 64), (128, 128), (256, 256, 256), (512, 512, 512), (512, 512, 512))
"""Channels of VGG16's convolutions; a maximum over 2 x 2 pixels stands between two blocks."""
_SHIFT, _SCALE = (-0.030, -0.088, -0.188), (0.458, 0.448, 0.450)


class LPIPS(nn.Module):
    """Perceptual distance over VGG16 features, version 0.1. Its weights are fixed; gradients reach the images.

    Args:
        channels: of the network's convolutions, block by block; VGG16's unless a test wants a small one.
    """

    def __init__(self, channels: tuple[tuple[int, ...], ...] = _BLOCKS) -> None:
        super().__init__()
        blocks: list[nn.Module] = []
        inputs = 3
        for block in channels:
            layers: list[nn.Module] = []
            for outputs in block:
                layers.append(nn.Conv2d(inputs, outputs, 3, padding=1))
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
            first: colours 0..1, at least 16 pixels high and wide.
            second: the same.
            dropout: chance of each squared difference of features to be left out; the others are scaled up to match.
            generator: draws which are left out.
        """
        if min(first.shape[-2:]) < 16:
            raise ValueError(f"LPIPS needs images of at least 16 x 16 pixels, these have {tuple(first.shape[-2:])}")
        # One pass over both: convolutions are faster on larger batches.
        x = (2 * torch.cat([first, second]) - 1 - self.shift) / self.scale
        distance = torch.zeros_like(first[:, 0, 0, 0])
        for i, (block, weight) in enumerate(zip(self.blocks, self.linear, strict=True)):
            x = F.max_pool2d(x, 2) if i else x
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


def weights_folder() -> Path:
    """Where weights are looked for: $TWOFOLD_WEIGHTS, or twofold/weights in the user's cache folder."""
    given = os.environ.get("TWOFOLD_WEIGHTS")
    if given:
        return Path(given)
    cache = os.environ.get("XDG_CACHE_HOME")
    return (Path(cache) if cache else Path.home() / ".cache") / "twofold" / "weights"


def weights_hint(folder: Path | None = None) -> str:
    """One sentence: which files LPIPS needs, where they are published and where to put them."""
    return (
        f"LPIPS is left out, because its weights are not in {folder or weights_folder()}; put {VGG_FILE} from "
        f"{VGG_ADDRESS} and {LINEAR_FILE} from {LINEAR_ADDRESS} there, or name their folder in TWOFOLD_WEIGHTS."
    )


def load_lpips(folder: Path | None = None) -> LPIPS | None:
    """LPIPS with its published weights, or None where a file is missing; then show `weights_hint`.

    Args:
        folder: holds the two files; `weights_folder()` if None.

    Raises:
        TwofoldError: a file cannot be read, or holds something else.
    """
    folder = folder or weights_folder()
    files = folder / VGG_FILE, folder / LINEAR_FILE
    if not all(file.is_file() for file in files):
        return None
    model = LPIPS()
    names, convolutions = _torchvision_names(), [c for b in model.blocks for c in _convolutions(b)]
    wanted = {
        f"{name}.{part}": getattr(c, part) for name, c in zip(names, convolutions, strict=True) for part in _PARTS
    }
    _fill(files[0], wanted, "torchvision's VGG16")
    _fill(
        files[1],
        {f"lin{i}.model.1.weight": w for i, w in enumerate(model.linear)},
        "the lpips package's v0.1 VGG weights",
    )
    return model


_PARTS = ("weight", "bias")
_MAX_BYTES = 2 * 2**30


def _convolutions(block: nn.Module) -> Iterable[nn.Conv2d]:
    return [layer for layer in block.children() if isinstance(layer, nn.Conv2d)]


def _torchvision_names() -> list[str]:
    """Names of the convolutions in torchvision's file: it numbers activations and poolings too."""
    names: list[str] = []
    index = 0
    for block in _BLOCKS:
        for _ in block:
            names.append(f"features.{index}")
            index += 2
        index += 1
    return names


def _fill(file: Path, wanted: dict[str, Tensor], what: str) -> None:
    """Copies a file's tensors into parameters, by name."""
    require_file(file, _MAX_BYTES)
    try:
        # Others publish these files in this format; weights_only reads tensors and runs no code.
        stored = torch.load(file, map_location="cpu", weights_only=True)  # noqa: TID251
    except MemoryError:
        raise
    except Exception as error:  # a damaged archive may fail in any way
        raise TwofoldError(f"{file} cannot be read as {what}; download it again.") from error
    for name, parameter in wanted.items():
        found = stored.get(name) if isinstance(stored, dict) else None
        if not isinstance(found, Tensor) or found.squeeze().shape != parameter.shape:
            has = f"of shape {tuple(found.shape)}" if isinstance(found, Tensor) else "missing"
            raise TwofoldError(
                f"{file} should be {what}, but {name} is {has}, not of shape {tuple(parameter.shape)}; "
                "put the right file there."
            )
        with torch.no_grad():
            parameter.copy_(found.reshape(parameter.shape))
