"""One avatar under the settings of several papers: region, background, storage, data range, window, network.

The same images get other numbers under other settings, often by more than methods differ. `SETTINGS` says what each
does, as far as papers and their programs tell. Where a program leaves out pixels beyond the body's 3-D box, those
beyond the box of the true mask are left out here.
"""

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal, final

import torch
from jaxtyping import Float
from torch import Tensor

from twofold.errors import TwofoldError
from twofold.metrics import detail, distribution
from twofold.metrics.image import Window, psnr, ssim, subject_box, to_8bit
from twofold.metrics.inception import InceptionFeatures, inception_cell, inception_input, load_inception
from twofold.metrics.perceptual import LPIPS, Network, load_lpips, lpips_cell

Region = Literal["whole", "box", "mask"]
"""Of the image, of the true mask's bounding box, of the true mask."""
Color = tuple[float, float, float]
MIN_SIDE = 31
"""Pixels that AlexNet needs along each side; VGG16 is content with fewer."""
BLACK, WHITE = (0.0, 0.0, 0.0), (1.0, 1.0, 1.0)


@dataclass(frozen=True)
class Setting:
    """How images are compared.

    Attributes:
        who: measures so, in words.
        psnr_region: pixels of PSNR.
        ssim_region: windows of SSIM; LPIPS takes the whole image or the box.
        background: colour that both images are put on; None for the capture's own.
        truncate: to 8 bit, instead of rounding.
        data_range: of SSIM.
        window: of SSIM.
        network: of LPIPS.
        unscaled: LPIPS is given colours in 0..1 where it expects -1..1.
    """

    who: str
    psnr_region: Region = "whole"
    ssim_region: Region = "whole"
    background: Color | None = None
    truncate: bool = False
    data_range: float = 1.0
    window: Window = "uniform"
    network: Network = "vgg"
    unscaled: bool = False

    def sentence(self, metric: str) -> str:
        """What a number of `METRICS` is under this setting, in one line."""
        region = self.psnr_region if metric == "psnr" else self.ssim_region
        if metric == "lpips_x1000" and region == "mask":
            region = "box"
        on = "the capture's background" if self.background is None else f"background {self.background}"
        parts = [{"whole": "whole image", "box": "box of the true mask", "mask": "true mask"}[region], on]
        parts.append(f"8 bit {'truncated' if self.truncate else 'rounded'}")
        if metric == "ssim":
            size = "7x7 uniform" if self.window == "uniform" else "11x11 Gaussian"
            parts += [f"{size} window", f"data range {self.data_range:g}"]
        if metric == "lpips_x1000":
            parts.append({"vgg": "VGG16", "alex": "AlexNet"}[self.network] + ", times 1000")
            if self.unscaled:
                parts.append("fed 0..1 in place of -1..1")
        return f"{self.who}: {', '.join(parts)}"


SETTINGS: dict[str, Setting] = {
    "twofold": Setting("this program"),
    "twofold_box": Setting("this program, box", "box", "box"),
    "twofold_mask": Setting("this program, mask", "mask", "mask"),
    "range_2": Setting("as twofold with the range that older programs took for floats", data_range=2.0),
    "truncated": Setting("as twofold with truncation", truncate=True),
    "humannerf": Setting("HumanNeRF, MonoHuman, this paper", background=BLACK, truncate=True, data_range=2.0),
    "neuralbody": Setting("NeuralBody, ARAH", "box", "box", BLACK, data_range=2.0),
    "npc": Setting("NPC, PM-Avatar", "mask", "box"),
    "instantavatar": Setting(
        "InstantAvatar", background=WHITE, window="gaussian", network="alex", unscaled=True
    ),
}  # fmt: skip
"""By name. Where a paper's program stores floats, the images are rounded to 8 bit here all the same."""
METRICS = ("psnr", "ssim", "lpips_x1000")
"""What is measured under each setting."""


@dataclass(frozen=True)
class Networks:
    """Trained networks, None where their weights are absent; `folder` is where they were looked for."""

    lpips: dict[Network, LPIPS | None] = field(default_factory=dict)
    inception: InceptionFeatures | None = None
    folder: Path | None = None

    def lpips_note(self, network: Network) -> str:
        """For protocols: that weights are not the published ones."""
        model = self.lpips.get(network)
        return "" if model is None or model.verified else UNVERIFIED


UNVERIFIED = " (unverified weights: not the published ones)"
"""Ends the protocol of each number made with other weights."""


def load_networks(folder: Path | None = None, unverified: bool | None = None) -> Networks:
    """All networks whose weights are there; see `twofold.metrics.published_weights.find_weights`.

    Raises:
        TwofoldError: a file is not the published one and `unverified` is not set, or cannot be read.
    """
    lpips: dict[Network, LPIPS | None] = {"vgg": None, "alex": None}
    for network in lpips:
        lpips[network] = load_lpips(folder, network, unverified)
    return Networks(lpips, load_inception(folder, unverified), folder)


