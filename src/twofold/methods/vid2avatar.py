"""Vid2Avatar: one signed distance and colour in canonical space, before a background field or a known background."""

import dataclasses
from dataclasses import dataclass
from typing import Literal, cast

import torch
from jaxtyping import Float
from torch import Tensor, nn

from twofold import losses
from twofold.body.skeleton import pose_body
from twofold.capture.types import Capture
from twofold.config import require, require_within
from twofold.errors import TwofoldError
from twofold.field.implicit_geometry import ImplicitField, ImplicitFieldConfig
from twofold.field.inverted_sphere import (
    RADIUS,
    InvertedSphereFieldConfig,
    inverse_distances,
    inverse_intervals,
    inverted_sphere_points,
    sphere_exit,
)
from twofold.field.prefit import PrefitConfig
from twofold.field.prefit_cache import fitted_distance
from twofold.geometry.cameras import Rays
from twofold.geometry.isosurface import extract_surface
from twofold.geometry.signed_distance import signed_distance
from twofold.methods.backdrop import require_backdrop
from twofold.methods.base import EVALUATION, Batch, Mode, Rendering
from twofold.methods.parameter_group import ParameterGroup
from twofold.methods.skinned import Posed, SkinnedAvatar
from twofold.methods.skinned_config import SkinnedConfig
from twofold.methods.subject import Subject
from twofold.recipe import scaled_count
from twofold.sampling.placement import Placement
from twofold.sampling.shell_sampler import ShellPlacer, ShellSampler
from twofold.volume.nerf_compositing import open_density_weights
from twofold.volume.rendering import composite
from twofold.volume.samples import Samples

MAX_PACE = 1000.0
"""Epochs in one by which the weights of separation move on at most."""


@dataclass(frozen=True)
class SeparationConfig:
    """How person and background are told apart without masks; a weight of zero leaves a term out."""

    binarisation: float = 5e-3
    """Weight of the opacity's entropy."""
    sparseness: float = 1.0
    """Factor of the growing weight on opacity far from the canonical surface (`losses.sparseness_weights`)."""
    in_shape: float = 1.0
    """Factor of the falling weight on missing opacity inside it."""
    pace: float = 1.0
    """Epochs by which these weights move on in an epoch of the training."""
    surface_every: int = 20
    """Epochs after which that surface, the body at first, becomes that of the field."""
    surface_cells: int = 128
    """Cells along the longest edge of the box that it is extracted in."""

    def __post_init__(self) -> None:
        """Refuses weights that reward what they should punish."""
        require_within(
            self, binarisation=(0, 1e6), sparseness=(0, 1e6), in_shape=(0, 1e6), pace=(0, MAX_PACE),
            surface_every=(1, 1_000_000), surface_cells=(16, 1024),
        )  # fmt: skip

    @property
    def needs_surface(self) -> bool:
        """Whether a term looks at the canonical surface."""
        return self.sparseness > 0 or self.in_shape > 0

    def scaled(self, factor: float) -> "SeparationConfig":
        """The schedule stretched by a factor: the weights end where they did."""
        every = scaled_count(self.surface_every, factor)
        return dataclasses.replace(self, pace=min(self.pace / factor, MAX_PACE), surface_every=every)


NO_SEPARATION = SeparationConfig(binarisation=0.0, sparseness=0.0, in_shape=0.0)
"""For captures with masks."""


@dataclass(frozen=True)
class Vid2AvatarRates:
    """Learning rates of the parameter groups, before schedules."""

    networks: float = 5e-4
    """Of the person."""
    scene: float = 5e-4
    """Network of the background, and its codes."""
    beta: float = 5e-4
    """Scale of the density."""
    pose: float = 5e-5
    """Pose corrections."""

    def __post_init__(self) -> None:
        """Refuses rates that diverge at once."""
        require_within(self, **dict.fromkeys(vars(self), (0, 1000)))


