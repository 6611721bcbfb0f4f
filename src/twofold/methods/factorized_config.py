"""Small parts of the factorized method: learning rates, and what it derives from a pose."""

from dataclasses import dataclass

from jaxtyping import Float
from torch import Tensor

from twofold.config import require_within
from twofold.sampling.posed_surface import PosedSurface


@dataclass(frozen=True)
class RateConfig:
    """Learning rates of the parameter groups, before schedules; the defaults are the authors' release."""

    low: float = 5e-4
    """Networks of the pose-independent branch."""
    high: float = 2e-4
    """Networks of the pose-dependent branch."""
    grid: float = 1e-2
    """Feature grids."""
    beta: float = 1e-4
    """Scale of the density."""
    pose: float = 5e-5
    """Pose corrections."""

    def __post_init__(self) -> None:
        """Refuses rates that diverge at once."""
        require_within(self, **dict.fromkeys(vars(self), (0, 1000)))


@dataclass(frozen=True)
class FactorizedPose:
    """What the method derives from a pose.

    Attributes:
        surface: the posed body with its shell.
        condition: the pose vector that the pose-dependent branch is conditioned on.
        anchors: canonical vertices that turn normals, where these are not the ones that inverse skinning found.
    """

    surface: PosedSurface
    condition: Float[Tensor, "P"]
    anchors: Float[Tensor, "V 3"] | None = None
