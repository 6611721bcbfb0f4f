"""What every method promises: an avatar that can be posed, rendered, trained and turned into a surface.

Everything above `methods` uses only what stands here, so it never knows which method it has.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, field, replace
from typing import Generic, Literal, TypeVar

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from twofold.body.skeleton import PosedBody
from twofold.capture.types import Capture
from twofold.errors import TwofoldError
from twofold.field.output import FieldOutput
from twofold.geometry.cameras import Rays
from twofold.kernels.row_gradient import RowGradient
from twofold.methods.camera_response import CameraResponse
from twofold.methods.parameter_group import ParameterGroup
from twofold.methods.subject import Subject
from twofold.metrics.perceptual import LPIPS
from twofold.recipe import TrainingConfig

Own = TypeVar("Own")


@dataclass(frozen=True)
class Mode:
    """Whether an avatar is trained or evaluated. A random generator decides randomness only.

    Attributes:
        step: of the training stage, from 0; None in evaluation.
        epoch: how often the stage has seen all training frames.
        starts_epoch: whether this is the epoch's first step.
    """

    step: int | None = None
    epoch: int = 0
    starts_epoch: bool = False

    @property
    def training(self) -> bool:
        """Whether this is training."""
        return self.step is not None


EVALUATION = Mode()
"""No training step."""


@dataclass(frozen=True)
class Stage:
    """A part of a training with an optimizer and settings of its own.

    Attributes:
        name: for progress and curves.
        training: its settings.
    """

    name: str
    training: TrainingConfig


@dataclass(frozen=True)
class Batch:
    """Rays of one image with what was observed along them.

    Attributes:
        rays: single pixels first, then patches row by row.
        image: the image's own colour, background included, 0..1.
        mask: share of the pixel that the person covers.
        singles: how many of the rays are single pixels.
        patch_pixels: for each pixel of each patch, its ray, or -1 outside the body's box and where pixels are ignored.
        patch_image: what the image shows there, pixels without a ray included.
        patch_mask: share of these pixels that the person covers; 0 where pixels are ignored and beyond the image.
        frame_index: which frame of the motion the image shows.
        background: the colour that `color` is composited on, one for all rays or one a ray; None leaves the image's.
    """

    rays: Rays
    image: Float[Tensor, "R 3"]
    mask: Float[Tensor, "R"]
    singles: int
    patch_pixels: Int[Tensor, "patches P P"]
    patch_image: Float[Tensor, "patches P P 3"]
    patch_mask: Float[Tensor, "patches P P"]
    frame_index: int
    background: Float[Tensor, "*r 3"] | None = None

    @property
    def color(self) -> Float[Tensor, "R 3"]:
        """What a rendering is compared with: the person on the batch's background, 0..1."""
        if self.background is None:
            return self.image
        return self.image * self.mask[:, None] + self.background * (1 - self.mask[:, None])

    def against(self, background: Float[Tensor, "*r 3"] | None) -> "Batch":
        """The same batch on another background."""
        return replace(self, background=background)

    @property
    def patch_color(self) -> Float[Tensor, "patches P P 3"]:
        """What the patches show, on the batch's background (one colour), 0..1."""
        if self.background is None:
            return self.patch_image
        mask = self.patch_mask[..., None]
        return self.patch_image * mask + self.background * (1 - mask)

    def patches(
        self, color: Float[Tensor, "R 3"], fill: Float[Tensor, "3"] | None = None
    ) -> Float[Tensor, "patches 3 P P"]:
        """The patches as images, from colours along the rays; pixels without a ray have the colour `fill` or black."""
        none = torch.zeros_like(color[0]) if fill is None else fill
        return torch.cat([color, none[None]])[self.patch_pixels].permute(0, 3, 1, 2)


@dataclass(frozen=True)
class PosedAvatar(Generic[Own]):
    """An avatar's body in a pose, with what its method derives from the pose once.

    Attributes:
        body: the posed body.
        own: private to the method.
    """

    body: PosedBody
    own: Own


