"""PM-Avatar (Pose Modulated Avatars from Video): the pose sets the frequencies of the networks around each bone."""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Literal

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from twofold.config import require_within
from twofold.field.bone_boxes import box_window
from twofold.field.conditioned_radiance import ConditionedRadiance
from twofold.field.pose_modulated import FEATURE_COLUMNS, PoseModulatedField
from twofold.field.spherical_harmonics import spherical_harmonics
from twofold.geometry.cameras import Rays
from twofold.losses import box_volumes
from twofold.methods.base import Batch, MethodConfig, Mode, PosedAvatar, Rendering
from twofold.methods.boxed_avatar import BoxedAvatar
from twofold.methods.boxed_config import (
    BoxedPose,
    BoxedSettings,
    Radiance,
    affordable,
    released_training,
    short_training,
)
from twofold.methods.parameter_group import ParameterGroup
from twofold.methods.subject import Subject
from twofold.recipe import Recipe

VIEW_COLUMNS = 16


@dataclass(frozen=True)
class PmAvatarRates:
    """Learning rates of the parameter groups, before schedules; the defaults are the authors' program."""

    field: float = 1e-4
    """Pose graph, box sizes, windows, encoders, pose extractor, modulated layers."""
    radiance: float = 5e-4
    """Density and colour networks, frame codes."""

    def __post_init__(self) -> None:
        """Refuses rates that diverge at once."""
        require_within(self, field=(0, 1000), radiance=(0, 1000))


@dataclass(frozen=True)
class PmAvatarConfig(MethodConfig):
    """PM-Avatar; the defaults are the authors' program."""

    boxed: BoxedSettings = field(default_factory=BoxedSettings)
    rates: PmAvatarRates = field(default_factory=PmAvatarRates)
    box_volume: float = 1e-3
    """Weight of the volume of the boxes."""
    min_window: float = 0.0
    """Pairs of a sample and a box are left out where the box's window is not above this; so are samples without any."""
    misses: Literal["cylinder", "empty"] = "cylinder"
    """Where rays that meet no box are sampled: in a cylinder around the body, as released, or nowhere."""

    def __post_init__(self) -> None:
        """Refuses windows that leave nothing of a box."""
        require_within(self, box_volume=(0, 1e6), min_window=(0, 0.1))

    def scaled(self, factor: float) -> "PmAvatarConfig":
        """See `MethodConfig.scaled`: nothing of this method is timed."""
        return self

    def build(self, subject: Subject, seed: int = 0) -> "PmAvatar":
        """An untrained avatar of a subject."""
        return PmAvatar(self, subject, seed)


class PmAvatar(BoxedAvatar[Tensor]):
    """See `PmAvatarConfig`. What it makes of a pose is lin H (`PoseModulatedField.pose`)."""

    def __init__(self, config: PmAvatarConfig, subject: Subject, seed: int) -> None:
        """Builds the networks: 3,011,684 parameters, and a code of 128 for each training frame."""
        generator = torch.Generator().manual_seed(seed)
        super().__init__(config.boxed, 0, subject, generator)
        self.config = config
        self.field = PoseModulatedField(generator)
        self.radiance = ConditionedRadiance(FEATURE_COLUMNS, VIEW_COLUMNS, generator)

    def shared(self, features: Float[Tensor, "24 f"], transforms: Float[Tensor, "24 4 4"]) -> Float[Tensor, "24 w"]:
        """See `BoxedAvatar.shared`."""
        return self.field.pose(features)

    def reached(self, coordinates: Float[Tensor, "S 24 3"]) -> Bool[Tensor, "S"]:
        """See `BoxedAvatar.reached`: all points, as released; or those in some box's window."""
        if self.config.min_window == 0:
            return torch.ones(len(coordinates), dtype=torch.bool, device=coordinates.device)
        return (box_window(coordinates) > self.config.min_window).any(-1)

    def missed(self, rays: Rays, own: BoxedPose[Tensor], hit: Bool[Tensor, "R"]) -> tuple[Rays, Bool[Tensor, "R"]]:
        """See `BoxedAvatar.missed`."""
        return self.around(rays, own, hit) if self.config.misses == "cylinder" else (rays, hit)

    def radiance_at(
        self, points: Float[Tensor, "S 3"], coordinates: Float[Tensor, "S 24 3"], views: Float[Tensor, "S 3"],
        own: BoxedPose[Tensor], generator: torch.Generator | None,
    ) -> Radiance:  # fmt: skip
        """See `BoxedAvatar.radiance_at`."""
        feature = self.field(own.shared, coordinates, self.config.min_window)
        answer = self.radiance(feature, spherical_harmonics(views), own.code, generator)
        return Radiance(answer.density, answer.color, torch.zeros_like(answer.density))

    def density_at(
        self, points: Float[Tensor, "S 3"], coordinates: Float[Tensor, "S 24 3"], own: BoxedPose[Tensor]
    ) -> Float[Tensor, "S"]:
        """See `BoxedAvatar.density_at`."""
        return self.radiance.density(self.field(own.shared, coordinates, self.config.min_window))[:, 0].relu()

    def losses(
        self, rendering: Rendering, batch: Batch, posed: PosedAvatar[BoxedPose[Tensor]], mode: Mode,
        generator: torch.Generator,
    ) -> dict[str, Float[Tensor, ""]]:  # fmt: skip
        """See `BoxedAvatar.losses`; and the volume of the boxes."""
        terms = super().losses(rendering, batch, posed, mode, generator)
        return terms | {"boxes": self.config.box_volume * box_volumes(posed.own.half_sizes)}

    def parameter_groups(self) -> list[ParameterGroup]:
        """See `Avatar.parameter_groups`: field and radiance."""
        rates = self.config.rates
        return [
            ParameterGroup("field", rates.field, [*self.field.parameters(), *self.boxes.parameters()]),
            ParameterGroup("radiance", rates.radiance, [*self.radiance.parameters(), self.codes]),
        ]


def pm_avatar() -> Recipe:
    """The authors' program: all samples of 3072 rays from 16 images a step. Weeks on a CPU, hours on a GPU."""
    training = released_training(steps=300_000, rays=192, decay=0.1 ** (300_000 / 500_000), clip=1.0)
    return Recipe("pm_avatar", PmAvatarConfig(), training)


def pm_avatar_fast() -> Recipe:
    """The same networks and losses; only samples in a box's window, one image a step, a short schedule."""
    start = pm_avatar()
    rates = PmAvatarRates(field=3e-4, radiance=1e-3)
    method = replace(start.method, boxed=affordable(start.method.boxed), rates=rates, min_window=1e-4, misses="empty")
    return replace(
        start, name="pm_avatar_fast", method=method, training=short_training(start.training, steps=1200, rays=128)
    )


RECIPES: dict[str, Callable[[], Recipe]] = {"pm_avatar": pm_avatar, "pm_avatar_fast": pm_avatar_fast}
"""What `--recipe` offers."""