@dataclass(frozen=True)
class Vid2AvatarConfig(SkinnedConfig):
    """Vid2Avatar's avatar. `scene` and `separation` are the original; without them masks take their place."""

    field: ImplicitFieldConfig = dataclasses.field(default_factory=ImplicitFieldConfig)
    scene: InvertedSphereFieldConfig | None = dataclasses.field(default_factory=InvertedSphereFieldConfig)
    """The field behind the person; None composites on the capture's colour."""
    scene_samples: int = 32
    """Samples of each ray behind the sphere."""
    center: Literal["body", "world"] = "world"
    """Middle of that sphere: "body", as released, the middle of each frame's body; "world", one for all frames."""
    separation: SeparationConfig = dataclasses.field(default_factory=SeparationConfig)
    rates: Vid2AvatarRates = dataclasses.field(default_factory=Vid2AvatarRates)
    prefit: PrefitConfig | None = dataclasses.field(default_factory=PrefitConfig)
    """How the distance is fitted to the canonical body before the first step; None starts from a sphere."""

    def __post_init__(self) -> None:
        """Refuses options that exclude each other."""
        super().__post_init__()
        require_within(self, scene_samples=(2, 4096))
        whole = isinstance(self.sampler, ShellSampler) or self.sampler.box == "rays"
        require(self.scene is None or whole, "scene needs sampler.box=rays: rays run to the sphere around the scene")
        require(self.losses.mask == 0 or self.scene is None, "losses.mask needs scene=none: masks replace the scene")

    def scaled(self, factor: float) -> "Vid2AvatarConfig":
        """See `MethodConfig.scaled`."""
        return cast(
            Vid2AvatarConfig, dataclasses.replace(super().scaled(factor), separation=self.separation.scaled(factor))
        )

    def build(self, subject: Subject, seed: int = 0) -> "Vid2Avatar":
        """An untrained avatar of a subject."""
        return Vid2Avatar(self, subject, seed)


