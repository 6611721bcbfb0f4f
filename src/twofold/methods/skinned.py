"""What methods share whose field lies in canonical space and is moved by the skinning of the body.

Poses and their refinement, samples and their way to canonical space, density and compositing, the common losses.
"""

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Generic, Literal, TypeVar

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn
from torch.nn import functional as F

from twofold.body.skeleton import PosedBody, ShapedBody, movements, pose_body, shape_body
from twofold.capture.coverage import coverage_of, mean_facing
from twofold.capture.types import Capture
from twofold.config import require
from twofold.deform.pose_refinement import PoseRefinement
from twofold.deform.skinning import normal_matrices, to_canonical, vertex_transforms, weights_by
from twofold.field.output import FieldOutput
from twofold.geometry.cameras import Rays
from twofold.geometry.surfaces import nearest_vertices
from twofold.methods.base import EVALUATION, Avatar, Batch, Mode, PosedAvatar, Rendering
from twofold.methods.completion import Completion
from twofold.methods.loss_terms import loss_terms
from twofold.methods.parameter_group import ParameterGroup
from twofold.methods.pose_schedule import condition
from twofold.methods.skinned_config import CanonicalField, SkinnedConfig, SkinnedPose
from twofold.methods.subject import Subject, observed_corrections
from twofold.metrics.perceptual import LPIPS
from twofold.sampling.placement import Deformation, FieldQuery, Placement, Sampler
from twofold.sampling.posed_surface import PosedSurface
from twofold.sampling.shell import Shell
from twofold.volume.rendering import composite_surface
from twofold.volume.samples import Samples

Posed = PosedAvatar[SkinnedPose]
OwnConfig = TypeVar("OwnConfig", bound=SkinnedConfig)
OwnField = TypeVar("OwnField", bound=CanonicalField)


