"""Learning rates of the factorized method."""

from dataclasses import dataclass

from twofold.config import require_within


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
