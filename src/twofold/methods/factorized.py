"""The paper's method: an avatar whose field has a pose-independent and a pose-dependent branch."""

import dataclasses
import math
from contextlib import AbstractContextManager
from dataclasses import dataclass, replace
from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional as F

from twofold.body.skeleton import PosedBody, ShapedBody, pose_body, shape_body
from twofold.config import require, require_within
from twofold.deform.pose_refinement import PoseRefinement
from twofold.deform.skinning import (
    normal_matrices,
    to_canonical,
    vertex_transforms,
    weights_by,
)
from twofold.field.factorized import FactorizedField, FactorizedFieldConfig
from twofold.field.factorized_grid import GridField, GridFieldConfig
from twofold.field.output import FieldOutput
from twofold.geometry.cameras import Rays, without_tiny_components
from twofold.geometry.surfaces import nearest_vertices
from twofold.kernels.runtime import compiled_methods
from twofold.losses import MOST_STEPS, LossConfig
from twofold.methods.base import Avatar, Batch, MethodConfig, PosedAvatar, Rendering, Subject
from twofold.methods.loss_terms import loss_terms
from twofold.methods.placing import (
    Distance,
    Placed,
    ShellSampler,
    joint_box,
    place_error_bounded,
    place_in_shell,
    that_count,
)
from twofold.methods.pose_schedule import PoseConfig, condition
from twofold.metrics.perceptual import LPIPS
from twofold.sampling.error_bounded import ErrorBoundedSampler
from twofold.sampling.sdf_grid import DistanceTable, tabulate
from twofold.sampling.shell import Shell, build_shell
from twofold.volume.rendering import composite, composite_weights, laplace_density
from twofold.volume.samples import Samples


@dataclass(frozen=True)
class FactorizedConfig(MethodConfig):
    """The factorized avatar; the defaults are the authors' release."""

    field: FactorizedFieldConfig | GridFieldConfig = dataclasses.field(default_factory=FactorizedFieldConfig)
    sampler: ErrorBoundedSampler | ShellSampler = dataclasses.field(default_factory=ShellSampler)
    losses: LossConfig = dataclasses.field(default_factory=LossConfig)
    pose: PoseConfig = dataclasses.field(default_factory=PoseConfig)
    neighbours: int = 1
    """How many nearest vertices give a point its skinning weights."""
    late_neighbours: int | None = None
    """The same in training from epoch `late_from` on; 7 in the release, whose validation changes it."""
    late_from: int = 100
    """Epochs before that; every so many epochs the canonical body that turns normals follows the corrected shape."""
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
            self,
            neighbours=(1, 64),
            late_neighbours=(1, 64),
            late_from=(1, MOST_STEPS),
            shell_refresh=(1, MOST_STEPS),
            outlier_distance=(0.001, 10),
            beta=(0, 10),
        )
        require(0 < self.beta_floor < self.beta, f"beta_floor should lie between 0 and beta={self.beta}")
        if isinstance(self.field, GridFieldConfig) and isinstance(self.sampler, ShellSampler):
            within = self.sampler.radius <= self.field.radius
            require(within, f"sampler.radius should be at most field.radius={self.field.radius}, where features end")

    def build(self, subject: Subject, seed: int = 0) -> "FactorizedAvatar":
        """An untrained avatar of a subject."""
        return FactorizedAvatar(self, subject, seed)


