"""Settings of the methods whose field is moved by the body's skinning, and what these derive from a pose."""

import dataclasses
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Literal, Protocol

from jaxtyping import Float
from torch import Tensor, nn

from twofold.config import require, require_within
from twofold.field.output import FieldOutput
from twofold.losses import MAX_STEPS, LossConfig
from twofold.methods.base import MethodConfig
from twofold.methods.completion import CompletionConfig
from twofold.methods.pose_schedule import PoseConfig
from twofold.recipe import scaled_count
from twofold.sampling.error_bounded import ErrorBoundedSampler
from twofold.sampling.posed_surface import PosedSurface
from twofold.sampling.shell_sampler import ShellSampler

COMPLETING = CompletionConfig(color=2.0, shape=0.04, outlines=1.0)
"""Completion of unobserved regions as `--complete on` asks for it."""


@dataclass(frozen=True)
class SkinnedConfig(MethodConfig):
    """Settings that these methods share; the defaults are those of the release of the factorized method."""

    sampler: ErrorBoundedSampler | ShellSampler = dataclasses.field(default_factory=ShellSampler)
    losses: LossConfig = dataclasses.field(default_factory=LossConfig)
    pose: PoseConfig = dataclasses.field(default_factory=PoseConfig)
    completion: CompletionConfig = dataclasses.field(default_factory=CompletionConfig)
    neighbours: int = 1
    """How many nearest vertices give a point its skinning weights."""
    late_neighbours: int | None = None
    """The same in training from epoch `late_from` on; 7 in the release, whose validation changes it."""
    late_from: int = 100
    """Epochs before that; every that many epochs the canonical body that turns normals follows the corrected shape."""
    falloff: Literal["exponential", "scene", "smooth"] = "exponential"
    """How these count by distance: "exponential", nearly alike in metres; "scene", so in scene units, as released;
    "smooth", down to nothing at the last of them, so that points beside each other move alike."""
    normals_by: Literal["posed", "canonical"] = "posed"
    """Whose nearest vertices turn normals: "posed", those that moved the sample; "canonical", as released."""
    beta: float = 0.1
    """Initial scale of the density, metres."""
    beta_floor: float = 1e-4
    """Least scale of the density, metres."""
    beta_form: Literal["softplus", "absolute"] = "softplus"
    """How the scale is kept positive; "absolute" is the release's |beta|, which can stall at zero."""
    outlier_distance: float = 0.1
    """Points further than this from the body, metres, count as empty."""
    outliers_in_shading: bool = True
    """Whether that also holds for the colours; the release forgets it there."""
    scene_scale: Literal["metres", "released"] = "metres"
    """"released" measures lengths along rays and outliers in the release's normalised scene units."""
    shell_refresh: int = 500
    """Steps after which the shells follow the corrected poses."""

    def __post_init__(self) -> None:
        """Refuses options that exclude each other."""
        require_within(
            self, neighbours=(1, 64), late_neighbours=(1, 64), late_from=(1, MAX_STEPS),
            shell_refresh=(1, MAX_STEPS), outlier_distance=(0.001, 10), beta=(0, 10),
        )  # fmt: skip
        require(0 < self.beta_floor < self.beta, f"beta_floor should lie between 0 and beta={self.beta}")

    def scaled(self, factor: float) -> "SkinnedConfig":
        """See `MethodConfig.scaled`."""
        losses = dataclasses.replace(self.losses, lpips_start=scaled_count(self.losses.lpips_start, factor))
        return dataclasses.replace(
            self,
            losses=losses,
            pose=self.pose.scaled(factor),
            completion=self.completion.scaled(factor),
            late_from=scaled_count(self.late_from, factor),
        )

    def completing(self, on: bool) -> "SkinnedConfig":
        """See `MethodConfig.completing`."""
        if on == self.completion.active:
            return self
        return dataclasses.replace(self, completion=COMPLETING if on else CompletionConfig())


class CanonicalField(Protocol):
    """A field of canonical space, conditioned on the pose.

    Attributes:
        dense: each query passes through large networks.
    """

    dense: bool

    def __call__(
        self, x_canonical: Float[Tensor, "S 3"], pose: Float[Tensor, "P"],
        to_observation: Float[Tensor, "S 3 3"] | None = None, /,
    ) -> FieldOutput:  # fmt: skip
        """Distance, colour and canonical gradient; normals are turned by `to_observation`."""
        ...

    def sdf(self, x_canonical: Float[Tensor, "S 3"], pose: Float[Tensor, "P"], /) -> Float[Tensor, "S"]:
        """The distance alone, metres."""
        ...

    def sdf_at(self, pose: Float[Tensor, "P"], /) -> Callable[[Float[Tensor, "S 3"]], Float[Tensor, "S"]]:
        """`sdf` at one pose without gradients, for many small sets of points between two changes of parameters."""
        ...

    def distance_and_gradient(
        self, x_canonical: Float[Tensor, "S 3"], pose: Float[Tensor, "P"], /
    ) -> tuple[Float[Tensor, "S"], Float[Tensor, "S 3"]]:
        """The distance and its canonical gradient."""
        ...

    def parameters(self, recurse: bool = True) -> Iterator[nn.Parameter]:
        """Its trainable parameters."""
        ...


@dataclass(frozen=True)
class SkinnedPose:
    """What these methods derive from a pose.

    Attributes:
        surface: the posed body with its shell.
        condition: the pose vector that the field is conditioned on.
        anchors: canonical vertices that turn normals, where these are not the ones that inverse skinning found.
        row: of the training frame that the pose belongs to, or None.
    """

    surface: PosedSurface
    condition: Float[Tensor, "P"]
    anchors: Float[Tensor, "V 3"] | None = None
    row: int | None = None