def on_background(
    color: Float[Tensor, "h w 3"], opacity: Float[Tensor, "h w"], old: Color, new: Color
) -> Float[Tensor, "h w 3"]:
    r"""A rendering on another constant background, $c + (1 - \alpha)(b_\mathrm{new} - b_\mathrm{old})$.

    >>> on_background(torch.full((1, 1, 3), 0.5), torch.full((1, 1), 0.5), (0.0,) * 3, (1.0,) * 3)
    tensor([[[1., 1., 1.]]])
    """
    return color + (1 - opacity[..., None]) * (torch.tensor(new) - torch.tensor(old))


@torch.no_grad()
def measure_setting(
    setting: Setting, image: Float[Tensor, "h w 3"], truth: Float[Tensor, "h w 3"], mask: Float[Tensor, "h w"],
    network: LPIPS | None = None,
) -> dict[str, float]:  # fmt: skip
    """PSNR, SSIM and, where its network is given, LPIPS times 1000 of two images on one background.

    Raises:
        TwofoldError: the mask is empty, or a region is smaller than SSIM's window.
    """
    box, inside = subject_box(mask), mask > 0.5

    def region(name: Region) -> tuple[Tensor, Tensor, Tensor | None]:
        if name == "box":
            return image[box], truth[box], None
        return image, truth, inside if name == "mask" else None

    x, y, where = region(setting.psnr_region)
    row = {"psnr": psnr(x, y, where, setting.truncate)}
    x, y, where = region(setting.ssim_region)
    row["ssim"] = ssim(x, y, setting.data_range, None, setting.window, where, setting.truncate)
    if network is not None:
        x, y, _ = region("whole" if setting.ssim_region == "whole" else "box")
        if min(x.shape[:2]) < MIN_SIDE:
            have = f"{x.shape[0]} x {x.shape[1]}"
            raise TwofoldError(f"LPIPS needs {MIN_SIDE} x {MIN_SIDE} pixels, it got {have}; use larger images.")
        stored = [to_8bit(p, setting.truncate).movedim(-1, 0)[None].float() / 255 for p in (x, y)]
        if setting.unscaled:
            stored = [(p + 1) / 2 for p in stored]  # The network itself maps 0..1 to -1..1.
        row["lpips_x1000"] = 1000 * network(*stored).item()
    return row


@final
class ProtocolMeans:
    """Means over images that are added one by one; of each image only numbers and network features are kept."""

    def __init__(self, networks: Networks) -> None:
        self._networks = networks
        self._sums: dict[str, float] = {}
        self._count = 0
        self._features: list[tuple[Tensor, Tensor]] = []

    @torch.no_grad()
    def add(
        self, color: Float[Tensor, "h w 3"], opacity: Float[Tensor, "h w"], mask: Float[Tensor, "h w"],
        background: Color, truth_on: Callable[[Color], Tensor],
    ) -> None:  # fmt: skip
        """One rendering.

        Args:
            color: as rendered, on `background`.
            opacity: of the rendering.
            mask: the true one.
            background: of the rendering.
            truth_on: the true image on a background.

        Raises:
            TwofoldError: see `measure_setting`.
        """
        row: dict[str, float] = {}
        for name, setting in SETTINGS.items():
            behind = background if setting.background is None else setting.background
            image, truth = on_background(color, opacity, background, behind), truth_on(behind)
            network = self._networks.lpips.get(setting.network)
            figures = measure_setting(setting, image, truth, mask, network)
            row |= {f"{name}_{metric}": value for metric, value in figures.items()}
        truth, box = truth_on(background), subject_box(mask)
        row["ms_ssim"] = detail.ms_ssim(color, truth)
        row["gradient_error"] = detail.gradient_error(color[box], truth[box])
        for name, value in row.items():
            self._sums[name] = self._sums.get(name, 0.0) + value
        self._count += 1
        if self._networks.inception is not None:
            pair = torch.stack([inception_input(color), inception_input(truth)])
            ours, theirs = self._networks.inception(pair)
            self._features.append((ours, theirs))

    def figures(self) -> dict[str, float | str]:
        """All means by name, `SETTING_METRIC` for those of `SETTINGS`; "n/a ..." where weights are absent; or empty."""
        if not self._count:
            return {}
        found: dict[str, float | str] = {name: total / self._count for name, total in self._sums.items()}
        for name, setting in SETTINGS.items():
            found.setdefault(f"{name}_lpips_x1000", lpips_cell(self._networks.folder, setting.network))
        few = self._count < 2
        absent = "n/a (needs 2 images)" if few else inception_cell(self._networks.folder)
        found |= {"kid_x1000": absent, "fid": absent}
        if self._features and not few:
            ours, theirs = (torch.stack(part) for part in zip(*self._features, strict=True))
            found["kid_x1000"] = 1000 * distribution.kid(ours, theirs, torch.Generator().manual_seed(0))
            found["fid"] = distribution.fid(ours, theirs)
        return found

    def protocols(self) -> dict[str, str]:
        """What each number of `figures` is, in one line."""
        told: dict[str, str] = {}
        for name, setting in SETTINGS.items():
            for metric in METRICS:
                note = self._networks.lpips_note(setting.network) if metric == "lpips_x1000" else ""
                told[f"{name}_{metric}"] = setting.sentence(metric) + note
        inception = self._networks.inception
        note = "" if inception is None or inception.verified else UNVERIFIED
        return told | detail.PROTOCOLS | {name: text + note for name, text in distribution.PROTOCOLS.items()}
