"""DANBO (Disentangled Articulated Neural Body Representations): a small volume around each bone, made from the pose."""

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from twofold.config import require_within
from twofold.field.bone_boxes import RIGID_PARTS
from twofold.losses import box_assignment, box_volumes
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
from twofold.methods.local_radiance import POSE_OCTAVES, LocalRadiance, inside_rigid
from twofold.methods.parameter_group import ParameterGroup
from twofold.methods.subject import Subject
from twofold.recipe import Recipe


@dataclass(frozen=True)
class DanboRates:
    """Learning rate, before schedules; the default is the authors' program."""

    all: float = 5e-4
    """Of everything."""

    def __post_init__(self) -> None:
        """Refuses rates that diverge at once."""
        require_within(self, all=(0, 1000))


@dataclass(frozen=True)
class DanboConfig(MethodConfig):
    """DANBO; the defaults are the authors' program."""

    boxed: BoxedSettings = field(default_factory=lambda: BoxedSettings(level_density=20.0))
    rates: DanboRates = field(default_factory=DanboRates)
    box_volume: float = 1e-3
    """Weight of the volume of the boxes."""
    box_assignment: float = 1e-3
    """Weight of the term that gives each sample on the person to one box, and others to none."""

    def __post_init__(self) -> None:
        """Refuses weights that reward what they should punish."""
        require_within(self, box_volume=(0, 1e6), box_assignment=(0, 1e6))

    def scaled(self, factor: float) -> "DanboConfig":
        """See `MethodConfig.scaled`: nothing of this method is timed."""
        return self

    def build(self, subject: Subject, seed: int = 0) -> "DanboAvatar":
        """An untrained avatar of a subject."""
        return DanboAvatar(self, subject, seed)


class DanboAvatar(BoxedAvatar[Tensor]):
    """See `DanboConfig`. What it makes of a pose are the tables of the volumes."""

    parts = RIGID_PARTS

    def __init__(self, config: DanboConfig, subject: Subject, seed: int) -> None:
        """Builds the networks: 2,454,852 parameters, and a code of 128 for each training frame."""
        generator = torch.Generator().manual_seed(seed)
        super().__init__(config.boxed, POSE_OCTAVES, subject, generator)
        self.config = config
        self.local = LocalRadiance(generator)

    def shared(self, features: Float[Tensor, "24 f"], transforms: Float[Tensor, "24 4 4"]) -> Tensor:
        """See `BoxedAvatar.shared`."""
        return self.local.volumes.tables(features)

    def reached(self, coordinates: Float[Tensor, "S 24 3"]) -> Bool[Tensor, "S"]:
        """See `BoxedAvatar.reached`: points in the boxes of the rigid parts."""
        return inside_rigid(coordinates)

    def radiance_at(
        self, points: Float[Tensor, "S 3"], coordinates: Float[Tensor, "S 24 3"], views: Float[Tensor, "S 3"],
        own: BoxedPose[Tensor], generator: torch.Generator | None,
    ) -> Radiance:  # fmt: skip
        """See `BoxedAvatar.radiance_at`; the extra is the sum of the boxes' probabilities."""
        return self.local(own.shared, coordinates, views, own.code, generator)

    def density_at(
        self, points: Float[Tensor, "S 3"], coordinates: Float[Tensor, "S 24 3"], own: BoxedPose[Tensor]
    ) -> Float[Tensor, "S"]:
        """See `BoxedAvatar.density_at`."""
        return self.local.density(own.shared, coordinates)

    def losses(
        self, rendering: Rendering, batch: Batch, posed: PosedAvatar[BoxedPose[Tensor]], mode: Mode,
        generator: torch.Generator,
    ) -> dict[str, Float[Tensor, ""]]:  # fmt: skip
        """See `BoxedAvatar.losses`; the volume of the boxes; and that samples seen on the person are in one of them."""
        terms = super().losses(rendering, batch, posed, mode, generator)
        seen = (rendering.extras["weights"].detach() > 0).to(rendering.color.dtype).flatten()
        assigned = rendering.extras["extra"].flatten()[:, None]
        return terms | {
            "boxes": self.config.box_volume * box_volumes(posed.own.half_sizes),
            "assignment": self.config.box_assignment * box_assignment(assigned, seen),
        }

    def parameter_groups(self) -> list[ParameterGroup]:
        """See `Avatar.parameter_groups`: all in one."""
        return [ParameterGroup("all", self.config.rates.all, list(self.parameters()))]


def danbo() -> Recipe:
    """The authors' program, as NPC runs it: 3072 rays from 16 images a step. Half an hour on a GPU."""
    return Recipe("danbo", DanboConfig(), released_training(steps=10_000, rays=192, decay=0.1 ** (10_000 / 500_000)))


def danbo_fast() -> Recipe:
    """The same networks and losses; only samples near the body, one image a step, a short schedule."""
    start = danbo()
    method = replace(start.method, boxed=affordable(start.method.boxed), rates=DanboRates(all=1e-3))
    return replace(start, name="danbo_fast", method=method, training=short_training(start.training))


RECIPES: dict[str, Callable[[], Recipe]] = {"danbo": danbo, "danbo_fast": danbo_fast}
"""What `--recipe` offers."""
