"""Features of the Inception network that KID and FID compare (Szegedy et al. 2015, the TensorFlow model of 2015-12-05).

Its weights are a file that others have published as tensors; the archives of some programs hold the same network as
code, which is never run here. `inception_cell` says which file is needed.
"""

from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from PIL import Image
from torch import Tensor, nn
from torch.nn import functional as F

from twofold.metrics.image import to_8bit
from twofold.metrics.published_weights import WeightFile, find_weights, missing_cell, missing_sentence, read_weights

SIDE = 299
"""Pixels along each side of what the network sees."""
FEATURES = 2048
FILE = WeightFile(
    "pt_inception-2015-12-05-6726825d.pth",
    "6726825d",
    "Inception network of 2015 for FID",
    "https://github.com/mseitzer/pytorch-fid/releases/download/fid_weights/pt_inception-2015-12-05-6726825d.pth",
)
_EPSILON = 1e-3
"""Of the batch normalisations."""

_Shape = tuple[int, int, tuple[int, int], int, tuple[int, int]]
"""Inputs, outputs, kernel, stride, padding."""


def _shape(inputs: int, outputs: int, high: int = 1, wide: int = 1, stride: int = 1, padded: bool = True) -> _Shape:
    return inputs, outputs, (high, wide), stride, ((high // 2, wide // 2) if padded else (0, 0))


def _convolutions() -> dict[str, _Shape]:
    """All convolutions under the names of the published file."""
    found = {
        "Conv2d_1a_3x3": _shape(3, 32, 3, 3, 2, False),
        "Conv2d_2a_3x3": _shape(32, 32, 3, 3, padded=False),
        "Conv2d_2b_3x3": _shape(32, 64, 3, 3),
        "Conv2d_3b_1x1": _shape(64, 80),
        "Conv2d_4a_3x3": _shape(80, 192, 3, 3, padded=False),
    }
    for name, inputs, pooled in (("5b", 192, 32), ("5c", 256, 64), ("5d", 288, 64)):
        found |= {
            f"Mixed_{name}.branch1x1": _shape(inputs, 64),
            f"Mixed_{name}.branch5x5_1": _shape(inputs, 48),
            f"Mixed_{name}.branch5x5_2": _shape(48, 64, 5, 5),
            f"Mixed_{name}.branch3x3dbl_1": _shape(inputs, 64),
            f"Mixed_{name}.branch3x3dbl_2": _shape(64, 96, 3, 3),
            f"Mixed_{name}.branch3x3dbl_3": _shape(96, 96, 3, 3),
            f"Mixed_{name}.branch_pool": _shape(inputs, pooled),
        }
    found |= {
        "Mixed_6a.branch3x3": _shape(288, 384, 3, 3, 2, False),
        "Mixed_6a.branch3x3dbl_1": _shape(288, 64),
        "Mixed_6a.branch3x3dbl_2": _shape(64, 96, 3, 3),
        "Mixed_6a.branch3x3dbl_3": _shape(96, 96, 3, 3, 2, False),
    }
    for name, n in (("6b", 128), ("6c", 160), ("6d", 160), ("6e", 192)):
        found |= {
            f"Mixed_{name}.branch1x1": _shape(768, 192),
            f"Mixed_{name}.branch7x7_1": _shape(768, n),
            f"Mixed_{name}.branch7x7_2": _shape(n, n, 1, 7),
            f"Mixed_{name}.branch7x7_3": _shape(n, 192, 7, 1),
            f"Mixed_{name}.branch7x7dbl_1": _shape(768, n),
            f"Mixed_{name}.branch7x7dbl_2": _shape(n, n, 7, 1),
            f"Mixed_{name}.branch7x7dbl_3": _shape(n, n, 1, 7),
            f"Mixed_{name}.branch7x7dbl_4": _shape(n, n, 7, 1),
            f"Mixed_{name}.branch7x7dbl_5": _shape(n, 192, 1, 7),
            f"Mixed_{name}.branch_pool": _shape(768, 192),
        }
    found |= {
        "Mixed_7a.branch3x3_1": _shape(768, 192),
        "Mixed_7a.branch3x3_2": _shape(192, 320, 3, 3, 2, False),
        "Mixed_7a.branch7x7x3_1": _shape(768, 192),
        "Mixed_7a.branch7x7x3_2": _shape(192, 192, 1, 7),
        "Mixed_7a.branch7x7x3_3": _shape(192, 192, 7, 1),
        "Mixed_7a.branch7x7x3_4": _shape(192, 192, 3, 3, 2, False),
    }
    for name, inputs in (("7b", 1280), ("7c", 2048)):
        found |= {
            f"Mixed_{name}.branch1x1": _shape(inputs, 320),
            f"Mixed_{name}.branch3x3_1": _shape(inputs, 384),
            f"Mixed_{name}.branch3x3_2a": _shape(384, 384, 1, 3),
            f"Mixed_{name}.branch3x3_2b": _shape(384, 384, 3, 1),
            f"Mixed_{name}.branch3x3dbl_1": _shape(inputs, 448),
            f"Mixed_{name}.branch3x3dbl_2": _shape(448, 384, 3, 3),
            f"Mixed_{name}.branch3x3dbl_3a": _shape(384, 384, 1, 3),
            f"Mixed_{name}.branch3x3dbl_3b": _shape(384, 384, 3, 1),
            f"Mixed_{name}.branch_pool": _shape(inputs, 192),
        }
    return found


class InceptionFeatures(nn.Module):
    """Mean features of the last layer before the classes. Batch normalisation is part of the convolutions' weights.

    Attributes:
        verified: whether its weights are the published ones.
    """

    def __init__(self) -> None:
        super().__init__()
        self.verified = False
        self.convolutions = nn.ModuleDict({
            name.replace(".", " "): nn.Conv2d(inputs, outputs, kernel, stride, padding)
            for name, (inputs, outputs, kernel, stride, padding) in _convolutions().items()
        })  # fmt: skip
        self.requires_grad_(False)

    def forward(self, images: Float[Tensor, "n 3 299 299"]) -> Float[Tensor, "n 2048"]:
        """Features of images of `inception_input`."""
        x = (images - 128) / 128
        for name in ("Conv2d_1a_3x3", "Conv2d_2a_3x3", "Conv2d_2b_3x3", "pool", "Conv2d_3b_1x1", "Conv2d_4a_3x3"):
            x = F.max_pool2d(x, 3, 2) if name == "pool" else self._convolve(name, x)
        x = F.max_pool2d(x, 3, 2)
        for name in ("Mixed_5b", "Mixed_5c", "Mixed_5d"):
            branches = [self._chain(name, x, ["branch1x1"]), self._numbered(name, x, "branch5x5", 2)]
            x = torch.cat([*branches, self._numbered(name, x, "branch3x3dbl", 3), self._pooled(name, x)], 1)
        doubled = self._numbered("Mixed_6a", x, "branch3x3dbl", 3)
        x = torch.cat([self._chain("Mixed_6a", x, ["branch3x3"]), doubled, F.max_pool2d(x, 3, 2)], 1)
        for name in ("Mixed_6b", "Mixed_6c", "Mixed_6d", "Mixed_6e"):
            branches = [self._chain(name, x, ["branch1x1"]), self._numbered(name, x, "branch7x7", 3)]
            x = torch.cat([*branches, self._numbered(name, x, "branch7x7dbl", 5), self._pooled(name, x)], 1)
        branches = [self._numbered("Mixed_7a", x, "branch3x3", 2), self._numbered("Mixed_7a", x, "branch7x7x3", 4)]
        x = torch.cat([*branches, F.max_pool2d(x, 3, 2)], 1)
        for name in ("Mixed_7b", "Mixed_7c"):
            three = self._chain(name, x, ["branch3x3_1"])
            doubled = self._numbered(name, x, "branch3x3dbl", 2)
            ends = [self._chain(name, three, [f"branch3x3_2{side}"]) for side in "ab"]
            ends += [self._chain(name, doubled, [f"branch3x3dbl_3{side}"]) for side in "ab"]
            # The model of 2015 takes the maximum in its last block.
            pooled = self._pooled(name, x, maximum=name == "Mixed_7c")
            x = torch.cat([self._chain(name, x, ["branch1x1"]), *ends, pooled], 1)
        return x.mean((2, 3))

    def _convolve(self, name: str, x: Tensor) -> Tensor:
        return F.relu(self.convolutions[name.replace(".", " ")](x))

    def _chain(self, block: str, x: Tensor, names: list[str]) -> Tensor:
        for name in names:
            x = self._convolve(f"{block}.{name}", x)
        return x

    def _numbered(self, block: str, x: Tensor, branch: str, count: int) -> Tensor:
        return self._chain(block, x, [f"{branch}_{i + 1}" for i in range(count)])

    def _pooled(self, block: str, x: Tensor, maximum: bool = False) -> Tensor:
        """Pixels beyond the edge do not count in the mean."""
        pooled = F.max_pool2d(x, 3, 1, 1) if maximum else F.avg_pool2d(x, 3, 1, 1, count_include_pad=False)
        return self._chain(block, pooled, ["branch_pool"])


def inception_input(image: Float[Tensor, "h w 3"], truncate: bool = False) -> Float[Tensor, "3 299 299"]:
    """An image as the network sees it, 0..255: 8 bit, each channel resized as floats by PIL's bicubic filter, clipped.

    This is the "clean" resizing of Parmar et al. 2022: it low-passes before it samples, and rounds nothing after.

    >>> inception_input(torch.full((64, 48, 3), 0.4)).unique()
    tensor([102.])
    """
    channels = to_8bit(image, truncate).movedim(-1, 0).numpy().astype(np.float32)
    size = (SIDE, SIDE)
    resized = [np.asarray(Image.fromarray(c).resize(size, Image.Resampling.BICUBIC)) for c in channels]
    return torch.from_numpy(np.stack(resized)).clamp(0, 255)


def inception_cell(folder: Path | None = None) -> str:
    """What stands in a table in place of KID and FID where the weights are absent."""
    return missing_cell((FILE,), folder)


def inception_hint(folder: Path | None = None) -> str:
    """One sentence: which file KID and FID need, where it is published and where to put it."""
    return missing_sentence("KID and FID", (FILE,), folder)


def load_inception(folder: Path | None = None, unverified: bool | None = None) -> InceptionFeatures | None:
    """The network with its published weights, or None where the file is missing; then show `inception_cell`.

    Args:
        folder: holds the file; if None it is looked for in `weights_folder()` and in torch's cache.
        unverified: accept another file of that name; None as $TWOFOLD_UNVERIFIED_WEIGHTS says.

    Raises:
        TwofoldError: the file is not the published one, cannot be read, or holds something else.
    """
    found = find_weights(FILE, folder, unverified)
    if found is None:
        return None
    shapes: dict[str, tuple[int, ...]] = {}
    for name, (inputs, outputs, kernel, _, _) in _convolutions().items():
        shapes[f"{name}.conv.weight"] = (outputs, inputs, *kernel)
        shapes |= {f"{name}.bn.{part}": (outputs,) for part in ("weight", "bias", "running_mean", "running_var")}
    stored = read_weights(found, shapes)
    model = InceptionFeatures()
    with torch.no_grad():
        for name in _convolutions():
            convolution = model.convolutions[name.replace(".", " ")]
            assert isinstance(convolution, nn.Conv2d)
            assert convolution.bias is not None
            scale = stored[f"{name}.bn.weight"] / (stored[f"{name}.bn.running_var"] + _EPSILON).sqrt()
            convolution.weight.copy_(stored[f"{name}.conv.weight"] * scale[:, None, None, None])
            convolution.bias.copy_(stored[f"{name}.bn.bias"] - stored[f"{name}.bn.running_mean"] * scale)
    model.verified = found.verified
    return model
