"""How a camera shows the colours of an avatar, where that was learned: what `Avatar.camera_response` promises."""

from typing import Protocol

from jaxtyping import Float
from torch import Tensor


class CameraResponse(Protocol):
    """Colours of known cameras; those of others stay as they are."""

    def image(
        self, color: Float[Tensor, "h w 3"], opacity: Float[Tensor, "h w"], background: Float[Tensor, "3"], camera: str
    ) -> Float[Tensor, "h w 3"]:
        """A rendered image, 0..1, as the camera of this name shows it; the background stays."""
        ...

    def protocol(self) -> str:
        """Which cameras are known and how, for protocols."""
        ...

    def numbers(self) -> dict[str, float]:
        """Gain and offset of each camera and channel, by name."""
        ...