@dataclass(frozen=True)
class Rendering:
    """Pixels: colour on the background, opacity, expected depth (metres), normal in observation space (length <= 1).

    Attributes:
        color: 0..1, not clamped.
        opacity: 0..1.
        depth: metres along the ray.
        normal: in observation space; zero where a method has none.
        base: the rendering by the pose-independent branch alone, where a method has one.
        extras: by name what only the method's own losses use.
    """

    color: Float[Tensor, "R 3"]
    opacity: Float[Tensor, "R"]
    depth: Float[Tensor, "R"]
    normal: Float[Tensor, "R 3"]
    base: "Rendering | None" = None
    extras: dict[str, Tensor] = field(default_factory=dict)


class MethodConfig(ABC):
    """A method's configuration: a frozen dataclass that builds the method's avatar."""

    @abstractmethod
    def build(self, subject: Subject, seed: int = 0) -> "Avatar":
        """An untrained avatar of a subject."""

    def total_steps(self, training: TrainingConfig) -> int:
        """Steps of a training, all stages together."""
        return training.steps

    @abstractmethod
    def scaled(self, factor: float) -> "MethodConfig":
        """The configuration with all that it times in steps or epochs of the training multiplied by a factor.

        How often something is repeated to save time, or to keep up with the parameters, is no schedule and stays.
        """

    def fitted(self, capture: Capture) -> tuple["MethodConfig", str | None]:
        """The configuration with what it leaves to a capture settled, and what to tell the user about that."""
        return self, None

    def completing(self, on: bool) -> "MethodConfig":
        """The configuration with unobserved regions completed in training, or left as they come.

        Raises:
            TwofoldError: the method cannot complete them.
        """
        if not on:
            return self
        own = type(self).__name__
        raise TwofoldError(f"{own} does not complete unobserved regions; leave --complete on out, or change --recipe.")


