"""The paper's method: an avatar whose field has a pose-independent and a pose-dependent branch."""

import dataclasses
from contextlib import AbstractContextManager
from dataclasses import dataclass
from typing import Literal

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from twofold.capture.types import Capture
from twofold.config import require
from twofold.field.factorized import FactorizedField, FactorizedFieldConfig
from twofold.field.factorized_grid import GridField, GridFieldConfig
from twofold.field.output import FieldOutput
from twofold.geometry.surfaces import vertex_normals
from twofold.kernels.row_gradient import RowGradient
from twofold.kernels.runtime import compiled_methods
from twofold.methods.base import Batch, Mode, Rendering
from twofold.methods.factorized_config import RateConfig
from twofold.methods.parameter_group import ParameterGroup
from twofold.methods.pixel_levels import following
from twofold.methods.skinned import Posed, SkinnedAvatar
from twofold.methods.skinned_config import SkinnedConfig
from twofold.methods.subject import Subject
from twofold.sampling.shell_sampler import ShellSampler


@dataclass(frozen=True)
class FactorizedConfig(SkinnedConfig):
    """The factorized avatar; the defaults are the authors' release."""

    field: FactorizedFieldConfig | GridFieldConfig = dataclasses.field(default_factory=FactorizedFieldConfig)
    rates: RateConfig = dataclasses.field(default_factory=RateConfig)
    background: Literal["capture", "random"] = "capture"
    """What training images are composited on: the capture's background, or a random colour at each step."""

    def __post_init__(self) -> None:
        """Refuses options that exclude each other."""
        super().__post_init__()
        if isinstance(self.field, GridFieldConfig) and isinstance(self.sampler, ShellSampler):
            within = self.sampler.radius <= self.field.radius
            require(within, f"sampler.radius should be at most field.radius={self.field.radius}, where features end")

    def fitted(self, capture: Capture) -> tuple["FactorizedConfig", str | None]:
        """See `MethodConfig.fitted`: feature grids become as fine as the images."""
        if not isinstance(self.field, GridFieldConfig):
            return self, None
        field, note = following(self.field, capture)
        return dataclasses.replace(self, field=field), note

    def build(self, subject: Subject, seed: int = 0) -> "FactorizedAvatar":
        """An untrained avatar of a subject."""
        return FactorizedAvatar(self, subject, seed)


class FactorizedAvatar(SkinnedAvatar[FactorizedConfig, FactorizedField | GridField]):
    """See `FactorizedConfig`."""

    def __init__(self, config: FactorizedConfig, subject: Subject, seed: int) -> None:
        """Builds the field around the subject's canonical body."""
        super().__init__(config, subject, seed, config.field.build)

    def load_stored(self, state: dict[str, Tensor]) -> None:
        """See `Avatar.load_stored`: runs of an earlier version switch the residual off where nothing was observed."""
        super().load_stored(state)
        if "field.observed" in state and isinstance(self.field, GridField):
            self.field.make_observable()

    def answer_beside(self, x_canonical: Float[Tensor, "S 3"], vertex: Int[Tensor, "S"], posed: Posed) -> FieldOutput:
        """See `SkinnedAvatar.answer_beside`; of feature grids it is without light, and their networks do not learn."""
        if isinstance(self.field, GridField):
            return self.field.unlit_features(x_canonical, posed.own.condition)
        return super().answer_beside(x_canonical, vertex, posed)

    def light_beside(self, vertex: Int[Tensor, "S"], posed: Posed) -> Float[Tensor, "S 3"]:
        """See `SkinnedAvatar.light_beside`."""
        if isinstance(self.field, GridField):
            return self.field.light_on(vertex_normals(posed.body.vertices, posed.body.faces)[vertex])
        return super().light_beside(vertex, posed)

    def losses(
        self, rendering: Rendering, batch: Batch, posed: Posed, mode: Mode, generator: torch.Generator
    ) -> dict[str, Float[Tensor, ""]]:
        """See `Avatar.losses`; with completion, the law of light of feature grids is kept simple."""
        terms = super().losses(rendering, batch, posed, mode, generator)
        light = self.config.completion.light
        if self.completion is not None and isinstance(self.field, GridField) and light > 0:
            terms["completion_light"] = light * self.completion.unobserved * self.field.light_bend()
        return terms

    @property
    def _two_branches(self) -> bool:
        return self.config.field.branches in ("both", "high_rendered")

    def one_thread_each(self, rays: int) -> bool:
        """See `Avatar.one_thread_each`: steps of feature grids are many small operations."""
        return not self.field.dense and rays <= FEW_RAYS

    def compiled(self) -> AbstractContextManager[bool]:
        """See `Avatar.compiled`. Feature grids have compiled loops of their own."""
        return compiled_methods(self.field, ("forward", "_sdf", "distance_and_gradient") if self.field.dense else ())

    def parameter_groups(self) -> list[ParameterGroup]:
        """The field's groups, "beta" and "pose"."""
        return self.groups_with(self.field.parameter_groups(), self.config.rates)

    def row_gradients(self, collect: bool) -> dict[nn.Parameter, RowGradient]:
        """See `Avatar.row_gradients`: the tables of feature grids."""
        return self.field.row_gradients(collect) if isinstance(self.field, GridField) else {}

    def background(
        self, color: Float[Tensor, "3"], rays: int, generator: torch.Generator
    ) -> Float[Tensor, "*r 3"] | None:
        """See `Avatar.background`."""
        if self.config.background == "capture":
            return color
        return torch.rand(3, generator=generator, device=generator.device).to(color)

    @property
    def separates_light(self) -> bool:
        """See `Avatar.separates_light`."""
        return self.field.separates_light

    def query(
        self, x_canonical: Float[Tensor, "S 3"], posed: Posed,
        to_observation: Float[Tensor, "S 3 3"] | None = None, branch: str = "full", lit: bool = True,
    ) -> FieldOutput:  # fmt: skip
        """See `Avatar.query`."""
        require(branch in ("full", "base"), f'branch is "full" or "base"; it is {branch!r}')
        if self.field.separates_light and not lit:
            answer = self.field.unlit(x_canonical, posed.own.condition)
        else:
            answer = self.field(x_canonical, posed.own.condition, to_observation)
        return answer if branch == "full" else answer.base or answer


FEW_RAYS = 8192
"""Rays of a step up to which PyTorch's operations on feature grids are faster on one thread each."""
