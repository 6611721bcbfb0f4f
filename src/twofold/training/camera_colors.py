r"""Colours of several training cameras: each has a gain and an offset per channel, learned with the avatar.

A camera that exposes or balances colours in another way than the others shows one person in other colours. Without a
calibration the avatar learns their mixture and bakes differences between cameras into its shape and into colours that
depend on the view. With one, camera k shows the colour \(c\) of a person as

\[ g_k c + o_k, \qquad g_k = e^{a_k - \bar{a}}, \quad o_k = b_k - \bar{b}, \]

where \(\bar{a}\) and \(\bar{b}\) are those of the reference, whose colours the avatar has: the first training camera,
or the mean of all. The renderings of a step are changed, not the images, so that losses keep their scale and no gain
can make an error small by making the images dark.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal, final

import torch
from jaxtyping import Float
from torch import Tensor, nn

from twofold.errors import TwofoldError
from twofold.methods.base import Batch, Rendering

RATE = 2e-3
"""Learning rate, before schedules."""
PENALTY = 2e-3
"""Weight of the mean square of logarithms of gains and of offsets."""


@final
class CameraColors(nn.Module):
    """Gains and offsets of the training cameras."""

    def __init__(self, names: Sequence[str], reference: Literal["first", "mean"]) -> None:
        """All cameras are alike at first.

        Args:
            names: of the training cameras, in order.
            reference: whose colours the avatar has.
        """
        super().__init__()
        self.names, self.reference = tuple(names), reference
        self.log_gain = nn.Parameter(torch.zeros(len(self.names), 3))
        self.offset = nn.Parameter(torch.zeros(len(self.names), 3))

    def gains(self) -> Float[Tensor, "cameras 3"]:
        """What each camera multiplies colours with."""
        return self._relative(self.log_gain).exp()

    def offsets(self) -> Float[Tensor, "cameras 3"]:
        """What each camera adds, 0..1."""
        return self._relative(self.offset)

    def _relative(self, values: Float[Tensor, "cameras 3"]) -> Float[Tensor, "cameras 3"]:
        return values - (values[:1] if self.reference == "first" else values.mean(0, keepdim=True))

    def penalty(self) -> Float[Tensor, ""]:
        """How unlike the cameras are, weighted."""
        return PENALTY * (self._relative(self.log_gain).square().mean() + self.offsets().square().mean())

    def seen(self, rendering: Rendering, batch: Batch, camera: str) -> Rendering:
        """A training step's rendering as a training camera shows it; the batch's background stays."""
        number = self.names.index(camera)
        gain, offset = self.gains()[number], self.offsets()[number]

        def change(color: Tensor, opacity: Tensor) -> Tensor:
            return _changed(color, opacity, batch.background, gain, offset)

        def whole(one: Rendering) -> Rendering:
            base = None if one.base is None else whole(one.base)
            extras = one.extras
            if "coarse" in extras:
                extras = extras | {"coarse": change(extras["coarse"], extras["coarse_opacity"])}
            return replace(one, color=change(one.color, one.opacity), base=base, extras=extras)

        return whole(rendering)


@final
@dataclass(frozen=True)
class LearnedResponse:
    """`CameraResponse` of learned colours; an avatar that has it does not hold their parameters."""

    colors: CameraColors

    @torch.no_grad()
    def image(
        self, color: Float[Tensor, "h w 3"], opacity: Float[Tensor, "h w"], background: Float[Tensor, "3"], camera: str
    ) -> Float[Tensor, "h w 3"]:
        """See `CameraResponse.image`."""
        if camera not in self.colors.names:
            return color
        number = self.colors.names.index(camera)
        gain, offset = (values[number].to(color) for values in (self.colors.gains(), self.colors.offsets()))
        return _changed(color, opacity, background.to(color), gain, offset).clamp(0, 1)

    def protocol(self) -> str:
        """See `CameraResponse.protocol`."""
        whose = (
            f"the camera {self.colors.names[0]}" if self.colors.reference == "first" else "the mean of these cameras"
        )
        names = ", ".join(self.colors.names)
        return (
            f"images of the training cameras {names} are rendered with gains and offsets that were learned for each "
            f"(training.camera_colors), images of others in the colours of {whose}"
        )

    def numbers(self) -> dict[str, float]:
        """See `CameraResponse.numbers`."""
        found: dict[str, float] = {}
        for what, values in (("gain", self.colors.gains()), ("offset", self.colors.offsets())):
            for name, row in zip(self.colors.names, values.detach().cpu().tolist(), strict=True):
                found |= {f"{name}_{what}_{c}": v for c, v in zip(("red", "green", "blue"), row, strict=True)}
        return found


def load_camera_colors(colors: CameraColors, tensors: dict[str, Tensor], folder: Path) -> None:
    """Puts the stored colours of a run's training cameras back.

    Raises:
        TwofoldError: they belong to other cameras, or are not all there.
    """
    prefix = "camera_colors."
    state = {name.removeprefix(prefix): t for name, t in tensors.items() if name.startswith(prefix)}
    for name, expected in colors.state_dict().items():
        found = state.get(name)
        if found is None or found.shape != expected.shape or not (found.is_floating_point() and found.isfinite().all()):
            raise TwofoldError(f"The checkpoint in {folder} does not fit its training cameras; train again.")
    colors.load_state_dict(state)


def _changed(
    color: Float[Tensor, "*r 3"],
    opacity: Float[Tensor, "*r"],
    background: Float[Tensor, "*b 3"] | None,
    gain: Float[Tensor, "3"],
    offset: Float[Tensor, "3"],
) -> Float[Tensor, "*r 3"]:
    """Colours on a background, of which the person's are changed; with a method's own background, all are."""
    if background is None:
        return gain * color + offset
    behind = (1 - opacity[..., None]) * background
    return gain * (color - behind) + opacity[..., None] * offset + behind
