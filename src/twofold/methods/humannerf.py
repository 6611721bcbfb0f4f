"""HumanNeRF (Weng et al., CVPR 2022): skeletal motion by a weight volume, non-rigid motion, a canonical NeRF."""

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor, nn

from twofold.deform.weight_volume import SkeletalPoints
from twofold.field.nerf import CanonicalNerf, NonRigidMotion
from twofold.field.output import RadianceOutput
from twofold.methods.base import MethodConfig, Mode
from twofold.methods.skeletal import Posed, SkeletalAvatar
from twofold.methods.skeletal_config import SkeletalConfig, SkeletalRates, affordable
from twofold.methods.subject import Subject
from twofold.recipe import PixelConfig, Recipe, TrainingConfig


@dataclass(frozen=True)
class HumanNerfConfig(MethodConfig):
    """HumanNeRF; the defaults are the authors' program for ZJU-MoCap."""

    skeletal: SkeletalConfig = dataclasses.field(default_factory=SkeletalConfig)
    rates: SkeletalRates = dataclasses.field(default_factory=SkeletalRates)

    def scaled(self, factor: float) -> "HumanNerfConfig":
        """See `MethodConfig.scaled`."""
        return dataclasses.replace(self, skeletal=self.skeletal.scaled(factor))

    def build(self, subject: Subject, seed: int = 0) -> "HumanNerfAvatar":
        """An untrained avatar of a subject."""
        return HumanNerfAvatar(self, subject, seed)


class HumanNerfAvatar(SkeletalAvatar):
    """See `HumanNerfConfig`."""

    def __init__(self, config: HumanNerfConfig, subject: Subject, seed: int) -> None:
        """Builds the networks."""
        generator = torch.Generator().manual_seed(seed)
        super().__init__(config.skeletal, config.rates, subject, generator)
        self.config = config
        self.motion = NonRigidMotion(generator=generator)
        self.canonical = CanonicalNerf(generator)

    @property
    def networks(self) -> list[nn.Module]:
        """See `SkeletalAvatar.networks`."""
        return [self.canonical]

    @property
    def motions(self) -> list[nn.Module]:
        """See `SkeletalAvatar.motions`."""
        return [self.motion]

    def radiance(
        self, moved: SkeletalPoints, observed: Float[Tensor, "n 3"], posed: Posed, mode: Mode
    ) -> tuple[RadianceOutput, dict[str, Tensor]]:
        """See `SkeletalAvatar.radiance`: the canonical field where the non-rigid motion takes the points."""
        x_canonical = self.motion(moved.points, posed.own.condition, posed.own.open_bands)
        return self.canonical(x_canonical), {}

    def density(self, moved: SkeletalPoints, posed: Posed) -> Float[Tensor, "n"]:
        """See `SkeletalAvatar.density`."""
        return self.canonical(self.motion(moved.points, posed.own.condition, posed.own.open_bands)).density


def humannerf() -> Recipe:
    """The authors' program for ZJU-MoCap. Days on a GPU, years on a CPU."""
    return Recipe(
        name="humannerf",
        method=HumanNerfConfig(),
        training=TrainingConfig(
            steps=400_000,
            images_per_step=1,
            pixels=PixelConfig(rays=0, patches=6, patch_size=32, patch_on_subject=0.8, reachable="box", subject="any"),
            milestones=(),
            decay=0.1**0.8,
            decay_from=0.0,
            clip=0.0,
            checkpoint_every=2500,
            preview_every=5000,
        ),
    )


def humannerf_fast() -> Recipe:
    """The same equations in half an hour on two cores: only likely samples, fewer of them, shortened schedules."""
    start = humannerf()
    # Twice the steps of MonoHuman, which learns from key frames, too: after 1500 the error still falls.
    skeletal = affordable(start.method.skeletal).scaled(2.0)
    rates = SkeletalRates(networks=1e-3, volume=1e-4, motion=1e-4, pose=5e-5)
    training = dataclasses.replace(
        start.training,
        steps=3000,
        pixels=PixelConfig(
            rays=256, subject_share=0.9, surroundings=8, patches=1, patch_size=16, patch_on_subject=0.8,
            reachable="body", subject="half",
        ),
        decay=0.03,
        decay_from=0.1,
        checkpoint_every=250,
        preview_every=500,
    )  # fmt: skip
    method = dataclasses.replace(start.method, skeletal=skeletal, rates=rates)
    return dataclasses.replace(start, name="humannerf_fast", method=method, training=training)


RECIPES: dict[str, Callable[[], Recipe]] = {"humannerf": humannerf, "humannerf_fast": humannerf_fast}
"""What `--recipe` offers."""
