"""The Inception network against one written out layer by layer, on random weights in the published format."""

import numpy as np
import pytest
import torch
from PIL import Image
from torch import Tensor
from torch.nn import functional as F

from twofold.errors import TwofoldError
from twofold.metrics.inception import (
    FEATURES,
    FILE,
    InceptionFeatures,
    inception_cell,
    inception_hint,
    inception_input,
    load_inception,
)


class Literal:
    """The network as a program; the first run draws the weights that each layer needs."""

    def __init__(self) -> None:
        self.state: dict[str, Tensor] = {"fc.weight": torch.zeros(1008, 2048), "fc.bias": torch.zeros(1008)}
        self.generator = torch.Generator().manual_seed(0)

    def conv(self, name: str, x: Tensor, outputs: int, kernel: int | tuple[int, int], stride=1, padding=0) -> Tensor:
        kernel = (kernel, kernel) if isinstance(kernel, int) else kernel
        if f"{name}.conv.weight" not in self.state:
            inputs = x.shape[1]
            spread = (2 / (inputs * kernel[0] * kernel[1])) ** 0.5
            draw = self.generator
            self.state[f"{name}.conv.weight"] = spread * torch.randn(outputs, inputs, *kernel, generator=draw)
            self.state[f"{name}.bn.weight"] = 0.8 + 0.4 * torch.rand(outputs, generator=draw)
            self.state[f"{name}.bn.bias"] = 0.1 * torch.randn(outputs, generator=draw)
            self.state[f"{name}.bn.running_mean"] = 0.1 * torch.randn(outputs, generator=draw)
            self.state[f"{name}.bn.running_var"] = 0.8 + 0.4 * torch.rand(outputs, generator=draw)
            self.state[f"{name}.bn.num_batches_tracked"] = torch.tensor(0)
        x = F.conv2d(x, self.state[f"{name}.conv.weight"], stride=stride, padding=padding)
        mean, variance, weight, bias = (
            self.state[f"{name}.bn.{part}"] for part in ("running_mean", "running_var", "weight", "bias")
        )
        return F.relu(F.batch_norm(x, mean, variance, weight, bias, eps=0.001))

    def __call__(self, images: Tensor) -> Tensor:
        c = self.conv
        x = (images - 128) / 128
        x = c("Conv2d_1a_3x3", x, 32, 3, 2)
        x = c("Conv2d_2a_3x3", x, 32, 3)
        x = c("Conv2d_2b_3x3", x, 64, 3, padding=1)
        x = F.max_pool2d(x, 3, 2)
        x = c("Conv2d_3b_1x1", x, 80, 1)
        x = c("Conv2d_4a_3x3", x, 192, 3)
        x = F.max_pool2d(x, 3, 2)
        assert x.shape[1:] == (192, 35, 35)
        for n, pooled in (("Mixed_5b", 32), ("Mixed_5c", 64), ("Mixed_5d", 64)):
            one = c(f"{n}.branch1x1", x, 64, 1)
            five = c(f"{n}.branch5x5_2", c(f"{n}.branch5x5_1", x, 48, 1), 64, 5, padding=2)
            three = c(f"{n}.branch3x3dbl_2", c(f"{n}.branch3x3dbl_1", x, 64, 1), 96, 3, padding=1)
            three = c(f"{n}.branch3x3dbl_3", three, 96, 3, padding=1)
            pool = c(f"{n}.branch_pool", F.avg_pool2d(x, 3, 1, 1, count_include_pad=False), pooled, 1)
            x = torch.cat([one, five, three, pool], 1)
        one = c("Mixed_6a.branch3x3", x, 384, 3, 2)
        two = c("Mixed_6a.branch3x3dbl_2", c("Mixed_6a.branch3x3dbl_1", x, 64, 1), 96, 3, padding=1)
        two = c("Mixed_6a.branch3x3dbl_3", two, 96, 3, 2)
        x = torch.cat([one, two, F.max_pool2d(x, 3, 2)], 1)
        assert x.shape[1:] == (768, 17, 17)
        for n, width in (("Mixed_6b", 128), ("Mixed_6c", 160), ("Mixed_6d", 160), ("Mixed_6e", 192)):
            one = c(f"{n}.branch1x1", x, 192, 1)
            two = c(f"{n}.branch7x7_2", c(f"{n}.branch7x7_1", x, width, 1), width, (1, 7), padding=(0, 3))
            two = c(f"{n}.branch7x7_3", two, 192, (7, 1), padding=(3, 0))
            three = c(f"{n}.branch7x7dbl_2", c(f"{n}.branch7x7dbl_1", x, width, 1), width, (7, 1), padding=(3, 0))
            three = c(f"{n}.branch7x7dbl_3", three, width, (1, 7), padding=(0, 3))
            three = c(f"{n}.branch7x7dbl_4", three, width, (7, 1), padding=(3, 0))
            three = c(f"{n}.branch7x7dbl_5", three, 192, (1, 7), padding=(0, 3))
            pool = c(f"{n}.branch_pool", F.avg_pool2d(x, 3, 1, 1, count_include_pad=False), 192, 1)
            x = torch.cat([one, two, three, pool], 1)
        one = c("Mixed_7a.branch3x3_2", c("Mixed_7a.branch3x3_1", x, 192, 1), 320, 3, 2)
        two = c("Mixed_7a.branch7x7x3_2", c("Mixed_7a.branch7x7x3_1", x, 192, 1), 192, (1, 7), padding=(0, 3))
        two = c("Mixed_7a.branch7x7x3_4", c("Mixed_7a.branch7x7x3_3", two, 192, (7, 1), padding=(3, 0)), 192, 3, 2)
        x = torch.cat([one, two, F.max_pool2d(x, 3, 2)], 1)
        assert x.shape[1:] == (1280, 8, 8)
        for n in ("Mixed_7b", "Mixed_7c"):
            one = c(f"{n}.branch1x1", x, 320, 1)
            two = c(f"{n}.branch3x3_1", x, 384, 1)
            two = [c(f"{n}.branch3x3_2a", two, 384, (1, 3), padding=(0, 1)),
                   c(f"{n}.branch3x3_2b", two, 384, (3, 1), padding=(1, 0))]  # fmt: skip
            three = c(f"{n}.branch3x3dbl_2", c(f"{n}.branch3x3dbl_1", x, 448, 1), 384, 3, padding=1)
            three = [c(f"{n}.branch3x3dbl_3a", three, 384, (1, 3), padding=(0, 1)),
                     c(f"{n}.branch3x3dbl_3b", three, 384, (3, 1), padding=(1, 0))]  # fmt: skip
            mean = F.avg_pool2d(x, 3, 1, 1, count_include_pad=False)
            pool = c(f"{n}.branch_pool", mean if n == "Mixed_7b" else F.max_pool2d(x, 3, 1, 1), 192, 1)
            x = torch.cat([one, *two, *three, pool], 1)
        return F.adaptive_avg_pool2d(x, 1)[..., 0, 0]


