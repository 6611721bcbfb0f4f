"""What every method promises: an avatar that can be posed, rendered, trained and turned into a surface."""

from abc import ABC, abstractmethod
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from twofold.body.skeleton import Body, PosedBody
from twofold.capture.types import Capture
from twofold.errors import TwofoldError
from twofold.field.output import FieldOutput
from twofold.geometry.cameras import Rays
from twofold.npz import are_moderate
from twofold.sampling.shell import Shell


@dataclass(frozen=True)
class Subject:
    """The person that an avatar is made of: body and training motion. A run folder carries it as arrays.

    Attributes:
        body: the body model.
        betas: its shape coefficients.
        times: moments of the training frames, ascending.
        poses: their axis-angle rotations, radians.
        translations: their translations, metres.
        scene_scale: what the authors' release multiplies lengths with (3 / (1.1 times the furthest camera)).
    """

    body: Body
    betas: Float[Tensor, "S"]
    times: Int[Tensor, "T"]
    poses: Float[Tensor, "T 24 3"]
    translations: Float[Tensor, "T 3"]
    scene_scale: float

    @staticmethod
    def of(capture: Capture) -> "Subject":
        """The subject of a capture's training frames."""
        moments = {frame.time: frame for frame in capture.train}
        frames = [moments[time] for time in sorted(moments)]
        middle = torch.stack([f.translation + capture.body.joints[0] for f in frames]).mean(0)
        away = max(float((f.camera.center - middle).norm()) for f in frames)
        return Subject(
            body=capture.body,
            betas=capture.betas,
            times=torch.tensor([f.time for f in frames]),
            poses=torch.stack([f.pose for f in frames]),
            translations=torch.stack([f.translation for f in frames]),
            scene_scale=3 / (1.1 * away),
        )

    def arrays(self) -> dict[str, np.ndarray]:
        """As a run folder stores it."""
        own = {"betas": self.betas, "times": self.times, "poses": self.poses, "translations": self.translations}
        body = {f"body_{name}": array for name, array in self.body.arrays().items()}
        return {**{name: t.numpy() for name, t in own.items()}, **body, "scene_scale": np.array(self.scene_scale)}

    @staticmethod
    def from_arrays(arrays: dict[str, np.ndarray], where: str) -> "Subject":
        """What `arrays` gave, read back.

        Raises:
            TwofoldError: something is missing, has the wrong shape or is not finite.
        """
        shapes = {"betas": ("S",), "times": ("T",), "poses": ("T", 24, 3), "translations": ("T", 3), "scene_scale": ()}
        missing = [name for name in shapes if name not in arrays]
        if missing:
            raise TwofoldError(f"{where} lacks {', '.join(missing)}; it is damaged, train again.")
        body = Body.from_arrays({n[5:]: a for n, a in arrays.items() if n.startswith("body_")}, where)
        sizes: dict[str | int, int] = {"S": arrays["betas"].size, "T": arrays["times"].size}
        for name, shape in shapes.items():
            array, expected = arrays[name], tuple(sizes.get(axis, axis) for axis in shape)
            if array.shape != expected or array.dtype.kind not in "fiu" or not are_moderate(array):
                raise TwofoldError(
                    f"{name} in {where} should be finite numbers of shape {expected}, it is {array.dtype} of "
                    f"{array.shape}; it is damaged, train again."
                )
        return Subject(
            body=body,
            betas=torch.as_tensor(arrays["betas"]).float(),
            times=torch.as_tensor(arrays["times"]).long(),
            poses=torch.as_tensor(arrays["poses"]).float(),
            translations=torch.as_tensor(arrays["translations"]).float(),
            scene_scale=float(arrays["scene_scale"]),
        )


@dataclass(frozen=True)
class Batch:
    """Rays of one picture with what was seen along them.

    Attributes:
        rays: single pixels first, then patches row by row.
        color: what the picture shows, on the capture's background, 0..1.
        mask: share of the pixel that the person covers.
        singles: how many of the rays are single pixels.
        patch_pixels: for each pixel of each patch, its ray, or -1 outside the body's box and where pixels are ignored.
        patch_color: what the picture shows there, pixels without a ray included; the background where pixels are
            ignored and beyond the picture.
        background: colour outside the mask, 0..1.
    """

    rays: Rays
    color: Float[Tensor, "R 3"]
    mask: Float[Tensor, "R"]
    singles: int
    patch_pixels: Int[Tensor, "patches P P"]
    patch_color: Float[Tensor, "patches P P 3"]
    background: Float[Tensor, "3"]

    def patches(
        self, color: Float[Tensor, "R 3"], fill: Float[Tensor, "3"] | None = None
    ) -> Float[Tensor, "patches 3 P P"]:
        """The patches as pictures, from colours along the rays; pixels without one have the colour `fill` or black."""
        none = torch.zeros_like(color[0]) if fill is None else fill
        return torch.cat([color, none[None]])[self.patch_pixels].permute(0, 3, 1, 2)


