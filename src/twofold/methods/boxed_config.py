"""Settings that PM-Avatar, DANBO and NPC share, and what they derive from a pose and answer at points."""

from dataclasses import dataclass, replace
from typing import Generic, Literal, TypeVar

from jaxtyping import Float
from scipy.spatial import KDTree
from torch import Tensor

from twofold.config import require_within
from twofold.recipe import PixelConfig, TrainingConfig

Shared = TypeVar("Shared")


@dataclass(frozen=True)
class BoxedSettings:
    """What the three methods have in common; the defaults are PM-Avatar's and DANBO's."""

    coarse: int = 48
    """Evenly spaced samples between the ends of the boxes that a ray meets."""
    fine: int = 24
    """More samples, where the first found density."""
    max_distance: float | None = None
    """Points further than this from the posed body's vertices are empty, metres; none: whatever the boxes hold."""
    hidden_dtype: Literal["float32", "bfloat16", "auto"] = "float32"
    """Type of the hidden layers of the ReLU networks; "auto": bfloat16 where the processor multiplies it fast. Layers
    of sines stay in float32: their frequencies would magnify the rounding."""
    level_density: float = 5.0
    """Density of the surface, per metre."""
    background: Literal["noise", "capture"] = "noise"
    """What training images are composited on: a random colour for each ray, as released, or the capture's own."""

    def __post_init__(self) -> None:
        """Refuses what nothing can be rendered with."""
        require_within(self, coarse=(3, 1024), fine=(2, 1024), max_distance=(0.01, 10), level_density=(1e-3, 1e4))


@dataclass(frozen=True)
class BoxedPose(Generic[Shared]):
    """What these methods derive from a pose, in the root's space.

    Attributes:
        to_root: from the world.
        transforms: from the T-pose, one a joint.
        to_frame: from the root's space to the bone-aligned frame of each joint.
        half_sizes: of the boxes, metres.
        joints: posed, metres.
        code: of the frame, or the mean of all.
        tree: of the body's posed vertices, where only points near it are computed.
        training: whether the avatar is trained.
        shared: what the method's networks make of the pose, once for all samples.
    """

    to_root: Float[Tensor, "4 4"]
    transforms: Float[Tensor, "24 4 4"]
    to_frame: Float[Tensor, "24 4 4"]
    half_sizes: Float[Tensor, "24 3"]
    joints: Float[Tensor, "24 3"]
    code: Float[Tensor, "c"]
    tree: KDTree | None
    training: bool
    shared: Shared


@dataclass(frozen=True)
class Radiance:
    """Density and colour at points, and what the method's losses need of them.

    Attributes:
        density: per metre.
        color: 0..1.
        extra: one number of each point for the method's own losses; zeros where it has none.
    """

    density: Float[Tensor, "S"]
    color: Float[Tensor, "S 3"]
    extra: Float[Tensor, "S"]


def released_training(steps: int, rays: int, decay: float, clip: float = 0.0) -> TrainingConfig:
    """How the authors' programs train: rays near the person from 16 images a step, exponential decay from the start.

    Args:
        steps: of the training.
        rays: of each image.
        decay: what the rates are multiplied with in the end.
        clip: largest global norm of the gradient; 0 for no limit.
    """
    pixels = PixelConfig(rays=rays, subject_share=1.0, surroundings=6, patches=0)
    return TrainingConfig(
        steps=steps, images_per_step=16, pixels=pixels, milestones=(), decay=decay, decay_from=0.0, clip=clip
    )


def affordable(settings: BoxedSettings, coarse: int = 32, fine: int = 16) -> BoxedSettings:
    """Fewer samples, only near the body, in bfloat16 where the processor is made for it; the equations stay."""
    return replace(settings, coarse=coarse, fine=fine, max_distance=0.07, hidden_dtype="auto")


def short_training(training: TrainingConfig, steps: int = 1500, rays: int = 192) -> TrainingConfig:
    """Some ten minutes on two cores: a few rays of one image a step, a warm-up, rates that fall early."""
    return replace(
        training, steps=steps, images_per_step=1, pixels=replace(training.pixels, rays=rays), warmup=50, decay=0.03,
        decay_from=0.1, clip=1.0, checkpoint_every=200,
    )  # fmt: skip