class Vid2Avatar(SkinnedAvatar[Vid2AvatarConfig, ImplicitField]):
    """See `Vid2AvatarConfig`."""

    surface_vertices: Tensor
    surface_faces: Tensor
    middle: Tensor

    def __init__(self, config: Vid2AvatarConfig, subject: Subject, seed: int) -> None:
        """Builds both fields; the person's begins as a sphere, which `prepare_training` makes a body."""
        super().__init__(
            config, subject, seed, lambda _, pose_size, generator: config.field.build(pose_size, generator)
        )
        self.scene = None
        if config.scene is not None:
            generator = torch.Generator().manual_seed(seed + _SCENE_SEED)
            self.scene = config.scene.build(generator)
            self.codes = nn.Parameter(torch.randn(len(subject.times), config.scene.code_size, generator=generator))
            middle = subject.translations.mean(0) + subject.body.joints[0]
            self.register_buffer("middle", middle, persistent=False)
        self._middles: dict[int, Tensor] = {}
        if config.separation.needs_surface:
            self.register_buffer("surface_vertices", self.canonical_points.clone())
            self.register_buffer("surface_faces", subject.body.faces.clone())

    def parameter_groups(self) -> list[ParameterGroup]:
        """The groups "networks", "scene", "beta" and "pose"."""
        scene = [] if self.scene is None else [*self.scene.parameters(), self.codes]
        return self.groups_with({"networks": [*self.field.parameters()], "scene": scene}, self.config.rates)

    def background(
        self, color: Float[Tensor, "3"], rays: int, generator: torch.Generator
    ) -> Float[Tensor, "*r 3"] | None:
        """See `Avatar.background`: the image's own where the avatar has a scene, else the capture's."""
        return color if self.scene is None else None

    # ---- what happens around the steps

    def check_capture(self, capture: Capture) -> None:
        """See `Avatar.check_capture`: a scene needs a background to learn, seen from within its sphere.

        Raises:
            TwofoldError: the background was removed, or a camera is outside.
        """
        if self.scene is None:
            return
        require_backdrop(capture)
        for row, time in enumerate(self.subject.times.tolist()):
            middle = self._middle(row)
            for frame in capture.train:
                away = float((frame.camera.center - middle).norm()) * self.subject.scene_scale
                if frame.frame_index == time and away >= RADIUS:
                    raise TwofoldError(
                        f"The camera {frame.camera_name} is outside the sphere around the body at frame {time}, where "
                        "the background begins; train with --set method.center=world."
                    )

    def prepare_training(self, capture: Capture, stage: int, generator: torch.Generator) -> None:
        """See `Avatar.prepare_training`: the distance becomes that of the canonical body."""
        super().prepare_training(capture, stage, generator)
        prefit, size = self.config.prefit, len(self._no_pose())
        if prefit is not None:
            body = self.canonical_points.cpu(), self.subject.body.faces
            self.field.networks.sdf.load_state_dict(fitted_distance(self.config.field, size, *body, prefit))

    def load_stored(self, state: dict[str, Tensor]) -> None:
        """See `Avatar.load_stored`: the canonical surface has any number of vertices and triangles.

        Raises:
            TwofoldError: its triangles name vertices that it does not have.
        """
        super().load_stored(state)
        vertices, faces = state.get("surface_vertices"), state.get("surface_faces")
        if vertices is None or faces is None or not self.config.separation.needs_surface:
            return
        if vertices.ndim != 2 or vertices.shape[1] != 3 or faces.ndim != 2 or faces.shape[1] != 3:
            return  # A mismatch, which the loader names.
        if faces.is_floating_point() or not len(faces) or faces.min() < 0 or faces.max() >= len(vertices):
            raise TwofoldError("The canonical surface in the checkpoint is damaged; train again.")
        self.surface_vertices = torch.zeros_like(vertices, device=self.device)
        self.surface_faces = torch.zeros_like(faces, device=self.device)

    def before_step(self, mode: Mode) -> None:
        """Lets the shells follow the poses, and the canonical surface the field, from time to time."""
        super().before_step(mode)
        every = self.config.separation.surface_every
        if self.config.separation.needs_surface and mode.starts_epoch and mode.epoch and mode.epoch % every == 0:
            self._refresh_surface()

    def _refresh_surface(self) -> None:
        points, pose = self.canonical_points, self._no_pose()
        edge = 1.1 * float((points.amax(0) - points.amin(0)).max())
        try:
            vertices, faces = extract_surface(
                lambda x: self.field.sdf(x, pose), points, edge / self.config.separation.surface_cells, _SURFACE_REACH
            )
        except TwofoldError:
            return  # There is none; the one before stays.
        self.surface_vertices, self.surface_faces = vertices, faces

    def _no_pose(self) -> Tensor:
        return torch.zeros(72 if self.config.pose.with_root else 69, device=self.device)

    # ---- rendering

    def render(
        self, rays: Rays, posed: Posed, background: Float[Tensor, "*r 3"] | None, mode: Mode = EVALUATION,
        generator: torch.Generator | None = None,
    ) -> Rendering:  # fmt: skip
        """See `Avatar.render`: C = sum_i w_i c_i + (1 - sum_i w_i) C_background.

        With a scene, rays run from the camera to the sphere around the scene, and no background asks for that scene's.
        In training, `extras["clearance"]` is each ray's smallest signed distance to the canonical surface, metres.
        """
        if self.scene is not None:
            origins = self._from_middle(rays, posed)
            far = sphere_exit(origins, rays.directions) / self.subject.scene_scale
            rays = Rays(rays.origins, rays.directions, torch.zeros_like(rays.near), far.clamp_min(_MIN_FAR))
            background = self.scene_color(rays, posed, generator) if background is None else background
        behind = torch.zeros(3, device=self.device) if background is None else background
        placed = self.place(rays, posed, mode, generator)
        rendering = self.shade(placed, posed, behind, len(rays))
        if not mode.training or not self.config.separation.needs_surface:
            return rendering
        return dataclasses.replace(rendering, extras={"clearance": self._clearance(rays, posed, placed)})

    def scene_color(self, rays: Rays, posed: Posed, generator: torch.Generator | None = None) -> Float[Tensor, "R 3"]:
        """The colour of the scene behind the sphere, 0..1: samples even in inverse distance, the last one open.

        Args:
            rays: from within the sphere; their bounds do not matter.
            posed: its frame chooses the code; a pose that is no training frame takes the mean of all codes.
            generator: moves samples within their strata.
        """
        if self.scene is None:
            raise ValueError("this avatar has no scene; scene_color needs a configuration with one")
        count, many = self.config.scene_samples, len(rays)
        inverse = inverse_distances(many, count, RADIUS, generator, self.device).to(rays.origins.dtype)
        points = inverted_sphere_points(self._from_middle(rays, posed), rays.directions, inverse)
        code = self.codes.mean(0) if posed.own.row is None else self.codes[posed.own.row]
        answer = self.scene(points.flatten(0, 1), rays.directions.repeat_interleave(count, 0), code)
        ray_index = torch.arange(many, device=self.device).repeat_interleave(count)
        samples = Samples(ray_index, inverse.flatten(), inverse_intervals(inverse).flatten())
        weights = open_density_weights(answer.density, samples.delta, ray_index)
        return composite(weights, answer.color, samples, many)

    def _from_middle(self, rays: Rays, posed: Posed) -> Tensor:
        """Origins of rays in scene units from the middle of the sphere."""
        middle = self.middle
        if self.config.center == "body":
            row = posed.own.row
            vertices = posed.body.vertices.detach()
            middle = _box_middle(vertices) if row is None else self._middle(row).to(self.device)
        return (rays.origins - middle) * self.subject.scene_scale

    def _middle(self, row: int) -> Tensor:
        """Middle of the sphere at a training frame, by its pose as given."""
        if self.config.center == "world":
            return self.middle.cpu()
        if row not in self._middles:
            subject, shaped = self.subject, self._shape(None)
            pose, translation = (t[row].to(self.device) for t in (subject.poses, subject.translations))
            self._middles[row] = _box_middle(pose_body(shaped, pose, translation).vertices).cpu()
        return self._middles[row]

    @torch.no_grad()
    def _clearance(self, rays: Rays, posed: Posed, placed: Placement) -> Float[Tensor, "R"]:
        """Smallest signed distance of each ray's samples to the canonical surface; infinite without samples.

        A shell's samples count before those are left out that cannot be seen.
        """
        if isinstance(self._sampler, ShellPlacer):
            placed = self._sampler.candidates(rays, posed.own.surface, None)
        smallest = torch.full((len(rays),), torch.inf, device=self.device)
        if len(placed.samples) == 0:
            return smallest
        distance = signed_distance(placed.x_canonical, self.surface_vertices, self.surface_faces)
        return smallest.scatter_reduce(0, placed.samples.ray_index, distance, "amin")

    def losses(
        self, rendering: Rendering, batch: Batch, posed: Posed, mode: Mode, generator: torch.Generator
    ) -> dict[str, Float[Tensor, ""]]:
        """See `Avatar.losses`: colours, eikonal term and mask, and the terms of `SeparationConfig`."""
        terms = super().losses(rendering, batch, posed, mode, generator)
        config, opacity = self.config.separation, rendering.opacity
        if config.binarisation:
            # Rounding may leave an opacity just above one, where the entropy has no logarithm.
            terms["binarisation"] = config.binarisation * losses.binarisation(opacity.clamp(0, 1))
        clearance = rendering.extras.get("clearance")
        if clearance is not None:
            sparse, in_shape = losses.sparseness_weights(int(config.pace * mode.epoch))
            terms["sparseness"] = config.sparseness * sparse * losses.opacity_sparseness(opacity, clearance)
            terms["in_shape"] = config.in_shape * in_shape * losses.in_shape(opacity, clearance)
        return terms


def _box_middle(vertices: Tensor) -> Tensor:
    return (vertices.amin(0) + vertices.amax(0)) / 2


_SCENE_SEED = 1_000_003
"""Added to the seed for the scene's weights, so that they are not the person's."""
_SURFACE_REACH = 0.2
"""How far from the body the canonical surface is looked for, metres."""
_MIN_FAR = 1e-3
"""Rays of cameras outside of the sphere that miss it end here, metres."""