@dataclass(frozen=True)
class PosedAvatar:
    """A body in a pose with what rendering derives from it once.

    Attributes:
        body: the posed body.
        forward: canonical-to-posed transform at each vertex.
        condition: what the pose-dependent branch is told.
        shell: where to sample.
        box: two corners around the joints, where rays without a shell begin and end, metres.
        neighbours: how many nearest vertices give a point its skinning weights.
        anchors: canonical vertices that turn normals, where these are not the ones that inverse skinning found.
    """

    body: PosedBody
    forward: Float[Tensor, "V 3 4"]
    condition: Float[Tensor, "P"]
    shell: Shell
    box: Float[Tensor, "2 3"]
    neighbours: int = 1
    anchors: Float[Tensor, "V 3"] | None = None


@dataclass(frozen=True)
class Rendering:
    """Pixels: colour on the background, opacity, expected depth (metres), normal in observation space (length <= 1).

    `base` is the rendering by the pose-independent branch alone, where a method has one and it was asked for.
    """

    color: Float[Tensor, "R 3"]
    opacity: Float[Tensor, "R"]
    depth: Float[Tensor, "R"]
    normal: Float[Tensor, "R 3"]
    base: "Rendering | None" = None


class MethodConfig(ABC):
    """A method's configuration: a frozen dataclass that builds the method's avatar."""

    @abstractmethod
    def build(self, subject: Subject, seed: int = 0) -> "Avatar":
        """An untrained avatar of a subject."""


class Avatar(nn.Module, ABC):
    """A person that can be posed and looked at. Everything above methods uses only what stands here."""

    @abstractmethod
    def pose(
        self,
        pose: Float[Tensor, "24 3"],
        translation: Float[Tensor, "3"],
        time: int | None = None,
        step: int | None = None,
    ) -> PosedAvatar:
        """The avatar in a pose.

        Args:
            pose: axis-angle, root first, radians.
            translation: SMPL's own, metres.
            time: a training moment whose learned pose correction is to be applied; None applies none.
            step: the training step, for schedules; None when not training.
        """

    @abstractmethod
    def render(
        self, rays: Rays, posed: PosedAvatar, background: Float[Tensor, "3"], generator: torch.Generator | None = None
    ) -> Rendering:
        """What is seen along rays. With a generator, samples are placed at random (training); without, evenly."""

    @abstractmethod
    def losses(
        self, rendering: Rendering, batch: Batch, posed: PosedAvatar, step: int, generator: torch.Generator
    ) -> dict[str, Float[Tensor, ""]]:
        """Named loss terms, already weighted; the loop adds them."""

    @abstractmethod
    def level(self, x_canonical: Float[Tensor, "S 3"], posed: PosedAvatar, branch: str = "full") -> Float[Tensor, "S"]:
        """Zero on the surface in canonical space, negative inside; of the "full" field or its "base" branch."""

    @property
    def reach(self) -> float:
        """Points of observation space further than this from the body's vertices are empty, metres."""
        return 0.1

    @property
    def separates_light(self) -> bool:
        """Whether `query` can leave the lighting out of the colours."""
        return False

    def query(
        self,
        x_canonical: Float[Tensor, "S 3"],
        posed: PosedAvatar,
        to_observation: Float[Tensor, "S 3 3"] | None = None,
        branch: str = "full",
        lit: bool = True,
    ) -> FieldOutput:
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

    @abstractmethod
    def before_step(self, step: int) -> None:
        """Called before each training step."""

    def count_epochs(self, steps: int | float) -> None:
        """Called before the first step with the length of an epoch, for methods whose schedules count them."""

    def compiled(self) -> AbstractContextManager[bool]:
        """While the block lasts, what a compiler can make faster runs compiled; tells whether there is anything."""
        return nullcontext(False)

    @abstractmethod
    def parameter_groups(self) -> dict[str, list[nn.Parameter]]:
        """Trainable parameters by name of their learning rate."""