def test_features_are_those_of_the_network_written_out(tmp_path) -> None:
    image = inception_input(torch.rand(80, 60, 3, generator=torch.Generator().manual_seed(2)))[None]
    literal = Literal()
    expected = literal(image)
    torch.save(literal.state, tmp_path / FILE.name)  # noqa: TID251
    with pytest.raises(TwofoldError, match="not the published Inception network"):
        load_inception(tmp_path)
    model = load_inception(tmp_path, unverified=True)
    assert not model.verified
    found = model(image)
    assert found.shape == (1, FEATURES)
    assert found.std() > 0.01
    torch.testing.assert_close(found, expected, rtol=1e-4, atol=1e-4 * expected.std().item())


def test_network_has_the_number_of_weights_of_inception_v3() -> None:
    """21,768,352 without the classes: convolutions and one offset a channel, 17,216 of them."""
    model = InceptionFeatures()
    assert sum(p.numel() for p in model.parameters()) == 21_768_352
    assert sum(c.bias.numel() for c in model.convolutions.values()) == 17_216
    assert not any(p.requires_grad for p in model.parameters())


def test_resizing_is_pils_bicubic_filter_on_floats() -> None:
    image = torch.rand(40, 70, 3, generator=torch.Generator().manual_seed(0))
    found = inception_input(image)
    stored = (image * 255).round().numpy()
    for c in range(3):
        exact = np.asarray(Image.fromarray(stored[..., c], mode=None).resize((299, 299), Image.Resampling.BICUBIC))
        assert (found[c].numpy() == exact.clip(0, 255)).all()
    assert found.min() == 0, "the filter overshoots, so something is clipped"
    assert (found != found.round()).any()


def test_without_weights_there_is_a_cell_that_says_what_to_do(tmp_path) -> None:
    assert load_inception(tmp_path) is None
    assert inception_cell(tmp_path) == f"n/a (put {FILE.name} in {tmp_path})"
    assert FILE.address in inception_hint(tmp_path)
