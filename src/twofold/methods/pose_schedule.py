"""What of the pose the pose-dependent branch sees, and when; and what of the given poses is corrected."""

import math
from dataclasses import dataclass, replace
from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor, nn

from twofold.config import require, require_within
from twofold.losses import MAX_STEPS
from twofold.methods.parameter_group import ParameterGroup
from twofold.recipe import scaled_count


@dataclass(frozen=True)
class PoseConfig:
    """What the pose-dependent branch is conditioned on, and which poses are corrected while training."""

    divide_by_pi: bool = True
    with_root: bool = False
    """Whether the global orientation is part of it."""
    zero_until: int = 10_000
    """The branch sees a zero pose before this step."""
    zero_epochs: int = 0
    """And before this epoch."""
    zero_every: int = 50
    """Afterwards it sees a zero pose during every epoch (a step a frame) whose number this divides; 0 for never."""
    drop: float = 0.0
    """Chance of a zero pose at any training step (ours; the schedule above is the release's)."""
    epochs: Literal["moments", "training"] = "moments"
    """Epochs of `zero_every`: "moments", one step for each frame; "training", those of the training, as released."""
    refine: tuple[Literal["root", "body", "translation", "shape"], ...] = ("root", "body", "translation", "shape")
    refine_from: int = 0
    """First step at which poses are corrected."""
    averages: Literal["steps", "visits"] = "steps"
    """When Adam's running means of a frame's gradients change: "steps", in all, as in the release; "visits", in steps
    that see the frame, so that what its images say is averaged (ours; see `twofold.training.row_adam`)."""
    shrinkage: float = 0.0
    """Factor of the noise by which the steps of a joint's corrections shrink: larger values suppress more, 0 none
    (ours, with averages of visits; see `twofold.training.row_adam.shrink`)."""
    decay_power: float = 1.0
    """Power of what the schedule multiplies the learning rate of the corrections with; 2 lets it fall twice as fast as
    the others (ours)."""
    observed_only: bool = False
    """Whether corrections leave directions alone that no training camera of the frame sees (ours; see
    `twofold.deform.observability`)."""
    canonical_shape: Literal["refined", "given"] = "refined"
    """Whose joints bones leave canonical space from: the corrected shape's, or, as released, those of the one given."""
    test_shape: Literal["refined", "given"] = "refined"
    """Shape of poses that are no training frames: the corrected one, or, as released, the one given."""

    def __post_init__(self) -> None:
        """Refuses chances and steps that there are not."""
        steps = (0, MAX_STEPS)
        require_within(
            self,
            zero_until=steps,
            zero_epochs=steps,
            zero_every=steps,
            drop=(0, 1),
            refine_from=steps,
            decay_power=(0, 10),
            shrinkage=(0, 10),
        )
        require(
            self.averages == "visits" or not self.shrinkage,
            "shrinkage needs averages=visits; set shrinkage to 0 with other averages",
        )

    def group(self, name: str, rate: float, parameters: list[nn.Parameter]) -> ParameterGroup:
        """A group of a method's parameters; that of the corrections, named "pose", as is asked for here."""
        if name != "pose":
            return ParameterGroup(name, rate, parameters)
        by_visit = self.averages == "visits"
        return ParameterGroup(name, rate, parameters, by_visit, self.decay_power, self.shrinkage)

    def scaled(self, factor: float) -> "PoseConfig":
        """The schedule stretched by a factor; zero poses later on keep their share of the epochs."""
        return replace(
            self,
            zero_until=scaled_count(self.zero_until, factor),
            zero_epochs=scaled_count(self.zero_epochs, factor),
            refine_from=scaled_count(self.refine_from, factor),
        )


def condition(config: PoseConfig, pose: Float[Tensor, "24 3"], step: int | None, epoch: int) -> Float[Tensor, "P"]:
    """What the pose-dependent branch is conditioned on.

    Args:
        config: its form and schedule.
        pose: axis-angle, root first, radians.
        step: the training step; None when not training, where the schedule does not hold.
        epoch: that the step belongs to.
    """
    seen = (pose if config.with_root else pose[1:]).flatten()
    if config.divide_by_pi:
        seen = seen / math.pi
    if step is None:
        return seen
    dropped = _hash01(step) < config.drop
    early = step < config.zero_until or epoch < config.zero_epochs
    if early or dropped or (config.zero_every and epoch % config.zero_every == 0):
        return torch.zeros_like(seen)
    return seen


def _hash01(step: int) -> float:
    """A fixed number in 0..1 for each step, so that a resumed run makes the same choices."""
    return ((step * 2654435761 + 12345) % 4294967296) / 4294967296
