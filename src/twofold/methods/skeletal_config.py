"""Settings that HumanNeRF and MonoHuman share, and what both derive from a pose."""

from dataclasses import dataclass, replace
from typing import Literal

from jaxtyping import Float
from torch import Tensor

from twofold.config import require, require_within
from twofold.recipe import scaled_count
from twofold.volume.samples import Samples

MAX_STEPS = 100_000_000


@dataclass(frozen=True)
class SkeletalConfig:
    """Skeletal and non-rigid motion, rays, losses and the guard; the defaults are HumanNeRF's for ZJU-MoCap."""

    samples: int = 128
    """Samples along a ray, from where it enters the box of the joints to where it leaves it."""
    min_likelihood: float | None = None
    """Samples that less likely belong to the person are not shaded; none shades all."""
    min_weight: float = 0.0
    """Samples that a pass without gradients finds to add less than this to their pixel are not shaded; 0 shades all."""
    hidden_dtype: Literal["float32", "bfloat16", "auto"] = "float32"
    """Type of the hidden layers of the networks at samples; "auto": bfloat16 where the processor multiplies it fast."""
    volume_channels: tuple[int, ...] = (1024, 512, 512, 256, 256)
    """Channels of the network that makes the weight volume, which has 2^n vertices along each axis for n of these."""
    volume_code: int = 256
    """Numbers of its learned input."""
    volume_every: int = 1
    """Steps from one in which the weight volume learns to the next; in between it is the same and is not computed."""
    correct_poses: bool = True
    """Whether a network corrects the poses."""
    correct_from: int = 0
    """Steps before it begins."""
    motion_from: int = 10_000
    """Steps before the non-rigid motion begins to see where it is."""
    motion_full: int = 50_000
    """Step at which it sees all frequencies."""
    motion_sees_pose: Literal["with_bands", "always"] = "with_bands"
    """When it sees the pose: "with_bands", from `motion_from` on, zeros before; "always"."""
    squared_error: float = 0.2
    """Weight of the mean squared difference of colours."""
    lpips: float = 1.0
    """Weight of the perceptual difference of the patches."""
    guard_steps: tuple[int, ...] = (100, 300, 1000, 2500, 5000)
    """Steps after which some training frames are looked at; the training begins again where one shows nobody."""
    guard_frames: int = 16
    """How many frames are looked at."""
    guard_size: int | None = None
    """The longer side of the images that are looked at, pixels; none: as they are."""
    density_unit: float = 1.0
    """Density that an output of one of the density network stands for, per metre. Adam changes outputs by about as much
    whatever their unit is, so a larger unit makes a person opaque in fewer steps."""
    level_density: float = 15.0
    """Density times likelihood on the surface of meshes, per metre."""

    def __post_init__(self) -> None:
        """Refuses settings that nothing can be made of."""
        require_within(
            self, samples=(2, 4096), min_likelihood=(0, 1), min_weight=(0, 0.1), volume_channels=(1, 8192),
            volume_code=(1, 8192), volume_every=(1, MAX_STEPS), correct_from=(0, MAX_STEPS), motion_from=(0, MAX_STEPS),
            motion_full=(1, MAX_STEPS), squared_error=(0, 1e6), lpips=(0, 1e6), guard_steps=(1, MAX_STEPS),
            guard_frames=(1, 10_000), guard_size=(8, 100_000), density_unit=(1e-3, 1e4), level_density=(1e-3, 1e6),
        )  # fmt: skip
        require(1 <= len(self.volume_channels) <= 7, "volume_channels should be one to seven numbers")
        require(self.motion_from < self.motion_full, f"motion_from should be below motion_full={self.motion_full}")

    def scaled(self, factor: float) -> "SkeletalConfig":
        """The schedule stretched by a factor. The guard stays: earlier, a good avatar may still be unseen."""
        begin = scaled_count(self.motion_from, factor)
        return replace(
            self,
            correct_from=scaled_count(self.correct_from, factor),
            motion_from=begin,
            motion_full=max(scaled_count(self.motion_full, factor), begin + 1),
        )


@dataclass(frozen=True)
class SkeletalRates:
    """Learning rates of the parameter groups, before schedules; the defaults are HumanNeRF's."""

    networks: float = 5e-4
    """Networks of colour and density."""
    volume: float = 5e-5
    """The weight volume."""
    motion: float = 5e-5
    """Non-rigid motion."""
    pose: float = 5e-5
    """The network that corrects poses."""

    def __post_init__(self) -> None:
        """Refuses rates that diverge at once."""
        require_within(self, **dict.fromkeys(vars(self), (0, 1000)))


@dataclass(frozen=True)
class SkeletalPose:
    """What the methods derive from a pose.

    Attributes:
        to_aligned: the world to the space in which the body's root is not turned, which is where rays are sampled.
        from_canonical: of each bone, T-pose to that space.
        to_canonical: the inverse, M_i.
        box: low and high corner of the box of the joints in that space, where rays begin and end.
        weights: of the bones and the background, over the canonical box.
        condition: the pose as the non-rigid motion sees it.
        open_bands: how many frequencies it sees.
        maps: features of the key frames, for a method that has some.
    """

    to_aligned: Float[Tensor, "4 4"]
    from_canonical: Float[Tensor, "24 4 4"]
    to_canonical: Float[Tensor, "24 4 4"]
    box: Float[Tensor, "2 3"]
    weights: Float[Tensor, "c z y x"]
    condition: Float[Tensor, "69"]
    open_bands: float
    maps: Float[Tensor, "v f i j"] | None = None


@dataclass(frozen=True)
class Shaded:
    """Samples with their density and colour.

    Attributes:
        samples: those that were shaded.
        density: per metre.
        color: 0..1.
        likelihood: that the sample belongs to the person.
        extras: for the method's own losses.
    """

    samples: Samples
    density: Float[Tensor, "S"]
    color: Float[Tensor, "S 3"]
    likelihood: Float[Tensor, "S"]
    extras: dict[str, Tensor]


def affordable(config: SkeletalConfig) -> SkeletalConfig:
    """The same equations within reach of two cores: only likely samples, fewer of them, shortened schedules."""
    return replace(
        config,
        samples=64,
        min_likelihood=0.02,
        min_weight=1e-3,
        hidden_dtype="auto",
        volume_every=8,
        density_unit=20.0,
        motion_from=200,
        motion_full=900,
        guard_steps=(200, 600),
        guard_frames=4,
        guard_size=64,
    )