class FactorizedAvatar(Avatar):
    """See `FactorizedConfig`."""

    shell_poses: Tensor
    shell_translations: Tensor
    shell_shape: Tensor
    canonical_points: Tensor
    late_shape: Tensor
    rest_joints: Tensor

    def __init__(self, config: FactorizedConfig, subject: Subject, seed: int) -> None:
        """Builds the field around the subject's canonical body."""
        super().__init__()
        self.config, self.subject = config, subject
        generator = torch.Generator().manual_seed(seed)
        self.refinement = PoseRefinement(subject.times, len(subject.betas), tuple(config.pose.refine))
        given = shape_body(subject.body, subject.betas)
        canonical = pose_body(given, subject.poses[0], subject.translations[0])
        self.register_buffer("rest_joints", given.joints.clone(), persistent=False)
        pose_size = 72 if config.pose.with_root else 69
        if isinstance(config.field, GridFieldConfig):
            self.field = config.field.build(canonical, pose_size, generator)
        else:
            self.field = config.field.build(pose_size, generator)
        start = config.beta - config.beta_floor
        # Softplus with this sharpness is nearly linear at the start, yet never reaches zero.
        raw = start if config.beta_form == "absolute" else math.log(math.expm1(start / _BETA_UNIT)) * _BETA_UNIT
        self.raw_beta = nn.Parameter(torch.tensor(float(raw)))
        self.scale = subject.scene_scale if config.scene_scale == "released" else 1.0
        # Shells are made of poses and shape as they were at the last refresh; kept so that a resumed run repeats them.
        self.register_buffer("shell_poses", subject.poses.clone())
        self.register_buffer("shell_translations", subject.translations.clone())
        self.register_buffer("shell_shape", torch.zeros_like(subject.betas))
        self.register_buffer("canonical_points", canonical.canonical_vertices.clone(), persistent=False)
        if config.late_neighbours is not None:
            self.register_buffer("late_shape", torch.zeros_like(subject.betas))
        self.epoch_steps: int | float = len(subject.times)
        self.box_given = isinstance(config.sampler, ErrorBoundedSampler) and config.sampler.box == "given"
        self._shells: dict[int, Shell] = {}
        self._bodies = {torch.device("cpu"): subject.body}
        self._perceptual: tuple[LPIPS, ...] = ()
        self._home: Shell | None = None
        self._last_table: tuple[PosedAvatar, tuple[int, ...], DistanceTable] | None = None

    def attach_lpips(self, network: LPIPS | None) -> None:
        """Gives it the network behind the perceptual term, which is neither trained, nor stored, nor moved with it."""
        self._perceptual = (network.to(self.device),) if network else ()

    @property
    def device(self) -> torch.device:
        """Where its parameters are."""
        return self.raw_beta.device

    @property
    def beta(self) -> Float[Tensor, ""]:
        """Scale of the density, metres."""
        if self.config.beta_form == "absolute":
            return self.raw_beta.abs() + self.config.beta_floor
        return F.softplus(self.raw_beta / _BETA_UNIT) * _BETA_UNIT + self.config.beta_floor

    def compiled(self) -> AbstractContextManager[bool]:
        """See `Avatar.compiled`. Feature grids have compiled loops of their own."""
        dense = ("forward", "sdf", "distance_and_gradient") if isinstance(self.field, FactorizedField) else ()
        return compiled_methods(self.field, dense)

    def parameter_groups(self) -> dict[str, list[nn.Parameter]]:
        """The field's groups, "beta" and "pose"."""
        pose = [p for p in self.refinement.parameters() if p.requires_grad]
        return {**self.field.parameter_groups(), "beta": [self.raw_beta], "pose": pose}

    def count_epochs(self, steps: int | float) -> None:
        """See `Avatar.count_epochs`."""
        if self.config.pose.epochs == "training":
            self.epoch_steps = steps

    def before_step(self, step: int) -> None:
        """Lets the shells, and the canonical body that turns normals, follow the corrections from time to time."""
        passed = [self._epoch(at) // self.config.late_from for at in (max(step - 1, 0), step)]
        if self.config.late_neighbours is not None and passed[1] > passed[0]:
            self.late_shape.copy_(self.refinement.shape.detach())
        refresh = self.config.shell_refresh
        if not self.refinement.parts or step == 0 or step % refresh or step < self.config.pose.refine_from:
            return
        with torch.no_grad():
            for row, time in enumerate(self.subject.times):
                pose, translation = self.subject.poses[row], self.subject.translations[row]
                pose, translation = self.refinement(int(time), pose.to(self.device), translation.to(self.device))
                self.shell_poses[row], self.shell_translations[row] = pose, translation
            self.shell_shape.copy_(self.refinement.shape)
        self._shells.clear()

    def pose(
        self, pose: Float[Tensor, "24 3"], translation: Float[Tensor, "3"], time: int | None = None,
        step: int | None = None,
    ) -> PosedAvatar:  # fmt: skip
        """See `Avatar.pose`. While training, a moment's shell is reused until the next refresh."""
        data = pose, translation = pose.to(self.device), translation.to(self.device)
        config = self.config
        training = step is not None
        refining = training and step >= config.pose.refine_from
        if time is not None:
            with torch.set_grad_enabled(torch.is_grad_enabled() and refining):
                pose, translation = self.refinement(time, pose, translation)
        with torch.set_grad_enabled(torch.is_grad_enabled() and refining and bool(self.refinement.parts)):
            refined = training or time is not None or config.pose.test_shape == "refined"
            shaped = self._shape(self.refinement.shape if refined else None)
            rest_joints = self.rest_joints if config.pose.canonical_shape == "given" else None
            body = pose_body(shaped, pose, translation, rest_joints)
        box = joint_box(body.joints)
        if self.box_given:
            box = joint_box(pose_body(self._shape(None), *data).joints, self.subject.scene_scale)
        neighbours = config.neighbours
        if step is not None and config.late_neighbours is not None and self._epoch(step) >= config.late_from:
            neighbours = config.late_neighbours
        seen = condition(config.pose, pose, step, self._epoch(step or 0))
        shell, anchors = self._shell(body, time, training), self._anchors(training)
        return PosedAvatar(body, vertex_transforms(body), seen, shell, box, neighbours, anchors)

    def _shape(self, change: Tensor | None) -> ShapedBody:
        """The body, its shape corrected by so much or as it was given."""
        body = self.subject.body
        if self.device not in self._bodies:
            tensors = {n: t.to(self.device) for n, t in vars(body).items() if isinstance(t, Tensor)}
            self._bodies[self.device] = type(body)(name=body.name, **tensors)
        betas = self.subject.betas.to(self.device)
        return shape_body(self._bodies[self.device], betas if change is None else betas + change)

    def _epoch(self, step: int) -> int:
        return int(step // self.epoch_steps)

    def _anchors(self, training: bool) -> Tensor | None:
        """Canonical vertices that turn normals, or None where those do that carried the sample home."""
        if self.config.normals_by == "posed":
            return None
        if not training or self.config.late_neighbours is None or not self.late_shape.any():
            return self.canonical_points
        rest = torch.zeros(24, 3, device=self.device)
        return pose_body(self._shape(self.late_shape), rest, rest[0]).canonical_vertices

    def _carried(self, x_posed: Tensor, nearest: Tensor, shares: Tensor, posed: PosedAvatar) -> tuple[Tensor, Tensor]:
        """Points in canonical space, and what turns their gradients into observation space."""
        x_canonical, turn = to_canonical(x_posed, nearest, shares, posed.forward)
        if posed.anchors is not None:
            away, nearest = nearest_vertices(x_canonical, posed.anchors, posed.neighbours)
            # Canonical space is in metres, in the release too.
            turn = normal_matrices(nearest, weights_by(self.config.falloff, away.square()), posed.forward)
        return x_canonical, turn

    def _shell(self, body: PosedBody, time: int | None, training: bool) -> Shell:
        sampler = self.config.sampler
        radius, voxel = (sampler.radius, sampler.voxel) if isinstance(sampler, ShellSampler) else (0.1, 0.03)
        listed = max(6, 2 * max(self.config.neighbours, self.config.late_neighbours or 1))
        row = self.refinement.rows.get(time) if training and time is not None else None
        if row is None:
            return build_shell(body.vertices, body.faces, radius, voxel, listed)
        if row not in self._shells:
            with torch.no_grad():
                shaped = self._shape(self.shell_shape)
                start = pose_body(shaped, self.shell_poses[row], self.shell_translations[row])
            self._shells[row] = build_shell(start.vertices, body.faces, radius, voxel, listed)
        return self._shells[row]

    def render(
        self, rays: Rays, posed: PosedAvatar, background: Float[Tensor, "3"], generator: torch.Generator | None = None
    ) -> Rendering:
        """See `Avatar.render`."""
        rays = without_tiny_components(rays) if self.box_given else rays
        placed = self._place(rays, posed, generator)
        samples, outlier = placed.samples, placed.outlier
        if len(samples) == 0:
            return self._nothing(len(rays), background)
        x_canonical, to_observation = self._carried(samples.points(rays), placed.nearest, placed.shares, posed)
        answer = self.field(x_canonical, posed.condition, to_observation)
        normals = F.normalize((to_observation * answer.gradient[:, None]).sum(-1), dim=-1, eps=1e-6)
        whole = self._composite(answer, normals, samples, outlier, background, len(rays))
        if answer.base is None:
            return whole
        # The base picture's normals are its own branch's, at the same samples.
        base_normals = F.normalize((to_observation * answer.base.gradient[:, None]).sum(-1), dim=-1, eps=1e-6)
        base = self._composite(answer.base, base_normals, samples, outlier, background, len(rays))
        return Rendering(whole.color, whole.opacity, whole.depth, whole.normal, base)

    def _composite(
        self, answer: FieldOutput, normals: Tensor, samples: Samples, outlier: Tensor, background: Tensor, rays: int
    ) -> Rendering:
        sdf = torch.where(outlier, 4.0, answer.sdf)
        scaled = Samples(samples.ray_index, samples.depth, samples.delta * self.scale)
        weights = composite_weights(laplace_density(sdf, self.beta), scaled)
        ones = torch.ones_like(sdf)[:, None]
        values = torch.cat([answer.color, ones, samples.depth[:, None], normals.detach()], -1)
        out = composite(weights, values, samples, rays)
        opacity = out[:, 3]
        depth = out[:, 4] / opacity.detach().clamp_min(1e-6)
        return Rendering(out[:, :3] + (1 - opacity[:, None]) * background, opacity, depth, out[:, 5:8])

    def _nothing(self, rays: int, background: Tensor) -> Rendering:
        # Tied to a parameter, so that a step whose rays all miss has a gradient, of zero, like any other.
        zero = (0 * self.beta).expand(rays)
        empty = Rendering(background + zero[:, None], zero, zero, zero[:, None].expand(rays, 3))
        two = self.config.field.branches in ("both", "high_rendered")
        return replace(empty, base=empty if two else None)

    def _place(self, rays: Rays, posed: PosedAvatar, generator: torch.Generator | None) -> Placed:
        sampler, k = self.config.sampler, posed.neighbours
        limit = self.config.outlier_distance / self.scale

        def distance(x_canonical: Tensor) -> Tensor:
            return self.field.sdf(x_canonical, posed.condition)

        if isinstance(sampler, ErrorBoundedSampler):
            scale = self.scale if sampler.units == "scene" else 1.0
            placed = place_error_bounded(
                sampler, rays, posed, self._weigh, limit, generator, distance, self.beta, scale
            )
            shading = self.config.outliers_in_shading and generator is None
            return replace(placed, outlier=placed.outlier & shading)
        placed = place_in_shell(sampler, rays, posed, k, self._weigh, min(sampler.radius, limit), generator)
        home = self._canonical_shell(sampler, posed) if sampler.stray > 0 else None
        table = None if self.training or generator is not None else lambda count: self._table(count, posed, distance)
        return that_count(sampler, placed, rays, posed, home, distance, self.beta, table)

    def _weigh(self, squared_distances: Float[Tensor, "S K"]) -> Float[Tensor, "S K"]:
        return weights_by(self.config.falloff, squared_distances, self.scale)

    def _canonical_shell(self, sampler: ShellSampler, posed: PosedAvatar) -> Shell:
        if self._home is None or self._home.vertices.device != self.device:
            self._home = build_shell(self.canonical_points, posed.body.faces, sampler.radius, sampler.voxel)
        return self._home

    def _table(self, samples: int, posed: PosedAvatar, distance: Distance) -> DistanceTable | None:
        """The distance table of this pose, made as soon as it pays; the last one is kept."""
        sampler = self.config.sampler
        if not isinstance(sampler, ShellSampler) or sampler.table_voxel == 0 or isinstance(self.field, GridField):
            return None
        state = tuple(parameter._version for parameter in self.field.parameters())
        last = self._last_table
        if last is not None and last[0] is posed and last[1] == state:
            return last[2]
        if samples < _TABLE_PAYS * (0.015 / sampler.table_voxel) ** 3:
            return None
        table = tabulate(distance, self.canonical_points, sampler.table_voxel, sampler.radius)
        self._last_table = (posed, state, table)
        return table

    def losses(
        self, rendering: Rendering, batch: Batch, posed: PosedAvatar, step: int, generator: torch.Generator
    ) -> dict[str, Float[Tensor, ""]]:
        """See `Avatar.losses`."""

        def gradients(x_canonical: Tensor) -> Tensor:
            return self.field.distance_and_gradient(x_canonical, posed.condition)[1]

        network = self._perceptual[0] if self._perceptual else None
        vertices = self.canonical_points
        return loss_terms(self.config.losses, rendering, batch, vertices, gradients, network, step, generator)

    def level(self, x_canonical: Float[Tensor, "S 3"], posed: PosedAvatar, branch: str = "full") -> Float[Tensor, "S"]:
        """See `Avatar.level`."""
        if branch == "full":
            return self.field.sdf(x_canonical, posed.condition)
        return self.query(x_canonical, posed, branch=branch).sdf

    @property
    def reach(self) -> float:
        """See `Avatar.reach`."""
        sampler, limit = self.config.sampler, self.config.outlier_distance / self.scale
        return min(sampler.radius, limit) if isinstance(sampler, ShellSampler) else limit

    @property
    def separates_light(self) -> bool:
        """See `Avatar.separates_light`."""
        return isinstance(self.field, GridField)

    def query(
        self, x_canonical: Float[Tensor, "S 3"], posed: PosedAvatar,
        to_observation: Float[Tensor, "S 3 3"] | None = None, branch: str = "full", lit: bool = True,
    ) -> FieldOutput:  # fmt: skip
        """See `Avatar.query`."""
        require(branch in ("full", "base"), f'branch is "full" or "base"; it is {branch!r}')
        plain = self.field.unlit if isinstance(self.field, GridField) and not lit else None
        x, pose = x_canonical, posed.condition
        answer = plain(x, pose) if plain else self.field(x, pose, to_observation)
        return answer if branch == "full" else answer.base or answer

    def to_canonical(
        self, x_posed: Float[Tensor, "S 3"], posed: PosedAvatar
    ) -> tuple[Float[Tensor, "S 3"], Float[Tensor, "S 3 3"]]:
        """See `Avatar.to_canonical`; the nearest vertices are exact, `render` takes them from the shell's lists."""
        distances, nearest = nearest_vertices(x_posed, posed.body.vertices, posed.neighbours)
        return self._carried(x_posed, nearest, self._weigh(distances.square()), posed)


_TABLE_PAYS = 150_000
"""Samples from which on a distance table at 15 mm, of some eighty thousand nodes, is the quicker way."""
_BETA_UNIT = 0.01
"""Metres; below about this the softplus bends, so the scale can shrink smoothly to millimetres."""