class SkinnedAvatar(Avatar[SkinnedPose], Generic[OwnConfig, OwnField]):
    """See `SkinnedConfig`. A method adds its field and its groups of parameters."""

    shell_poses: Tensor
    shell_translations: Tensor
    shell_shape: Tensor
    canonical_points: Tensor
    late_shape: Tensor
    rest_joints: Tensor
    config: OwnConfig
    field: OwnField

    def __init__(
        self, config: OwnConfig, subject: Subject, seed: int,
        build_field: Callable[[PosedBody, int, torch.Generator], OwnField],
    ) -> None:  # fmt: skip
        """Builds the field: around a canonical body, conditioned on this many numbers, drawn from a generator."""
        super().__init__()
        self.config, self.subject = config, subject
        self.refinement = PoseRefinement(subject.times, len(subject.betas), tuple(config.pose.refine))
        given = shape_body(subject.body, subject.betas)
        canonical = subject.canonical_body()
        self.register_buffer("rest_joints", given.joints.clone(), persistent=False)
        self.field = build_field(canonical, 72 if config.pose.with_root else 69, torch.Generator().manual_seed(seed))
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
        self._steps = 0
        self._observed: Tensor | None = None
        self._shells: dict[int, Shell] = {}
        self._bodies = {torch.device("cpu"): subject.body}
        self._perceptual: tuple[LPIPS, ...] = ()
        self.deformation = Deformation(config.falloff, config.outlier_distance / self.scale, self.scale)
        self._sampler: Sampler = config.sampler.build(self.deformation, canonical.canonical_vertices, canonical.faces)
        self.training_grid = self._sampler.training_grid
        self.completion: Completion | None = None
        if config.completion.active:
            self.completion = Completion(config.completion, given, canonical.canonical_vertices)

    def groups_with(self, own: dict[str, list[nn.Parameter]], rates: object) -> list[ParameterGroup]:
        """A method's own groups, then "beta" and "pose", each with the rate that `rates` has under its name."""
        pose = [p for p in self.refinement.parameters() if p.requires_grad]
        groups = own | {"beta": [self.raw_beta], "pose": pose}
        return [self.config.pose.group(name, getattr(rates, name), group) for name, group in groups.items()]

    @property
    def _two_branches(self) -> bool:
        """Whether a base branch is rendered, too."""
        return False

    def prepare_training(self, capture: Capture, stage: int, generator: torch.Generator) -> None:
        """See `Avatar.prepare_training`: how well the surface was observed, where it is to be completed."""
        if self.completion is not None:
            self.completion.prepare(coverage_of(capture), mean_facing(capture))

    def load_stored(self, state: dict[str, Tensor]) -> None:
        """See `Avatar.load_stored`."""
        if self.training_grid is not None:
            self.training_grid.take_on(state, "training_grid.")
        if self.completion is not None:
            self.completion.take_on(state, "completion.")

    def answer_beside(self, x_canonical: Float[Tensor, "S 3"], vertex: Int[Tensor, "S"], posed: Posed) -> FieldOutput:
        """What completion takes its targets from and pulls to them, at canonical points beside these vertices."""
        turn = normal_matrices(vertex[:, None], torch.ones_like(x_canonical[:, :1]), posed.own.surface.forward)
        return self.field(x_canonical, posed.own.condition, turn)

    def light_beside(self, vertex: Int[Tensor, "S"], posed: Posed) -> Float[Tensor, "S 3"]:
        """The light that the colours of `answer_beside` lack."""
        return torch.ones(len(vertex), 3, device=vertex.device)

    @property
    def wants_perceptual(self) -> bool:
        """See `Avatar.wants_perceptual`."""
        return self.config.losses.lpips > 0

    def attach_perceptual(self, network: LPIPS | None) -> None:
        """See `Avatar.attach_perceptual`; it is not moved with the avatar either."""
        self._perceptual = (network.to(self.device),) if network else ()

    @property
    def ray_margin(self) -> float:
        """See `Avatar.ray_margin`."""
        return self.config.sampler.reach + 0.02

    @property
    def reach(self) -> float:
        """See `Avatar.reach`: as far as samples are placed and count."""
        return min(self.config.sampler.reach, self.deformation.outlier_distance)

    def scalars(self) -> dict[str, float]:
        """See `Avatar.scalars`: the scale of the density."""
        return {"beta": float(self.beta.detach())}

    @property
    def beta(self) -> Float[Tensor, ""]:
        """Scale of the density, metres."""
        if self.config.beta_form == "absolute":
            return self.raw_beta.abs() + self.config.beta_floor
        return F.softplus(self.raw_beta / _BETA_UNIT) * _BETA_UNIT + self.config.beta_floor

    def before_step(self, mode: Mode) -> None:
        """Lets the shells, and the canonical body that turns normals, follow the corrections from time to time."""
        # Fused Adam changes parameters without counting versions.
        self._steps += 1
        epoch, first = self._epoch(mode)
        if self.config.late_neighbours is not None and first and epoch and epoch % self.config.late_from == 0:
            self.late_shape.copy_(self.refinement.shape.detach())
        refresh, step = self.config.shell_refresh, mode.step or 0
        if self.refinement.parts and step and step % refresh == 0 and step >= self.config.pose.refine_from:
            with torch.no_grad():
                self._follow(*self._all_refined())
        if (grid := self.training_grid) is not None and grid.is_due(step):
            pose = self._refined(step // grid.every % len(self.subject.times))[0].detach()
            grid.refresh(self.field.sdf_at(condition(self.config.pose, pose, step, epoch)))
        if (own := self.completion) is not None and own.is_due(step):
            # In the first frame's pose, whatever this step shows: so any number of processes find the same.
            subject = self.subject
            posed = self.pose(subject.poses[0], subject.translations[0], int(subject.times[0]), mode)
            own.refresh(lambda x, v: self.answer_beside(x, v, posed), self.light_beside(own.beside, posed))

    def _all_refined(self) -> tuple[Tensor, Tensor]:
        """Poses and translations of all training frames with their corrections."""
        found = [self._refined(row) for row in range(len(self.subject.times))]
        return torch.stack([pose for pose, _ in found]), torch.stack([translation for _, translation in found])

    def _refined(self, row: int) -> tuple[Tensor, Tensor]:
        """Pose and translation of a training frame with their corrections."""
        own, device = self.subject, self.device
        return self.refinement(int(own.times[row]), own.poses[row].to(device), own.translations[row].to(device))

    def _follow(self, poses: Tensor, translations: Tensor) -> None:
        """Gives up the shells of bodies that have moved by more than `SHELL_MARGIN`, half of it left to the shape."""
        allowed = SHELL_MARGIN / 2
        old, new = self._shape(self.shell_shape), self._shape(self.refinement.shape)
        if float((old.vertices - new.vertices).norm(dim=-1).max()) > allowed:
            moved = torch.ones(len(poses), dtype=torch.bool)
            self.shell_shape.copy_(self.refinement.shape)
        else:
            moved = movements(old, (self.shell_poses, self.shell_translations), (poses, translations)) > allowed
        for row in moved.nonzero()[:, 0].tolist():
            self.shell_poses[row], self.shell_translations[row] = poses[row], translations[row]
            self._shells.pop(row, None)

    def after_step(self, mode: Mode, capture: Capture) -> Literal["continue", "restart"]:
        """Takes out of the corrections what no training camera sees, where that is asked for."""
        pose = self.config.pose
        if pose.observed_only and self.refinement.parts and (mode.step or 0) >= pose.refine_from:
            if self._observed is None:
                self._observed = observed_corrections(self.subject, capture, pose.refine).to(self.device)
            self.refinement.project(self._observed)
        return "continue"

    def pose(
        self, pose: Float[Tensor, "24 3"], translation: Float[Tensor, "3"], frame_index: int | None = None,
        mode: Mode = EVALUATION,
    ) -> Posed:  # fmt: skip
        """See `Avatar.pose`. While training, a frame's shell is reused until the next refresh."""
        pose, translation = pose.to(self.device), translation.to(self.device)
        config, data = self.config, (pose, translation)
        refining = mode.step is not None and mode.step >= config.pose.refine_from
        if frame_index is not None:
            with torch.set_grad_enabled(torch.is_grad_enabled() and refining):
                pose, translation = self.refinement(frame_index, pose, translation)
        with torch.set_grad_enabled(torch.is_grad_enabled() and refining and bool(self.refinement.parts)):
            refined = mode.training or frame_index is not None or config.pose.test_shape == "refined"
            shaped = self._shape(self.refinement.shape if refined else None)
            rest_joints = self.rest_joints if config.pose.canonical_shape == "given" else None
            body = pose_body(shaped, pose, translation, rest_joints)
            forward = vertex_transforms(body)

        def given() -> Tensor:
            return pose_body(self._shape(None), *data).joints

        box = config.sampler.ray_box(body.joints, given, self.subject.scene_scale)
        epoch, _ = self._epoch(mode)
        late = mode.training and config.late_neighbours is not None and epoch >= config.late_from
        neighbours = (config.late_neighbours if late else None) or config.neighbours
        seen = condition(config.pose, pose, mode.step, epoch)
        surface = PosedSurface(body, forward, self._shell(body, frame_index, mode), box, neighbours)
        row = None if frame_index is None else self.refinement.rows.get(frame_index)
        return PosedAvatar(body, SkinnedPose(surface, seen, self._anchors(mode), row))

    def _shape(self, change: Tensor | None) -> ShapedBody:
        """The body, its shape corrected by so much or as it was given."""
        body = self.subject.body
        if self.device not in self._bodies:
            tensors = {n: t.to(self.device) for n, t in vars(body).items() if isinstance(t, Tensor)}
            self._bodies[self.device] = type(body)(name=body.name, **tensors)
        betas = self.subject.betas.to(self.device)
        return shape_body(self._bodies[self.device], betas if change is None else betas + change)

    def _epoch(self, mode: Mode) -> tuple[int, bool]:
        """The epoch of a training step, and whether it begins there, as `PoseConfig.epochs` counts them."""
        if self.config.pose.epochs == "training":
            return mode.epoch, mode.starts_epoch
        epoch, within = divmod(mode.step or 0, len(self.subject.times))
        return epoch, within == 0

    def _anchors(self, mode: Mode) -> Tensor | None:
        """Canonical vertices that turn normals, or None where those do that mapped the sample."""
        if self.config.normals_by == "posed":
            return None
        if not mode.training or self.config.late_neighbours is None or not self.late_shape.any():
            return self.canonical_points
        rest = torch.zeros(24, 3, device=self.device)
        return pose_body(self._shape(self.late_shape), rest, rest[0]).canonical_vertices

    def _normal_matrices(self, x_canonical: Tensor, by_posed: Tensor, posed: Posed) -> Tensor:
        """What turns canonical gradients into observation space: that of the mapping, or of the nearest anchors."""
        own = posed.own
        if own.anchors is None:
            return by_posed
        away, nearest = nearest_vertices(x_canonical, own.anchors, own.surface.neighbours)
        # Canonical space is in metres, in the release too.
        return normal_matrices(nearest, weights_by(self.config.falloff, away.square()), own.surface.forward)

    def _shell(self, body: PosedBody, frame_index: int | None, mode: Mode) -> Callable[[], Shell]:
        sampler, neighbours = self.config.sampler, max(self.config.neighbours, self.config.late_neighbours or 1)
        row = self.refinement.rows.get(frame_index) if mode.training and frame_index is not None else None
        if row is None:
            # Surfaces are taken from a pose without looking into its shell, which takes longer than all the rest.
            return lambda: sampler.shell(body.vertices, neighbours)
        if row not in self._shells:
            with torch.no_grad():
                shaped = self._shape(self.shell_shape)
                start = pose_body(shaped, self.shell_poses[row], self.shell_translations[row])
            if len(self._shells) >= SHELLS_KEPT:
                self._shells.pop(next(iter(self._shells)))
            self._shells[row] = sampler.shell(start.vertices, neighbours)
        shell = self._shells[row]
        return lambda: shell

    def render(
        self, rays: Rays, posed: Posed, background: Float[Tensor, "*r 3"] | None, mode: Mode = EVALUATION,
        generator: torch.Generator | None = None,
    ) -> Rendering:  # fmt: skip
        """See `Avatar.render`."""
        behind = torch.zeros(3, device=self.device) if background is None else background
        return self.shade(self.place(rays, posed, mode, generator), posed, behind, len(rays))

    def shade(self, placed: Placement, posed: Posed, behind: Float[Tensor, "*r 3"], rays: int) -> Rendering:
        """The colours of `rays` rays from their samples, before the background `behind`."""
        if len(placed.samples) == 0:
            return self._nothing(rays, behind)
        samples, outlier = placed.samples, placed.outlier
        x_canonical, by_posed = placed.differentiable(posed.own.surface)
        to_observation = self._normal_matrices(x_canonical, by_posed, posed)
        answer = self.field(x_canonical, posed.own.condition, to_observation)
        turn = to_observation.detach()  # Normals are shown, and nothing learns from them.
        whole = self._composite(answer, turn, samples, outlier, behind, rays)
        if answer.base is None:
            return whole
        # The base rendering's normals are its own branch's, at the same samples.
        return replace(whole, base=self._composite(answer.base, turn, samples, outlier, behind, rays))

    def place(self, rays: Rays, posed: Posed, mode: Mode, generator: torch.Generator | None) -> Placement:
        """The samples that `render` shades."""
        version = (self._steps, *(parameter._version for parameter in self.field.parameters()))
        recent_grid = self.training_grid.grid() if mode.training and self.training_grid is not None else None
        costly = self.field.dense and not mode.training
        with torch.no_grad():
            distance = self.field.sdf_at(posed.own.condition)
        query = FieldQuery(distance, self.beta, version, costly, recent_grid)
        placed = self._sampler.place(rays, posed.own.surface, query, mode.training, generator)
        shading = self.config.outliers_in_shading and not mode.training
        return placed if shading else replace(placed, outlier=torch.zeros_like(placed.outlier))

    def _composite(
        self, answer: FieldOutput, turn: Tensor, samples: Samples, outlier: Tensor, background: Tensor, rays: int
    ) -> Rendering:
        with torch.no_grad():
            normals = answer.normals(turn)
        sdf = torch.where(outlier, 4.0, answer.sdf)
        scaled = replace(samples, delta=samples.delta * self.scale)
        out = composite_surface(sdf, self.beta, answer.color, normals, scaled, rays)
        opacity = out[:, 3]
        depth = out[:, 4] / opacity.detach().clamp_min(1e-6)
        return Rendering(out[:, :3] + (1 - opacity[:, None]) * background, opacity, depth, out[:, 5:8])

    def _nothing(self, rays: int, background: Tensor) -> Rendering:
        # Tied to a parameter, so that a step whose rays all miss has a gradient, of zero, like any other.
        zero = (0 * self.beta).expand(rays)
        empty = Rendering(background + zero[:, None], zero, zero, zero[:, None].expand(rays, 3))
        return replace(empty, base=empty if self._two_branches else None)

    def losses(
        self, rendering: Rendering, batch: Batch, posed: Posed, mode: Mode, generator: torch.Generator
    ) -> dict[str, Float[Tensor, ""]]:
        """See `Avatar.losses`."""

        def gradients(x_canonical: Tensor) -> Tensor:
            return self.field.distance_and_gradient(x_canonical, posed.own.condition)[1]

        network = self._perceptual[0] if self._perceptual else None
        config, vertices, step = self.config.losses, self.canonical_points, mode.step or 0
        terms = loss_terms(config, rendering, batch, vertices, gradients, network, step, generator)
        if self.completion is not None:
            terms |= self.completion.terms(lambda x, v: self.answer_beside(x, v, posed), step, generator)
        return terms

    def level(self, x: Float[Tensor, "S 3"], posed: Posed, branch: str = "full") -> Float[Tensor, "S"]:
        """See `Avatar.level`."""
        require(branch in ("full", "base"), f'branch is "full" or "base"; it is {branch!r}')
        if branch == "full":
            return self.field.sdf(x, posed.own.condition)
        return self.query(x, posed, branch=branch).sdf

    def refined_pose(
        self, frame_index: int, pose: Float[Tensor, "24 3"], translation: Float[Tensor, "3"], max_gap: float,
        clock: Callable[[int], float] = float,
    ) -> tuple[Float[Tensor, "24 3"], Float[Tensor, "3"]]:  # fmt: skip
        """See `Avatar.refined_pose`."""
        with torch.no_grad():
            given = pose.to(self.device), translation.to(self.device)
            return self.refinement.at(frame_index, *given, self.subject, max_gap, clock)

    def pose_corrections(self) -> dict[str, float]:
        """See `Avatar.pose_corrections`."""
        return self.refinement.change() if self.refinement.parts else {}

    def query(
        self, x_canonical: Float[Tensor, "S 3"], posed: Posed,
        to_observation: Float[Tensor, "S 3 3"] | None = None, branch: str = "full", lit: bool = True,
    ) -> FieldOutput:  # fmt: skip
        """See `Avatar.query`."""
        require(branch in ("full", "base"), f'branch is "full" or "base"; it is {branch!r}')
        answer = self.field(x_canonical, posed.own.condition, to_observation)
        return answer if branch == "full" else answer.base or answer

    def to_canonical(
        self, x_posed: Float[Tensor, "S 3"], posed: Posed
    ) -> tuple[Float[Tensor, "S 3"], Float[Tensor, "S 3 3"]]:
        """See `Avatar.to_canonical`; the nearest vertices are exact, `render` takes them from the shell's lists."""
        surface = posed.own.surface
        distances, nearest = nearest_vertices(x_posed, posed.body.vertices, surface.neighbours)
        weights = self.deformation.weigh(distances.square())
        x_canonical, by_posed = to_canonical(x_posed, nearest, weights, surface.forward)
        return x_canonical, self._normal_matrices(x_canonical, by_posed, posed)


SHELL_MARGIN = 0.005
"""How far a body may move before its shell is built anew, metres: a quarter of a voxel. Until then samples are measured
against the moved body; only at the shell's rim, centimetres from the body, some are missed."""
SHELLS_KEPT = 512
"""Shells of training frames that are kept, of two or three megabytes each; the one made first is dropped."""
_BETA_UNIT = 0.01
"""Metres; below about this the softplus bends, so the scale can shrink smoothly to millimetres."""