class Avatar(nn.Module, ABC, Generic[Own]):
    """A person that can be posed and rendered. Everything above methods uses only what stands here."""

    subject: Subject
    camera_response: CameraResponse | None = None
    """How known cameras show its colours, where a training has learned that; it is no part of the avatar itself."""

    @property
    def device(self) -> torch.device:
        """Where its parameters are."""
        return next(self.parameters()).device

    # ---- posing and rendering

    @abstractmethod
    def pose(
        self,
        pose: Float[Tensor, "24 3"],
        translation: Float[Tensor, "3"],
        frame_index: int | None = None,
        mode: Mode = EVALUATION,
    ) -> PosedAvatar[Own]:
        """The avatar in a pose.

        Args:
            pose: axis-angle, root first, radians.
            translation: SMPL's own, metres.
            frame_index: a training frame whose learned corrections and codes are to be applied; None applies none.
            mode: training or evaluation.
        """

    @abstractmethod
    def render(
        self, rays: Rays, posed: PosedAvatar[Own], background: Float[Tensor, "*r 3"] | None, mode: Mode = EVALUATION,
        generator: torch.Generator | None = None,
    ) -> Rendering:  # fmt: skip
        """What is seen along rays.

        Args:
            rays: near and far bounds are respected where the method has no bounds of its own.
            posed: the avatar in a pose.
            background: colour behind the person, one for all rays or one a ray; None asks for the method's own
                background, in training only.
            mode: training or evaluation.
            generator: moves samples at random; None spaces them evenly.
        """

    @abstractmethod
    def level(self, x: Float[Tensor, "S 3"], posed: PosedAvatar[Own], branch: str = "full") -> Float[Tensor, "S"]:
        """Zero on the surface, negative inside, about metres near it; of the full field or its base branch.

        The points lie in the space that `level_space` names.
        """

    @property
    def level_space(self) -> Literal["canonical", "posed"]:
        """The space of `level`: canonical, or the posed space of a method whose density is not a canonical one."""
        return "canonical"

    @property
    def reach(self) -> float:
        """Points of observation space further than this from the body's vertices are empty, metres."""
        return 0.1

    @property
    def separates_light(self) -> bool:
        """Whether `query` can leave the lighting out of the colours."""
        return False

    def query(
        self, x_canonical: Float[Tensor, "S 3"], posed: PosedAvatar,
        to_observation: Float[Tensor, "S 3 3"] | None = None, branch: str = "full", lit: bool = True,
    ) -> FieldOutput:  # fmt: skip
        """The field at points of canonical space: signed distance, colour, canonical gradient.

        Args:
            x_canonical: points, metres.
            posed: the pose that the field is conditioned on.
            to_observation: turns canonical gradients into those of observation space (`to_canonical`), for colours
                that depend on normals; None leaves normals canonical.
            branch: "full" or "base".
            lit: False leaves the lighting out, where `separates_light`; the gradient may then be None.

        Raises:
            TwofoldError: the method has no such field.
        """
        raise TwofoldError(f"{type(self).__name__} has no field that can be queried on a surface; render it instead.")

    def to_canonical(
        self, x_posed: Float[Tensor, "S 3"], posed: PosedAvatar
    ) -> tuple[Float[Tensor, "S 3"], Float[Tensor, "S 3 3"]]:
        """Points of observation space in canonical space, as `render` maps its samples; and J^-T of the skinning.

        Raises:
            TwofoldError: the method has no such map.
        """
        raise TwofoldError(f"{type(self).__name__} does not map points to canonical space; render it instead.")

    # ---- training

    def one_thread_each(self, rays: int) -> bool:
        """Whether PyTorch should use one thread per operation in steps of that many rays; compiled loops use all."""
        return False

    def stages(self, training: TrainingConfig) -> tuple[Stage, ...]:
        """The stages of a training, one after the other; most methods have one."""
        return (Stage("train", training),)

    def check_capture(self, capture: Capture) -> str | None:
        """Called with the capture of a new training before anything is written; may return a note for the user.

        Raises:
            TwofoldError: the capture lacks what the method needs.
        """

    def prepare_training(self, capture: Capture, stage: int, generator: torch.Generator) -> None:
        """Called once before a stage's first step: pre-fits, key frames. What it makes is part of the state.

        Raises:
            TwofoldError: the capture lacks what the method needs.
        """

    def load_stored(self, state: dict[str, Tensor]) -> None:
        """Called with a stored state before it is loaded, to take on sizes and the stage that it was stored in."""

    def background(
        self, color: Float[Tensor, "3"], rays: int, generator: torch.Generator
    ) -> Float[Tensor, "*r 3"] | None:
        """What images are composited on in a training step: the capture's colour unless a method wants another.

        None trains on the images' own background, which the method then renders itself.
        """
        return color

    @abstractmethod
    def losses(
        self, rendering: Rendering, batch: Batch, posed: PosedAvatar[Own], mode: Mode, generator: torch.Generator
    ) -> dict[str, Float[Tensor, ""]]:
        """Named loss terms, already weighted; the loop adds them."""

    def before_step(self, mode: Mode) -> None:
        """Called before each training step."""

    def after_step(self, mode: Mode, capture: Capture) -> Literal["continue", "restart"]:
        """Called after each training step; "restart" starts the training again from other initial weights."""
        return "continue"

    @abstractmethod
    def parameter_groups(self) -> list[ParameterGroup]:
        """Trainable parameters of the current stage with their learning rates."""

    def row_gradients(self, collect: bool) -> dict[nn.Parameter, RowGradient]:
        """Tables whose gradients compiled loops add up row by row from now on; none of them with `collect` off."""
        return {}

    @property
    def ray_margin(self) -> float:
        """How far from the body's vertices rays of training pixels may pass, metres."""
        return 0.32

    def scalars(self) -> dict[str, float]:
        """Values for the training curves, by name."""
        return {}

    @property
    def wants_perceptual(self) -> bool:
        """Whether a perceptual network is part of the loss."""
        return False

    def attach_perceptual(self, network: LPIPS | None) -> None:
        """Takes the network of the perceptual loss, which is neither trained nor stored; None leaves the term out."""

    def compiled(self) -> AbstractContextManager[bool]:
        """While the block lasts, what a compiler can make faster runs compiled; tells whether there is anything."""
        return nullcontext(False)

    # ---- refined poses

    def refined_pose(
        self, frame_index: int, pose: Float[Tensor, "24 3"], translation: Float[Tensor, "3"], max_gap: float,
        clock: Callable[[int], float] = float,
    ) -> tuple[Float[Tensor, "24 3"], Float[Tensor, "3"]]:  # fmt: skip
        """A frame's pose with what training learned about the errors of the capture's poses.

        A training frame has a correction of its own. Another frame between two of these takes theirs, interpolated, if
        they are at most `max_gap` apart by `clock`, which tells when a frame was taken (by default its index). All
        others stay as given, as they do without pose refinement.
        """
        return pose, translation

    def pose_corrections(self) -> dict[str, float]:
        """Root-mean-square size of the learned corrections, radians and metres; empty without pose refinement."""
        return {}
