"""MonoHuman's image features of key frames: a residual U-network, lookup at projected points, blending over views."""

import itertools
import math

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional as F
from torch.nn.utils import skip_init

from twofold.kernels.mlp import RELU_GAIN, dense_layer, uniform, xavier_bound

FEATURES = 32
VIEW_COLUMNS = 3 + FEATURES
_STAGES = ((64, 3), (128, 4), (256, 6))


class ResUNet(nn.Module):
    """32 features at a quarter of an image's resolution (8,877,056 parameters).

    A 7x7 convolution of stride 2 to 64 channels; residual stages of 3, 4 and 6 blocks with 64, 128 and 256 channels,
    each of stride 2 at its first block; two upsamplings, each joined with the stage of its size; a 1x1 convolution.
    Reflect padding, instance normalisation with learned scale, ReLU in the encoder and ELU in the decoder. Convolutions
    start at U(+-1 / sqrt(fan in)).
    """

    def __init__(self, generator: torch.Generator | None = None) -> None:
        super().__init__()
        self.first = nn.Sequential(_convolution(3, 64, 7, 2, False, generator), _norm(64), nn.ReLU())
        stages: list[nn.Module] = []
        channels = 64
        for width, blocks in _STAGES:
            parts = [_ResidualBlock(channels, width, 2, generator)]
            parts += [_ResidualBlock(width, width, 1, generator) for _ in range(blocks - 1)]
            stages.append(nn.Sequential(*parts))
            channels = width
        self.stages = nn.ModuleList(stages)
        self.up3, self.join3 = _decoder(256, 128, generator), _decoder(128 + 128, 128, generator)
        self.up2, self.join2 = _decoder(128, 64, generator), _decoder(64 + 64, FEATURES, generator)
        self.last = _convolution(FEATURES, FEATURES, 1, 1, True, generator)

    def forward(self, images: Float[Tensor, "v 3 h w"]) -> Float[Tensor, "v 32 i j"]:
        """Feature maps of images (0..1): (i, j) is about (h, w) / 4.

        Sides that 16 divides are halved four times exactly; others are rounded up, and maps are brought to each other's
        size.

        Raises:
            ValueError: an image is smaller than 64 pixels, so that its smallest map cannot be padded by reflection.
        """
        if min(images.shape[-2:]) < 64:
            raise ValueError(f"images should be at least 64 x 64 pixels, they are {tuple(images.shape[-2:])}")
        h = self.first(images)
        maps: list[Tensor] = []
        for stage in self.stages:
            h = stage(h)
            maps.append(h)
        h = self.join3(torch.cat([self.up3(_resized(h, maps[1])), maps[1]], 1))
        h = self.join2(torch.cat([self.up2(_resized(h, maps[0])), maps[0]], 1))
        return self.last(h)


class _ResidualBlock(nn.Module):
    """Two 3x3 convolutions beside the input; a 1x1 convolution brings the input to a new size."""

    def __init__(self, inputs: int, outputs: int, stride: int, generator: torch.Generator | None) -> None:
        super().__init__()
        self.inner = nn.Sequential(
            _convolution(inputs, outputs, 3, stride, False, generator),
            _norm(outputs),
            nn.ReLU(),
            _convolution(outputs, outputs, 3, 1, False, generator),
            _norm(outputs),
        )
        changes = stride != 1 or inputs != outputs
        self.shortcut = (
            nn.Sequential(_convolution(inputs, outputs, 1, stride, False, generator), _norm(outputs))
            if changes
            else nn.Identity()
        )

    def forward(self, x: Tensor) -> Tensor:
        return F.relu(self.inner(x) + self.shortcut(x))


class ViewBlending(nn.Module):
    """Features of a point in several views as one: a weighted mean, its weights from a network of 1,369 parameters.

    weight_v = softmax over the views of ReLU(lin ReLU(lin [f_v, 0])), 36 -> 36 -> 1. The zero stands where the authors'
    program could say whether the point is visible.

    Args:
        with_unused_heads: also hold the two heads (4,804 parameters) that the authors' program has but does not use, so
            that the counts agree; they take no gradients.
        generator: draws the initial weights.
    """

    def __init__(self, with_unused_heads: bool = False, generator: torch.Generator | None = None) -> None:
        super().__init__()

        def head(*sizes: int) -> nn.Sequential:
            layers: list[nn.Module] = []
            for inputs, outputs in itertools.pairwise(sizes):
                layers += [dense_layer(inputs, outputs, xavier_bound(inputs, outputs, RELU_GAIN), generator), nn.ReLU()]
            return nn.Sequential(*layers)

        columns = VIEW_COLUMNS + 1
        self.weight = head(columns, columns, 1)
        if with_unused_heads:
            self.unused = nn.ModuleList([head(5, 32, 1), head(VIEW_COLUMNS, 64, VIEW_COLUMNS)]).requires_grad_(False)

    def forward(self, features: Float[Tensor, "S v c"]) -> Float[Tensor, "S c"]:
        """The blended features of each point.

        Args:
            features: colour and 32 features in each view, from `sample_maps`.
        """
        weights = self.weight(F.pad(features, (0, 1))).softmax(1)
        return (weights * features).sum(1)


def sample_maps(
    maps: Float[Tensor, "v c i j"], pixels: Float[Tensor, "v S 2"], size: tuple[int, int]
) -> Float[Tensor, "S v c"]:
    r"""Values of maps at pixels of the images they belong to: bilinear, corner pixels aligned, zero outside.

    \[ f(x) = \sum_{a,b \in \{0,1\}} (1 - u)^{1-a} u^a (1 - v)^{1-b} v^b \, F_{ab} \]

    with the position $(u, v)$ between the four nearest nodes.

    >>> image = torch.arange(4.0).reshape(1, 1, 2, 2)
    >>> sample_maps(image, torch.tensor([[[0.5, 0.0], [1.0, 1.0]]]), (2, 2))[:, 0, 0]
    tensor([0.5000, 3.0000])

    Args:
        maps: of each view, of any resolution.
        pixels: (column, row) in each view's image, from `geometry.cameras.project`.
        size: rows and columns of the images.
    """
    height, width = size
    extent = torch.tensor([width - 1, height - 1], dtype=pixels.dtype, device=pixels.device)
    grid = (2 * pixels / extent - 1)[:, :, None]
    return F.grid_sample(maps, grid, align_corners=True)[..., 0].permute(2, 0, 1)


def _convolution(
    inputs: int, outputs: int, kernel: int, stride: int, bias: bool, generator: torch.Generator | None
) -> nn.Conv2d:
    layer = skip_init(
        nn.Conv2d, inputs, outputs, kernel, stride=stride, padding=kernel // 2, padding_mode="reflect", bias=bias
    )
    assert isinstance(layer, nn.Conv2d)
    bound = 1 / math.sqrt(inputs * kernel * kernel)
    with torch.no_grad():
        for parameter in layer.parameters():
            parameter.copy_(uniform(parameter.shape, bound, generator))
    return layer


def _decoder(inputs: int, outputs: int, generator: torch.Generator | None) -> nn.Sequential:
    return nn.Sequential(_convolution(inputs, outputs, 3, 1, True, generator), _norm(outputs), nn.ELU())


def _norm(channels: int) -> nn.InstanceNorm2d:
    return nn.InstanceNorm2d(channels, affine=True, track_running_stats=False)


def _resized(h: Tensor, like: Tensor) -> Tensor:
    """Upsampled to another map's size, bilinear with aligned corners."""
    return F.interpolate(h, like.shape[-2:], mode="bilinear", align_corners=True)
