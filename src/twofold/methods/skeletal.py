"""What HumanNeRF and MonoHuman share: skinning by a learned volume, rays, compositing, losses, the guard."""

import math
from abc import abstractmethod
from dataclasses import replace
from typing import Literal

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from twofold.body.skeleton import joint_transforms_of_rotations, pose_body, shape_body, skin
from twofold.capture.types import Capture, Frame, spread
from twofold.config import require
from twofold.deform.pose_correction import PoseCorrection, body_pose_condition
from twofold.deform.weight_volume import (
    SkeletalPoints,
    WeightVolume,
    bone_prior,
    canonical_box,
    skeletal_backward,
)
from twofold.field.encoding import open_hann_bands
from twofold.field.nerf import NON_RIGID_OCTAVES
from twofold.field.networks import bf16_is_fast
from twofold.field.output import RadianceOutput
from twofold.geometry.cameras import Rays, clip_to_box, pixel_grid, pixel_rays, without_tiny_components
from twofold.geometry.rotations import axis_angle_to_matrix, matrix_to_axis_angle, rigid_inverse
from twofold.kernels.mlp import MLP
from twofold.losses import squared_error
from twofold.methods.base import EVALUATION, Avatar, Batch, Mode, PosedAvatar, Rendering
from twofold.methods.parameter_group import ParameterGroup
from twofold.methods.skeletal_config import Shaded, SkeletalConfig, SkeletalPose, SkeletalRates
from twofold.methods.subject import Subject
from twofold.metrics.perceptual import LPIPS
from twofold.sampling.error_bounded import uniform_depths
from twofold.sampling.joint_box import joint_box
from twofold.sampling.visibility import seen_samples
from twofold.volume.nerf_compositing import alpha_of_density, alpha_weights, open_samples
from twofold.volume.rendering import composite
from twofold.volume.samples import Samples

RAYS_AT_ONCE = 2048
"""Rays that are shaded together where no gradient is wanted: 128 samples of each take half a gigabyte."""
LEVEL_SCALE = 0.03
"""What `level` is where there is no density at all, metres; its slope at a surface is then about one to three."""
EMPTY = 5 / 255
"""Pixels closer to the background than this show nobody."""

Posed = PosedAvatar[SkeletalPose]


class SkeletalAvatar(Avatar[SkeletalPose]):
    """An avatar whose points go to the T-pose by a learned weight volume; what is there, a method adds.

    Rays are sampled in a space in which the body's root is neither turned nor moved (`aligned`), so that turning body
    and camera together changes nothing.
    """

    rest_joints: Tensor
    trained_step: Tensor

    def __init__(
        self, config: SkeletalConfig, rates: SkeletalRates, subject: Subject, generator: torch.Generator
    ) -> None:
        """Builds the weight volume over the subject's T-pose."""
        super().__init__()
        self.settings, self.rates, self.subject = config, rates, subject
        joints = shape_body(subject.body, subject.betas).joints
        self.register_buffer("rest_joints", joints.clone(), persistent=False)
        # Schedules go by the training's step, which an avatar that is shown has to know as well.
        self.register_buffer("trained_step", torch.zeros((), dtype=torch.int64))
        channels = config.volume_channels
        prior = bone_prior(joints, canonical_box(joints), 2 ** len(channels))
        self.volume = WeightVolume(prior, generator, channels, config.volume_code)
        self.correction = PoseCorrection(generator).requires_grad_(config.correct_poses)
        self._kept_volume: tuple[tuple[object, ...], Tensor] | None = None
        self._perceptual: tuple[LPIPS, ...] = ()

    # ---- what a method adds

    @abstractmethod
    def radiance(
        self, moved: SkeletalPoints, observed: Float[Tensor, "n 3"], posed: Posed, mode: Mode
    ) -> tuple[RadianceOutput, dict[str, Tensor]]:
        """Density and colour of points that the skeleton brought to the T-pose, and extras of each for the losses.

        Densities are in `SkeletalConfig.density_unit`.

        Args:
            moved: the points in the T-pose.
            observed: the same points in aligned space, metres.
            posed: the pose.
            mode: training or evaluation.
        """

    @abstractmethod
    def density(self, moved: SkeletalPoints, posed: Posed) -> Float[Tensor, "n"]:
        """The density of `radiance` alone, in evaluation."""

    @property
    @abstractmethod
    def networks(self) -> list[nn.Module]:
        """What learns with the rate "networks"."""

    @property
    @abstractmethod
    def motions(self) -> list[nn.Module]:
        """What learns with the rate "motion"."""

    # ---- posing

    def step_of(self, mode: Mode) -> int:
        """The training step that schedules go by: the mode's, or the one that was trained last."""
        return int(self.trained_step) if mode.step is None else mode.step

    def before_step(self, mode: Mode) -> None:
        """Notes the step, by which schedules go in evaluation, too."""
        self.trained_step.fill_(mode.step or 0)

    def pose(
        self, pose: Float[Tensor, "24 3"], translation: Float[Tensor, "3"], frame_index: int | None = None,
        mode: Mode = EVALUATION,
    ) -> Posed:  # fmt: skip
        """See `Avatar.pose`. Corrections follow from the pose alone, so every pose has one, whatever its frame."""
        pose, translation = pose.to(self.device), translation.to(self.device)
        config, step = self.settings, self.step_of(mode)
        self._choose_types()
        given = axis_angle_to_matrix(pose)
        rotations = self.correction(pose) if config.correct_poses and step >= config.correct_from else given
        to_aligned, from_canonical = aligned(self.rest_joints, rotations, translation)
        as_given = aligned(self.rest_joints, given, translation)[1]
        joints = (as_given[:, :3, :3] @ self.rest_joints[:, :, None])[..., 0] + as_given[:, :3, 3]
        started = step >= config.motion_from or config.motion_sees_pose == "always"
        condition = body_pose_condition(pose)
        own = SkeletalPose(
            to_aligned=to_aligned,
            from_canonical=from_canonical,
            to_canonical=torch.linalg.inv(from_canonical),
            box=joint_box(joints, self.subject.scene_scale),
            weights=self._weights(mode),
            condition=condition if started else torch.zeros_like(condition),
            open_bands=open_hann_bands(step, config.motion_from, config.motion_full, NON_RIGID_OCTAVES),
        )
        with torch.no_grad():
            body, betas = self.subject.body, self.subject.betas
            seen = pose if rotations is given else matrix_to_axis_angle(rotations)
            posed = pose_body(shape_body(body, betas), seen.cpu(), translation.cpu())
            if self.device.type != "cpu":
                posed = replace(posed, **{name: t.to(self.device) for name, t in vars(posed).items()})
        return PosedAvatar(posed, own)

    def _choose_types(self) -> None:
        """Lets the hidden layers of the networks at samples compute in the type that the settings choose."""
        choice = self.settings.hidden_dtype
        fast = choice == "bfloat16" or (choice == "auto" and bf16_is_fast(self.device))
        for module in [part for owner in (*self.networks, *self.motions) for part in owner.modules()]:
            if isinstance(module, MLP):
                module.hidden_dtype = torch.bfloat16 if fast else None

    def _weights(self, mode: Mode) -> Float[Tensor, "c z y x"]:
        """The weight volume; where it does not learn, it is computed once and kept until its parameters change."""
        if torch.is_grad_enabled() and mode.step is not None and mode.step % self.settings.volume_every == 0:
            # The fused optimizer changes parameters without changing their version.
            self._kept_volume = None
            return self.volume()
        version = self.device, *((p.data_ptr(), p._version) for p in self.volume.parameters())
        if self._kept_volume is None or self._kept_volume[0] != version:
            with torch.no_grad():
                self._kept_volume = version, self.volume()
        return self._kept_volume[1]

    # ---- rendering

    def render(
        self, rays: Rays, posed: Posed, background: Float[Tensor, "*r 3"] | None, mode: Mode = EVALUATION,
        generator: torch.Generator | None = None,
    ) -> Rendering:  # fmt: skip
        """See `Avatar.render`. Rays begin and end at the box of the joints, whatever bounds they bring."""
        behind = (torch.zeros(3, device=self.device) if background is None else background).expand(len(rays), 3)
        bounded, hit = bounded_rays(rays, posed.own)
        which = hit.nonzero()[:, 0]
        parts = which.split(len(which) if torch.is_grad_enabled() else RAYS_AT_ONCE) if len(which) else ()
        # Tied to a parameter, so that a step whose rays all miss has a gradient, of zero, like any other.
        nothing = torch.zeros(len(rays), 5, device=self.device) + 0 * self.volume.code[0]
        values, extras = [nothing[~hit]], []
        for part in parts:
            shaded = self._shaded(bounded[part], posed, mode, generator)
            extras.append(shaded.extras)
            alpha = alpha_of_density(shaded.density, shaded.samples.delta) * shaded.likelihood
            weights = alpha_weights(alpha, shaded.samples.ray_index)
            ones = torch.ones_like(alpha)[:, None]
            columns = torch.cat([shaded.color, ones, shaded.samples.depth[:, None]], -1)
            values.append(composite(weights, columns, shaded.samples, len(part)))
        order = torch.cat([(~hit).nonzero()[:, 0], which]).argsort()
        out = torch.cat(values)[order]
        opacity = out[:, 3]
        joined = {name: torch.cat([e[name] for e in extras]) for name in (extras[0] if extras else ())}
        return Rendering(
            color=out[:, :3] + (1 - opacity[:, None]) * behind,
            opacity=opacity,
            depth=out[:, 4] / opacity.detach().clamp_min(1e-6),
            normal=torch.zeros_like(out[:, :3]),
            extras=joined,
        )

    def _shaded(self, rays: Rays, posed: Posed, mode: Mode, generator: torch.Generator | None) -> Shaded:
        """The samples along rays that meet the box."""
        samples = open_samples(uniform_depths(rays, self.settings.samples, generator))
        points = samples.points(rays)
        if self.settings.min_weight > 0:
            seen = self._seen(samples, points, posed, len(rays))
            samples, points = samples[seen], points[seen]
            moved = self._moved(points, posed, min_likelihood=None)
        else:
            moved = self._moved(points, posed, self.settings.min_likelihood)
        answer, extras = self.radiance(moved, points[moved.index], posed, mode)
        density = self.settings.density_unit * answer.density
        return Shaded(samples[moved.index], density, answer.color, moved.likelihood, extras)

    @torch.no_grad()
    def _seen(self, samples: Samples, points: Float[Tensor, "S 3"], posed: Posed, rays: int) -> Int[Tensor, "n"]:
        """Which samples add more than `min_weight` to their pixel."""
        moved = self._moved(points, posed, self.settings.min_likelihood)
        likely = samples[moved.index]

        def density(index: Tensor) -> Tensor:
            delta, likelihood = likely.delta[index], moved.likelihood[index]
            part = SkeletalPoints(moved.index[index], moved.points[index], likelihood)
            alpha = alpha_of_density(self.settings.density_unit * self.density(part, posed), delta) * likelihood
            # The density without a likelihood that is as opaque.
            return -torch.log1p(-alpha.clamp_max(1 - 1e-6)) / delta

        return moved.index[seen_samples(likely, density, rays, self.settings.min_weight)]

    def _moved(self, points: Float[Tensor, "S 3"], posed: Posed, min_likelihood: float | None) -> SkeletalPoints:
        """Points of aligned space in the T-pose; only those that are more likely than that, if it is given."""
        own, box = posed.own, canonical_box(self.rest_joints)
        return skeletal_backward(own.weights, points, own.to_canonical, box, min_likelihood)

    def level(self, x: Float[Tensor, "S 3"], posed: Posed, branch: str = "full") -> Float[Tensor, "S"]:
        """See `Avatar.level`: 3 cm times (1 - d / d0), at least -3 cm, with d the density times the likelihood."""
        require(branch in ("full", "base"), f'branch is "full" or "base"; it is {branch!r}')
        points = skin(x, x.new_ones(len(x), 1), posed.own.to_aligned[None])
        moved = self._moved(points, posed, self.settings.min_likelihood)
        likely = self.settings.density_unit * self.density(moved, posed) * moved.likelihood
        density = torch.zeros(len(x), device=x.device).index_add(0, moved.index, likely)
        return LEVEL_SCALE * (1 - density / self.settings.level_density).clamp_min(-1)

    @property
    def level_space(self) -> Literal["canonical", "posed"]:
        """See `Avatar.level_space`: density times likelihood depends on where each bone takes a posed point."""
        return "posed"

    # ---- training

    @property
    def wants_perceptual(self) -> bool:
        """See `Avatar.wants_perceptual`."""
        return self.settings.lpips > 0

    def attach_perceptual(self, network: LPIPS | None) -> None:
        """See `Avatar.attach_perceptual`; it is not moved with the avatar either."""
        self._perceptual = (network.to(self.device),) if network else ()

    def background(
        self, color: Float[Tensor, "3"], rays: int, generator: torch.Generator
    ) -> Float[Tensor, "*r 3"] | None:
        """See `Avatar.background`: a random colour for each image."""
        return torch.rand(3, generator=generator, device=generator.device).to(color)

    def losses(
        self, rendering: Rendering, batch: Batch, posed: Posed, mode: Mode, generator: torch.Generator
    ) -> dict[str, Float[Tensor, ""]]:
        """See `Avatar.losses`: of the patches as images, off-box pixels in the background's colour; of single rays."""
        fill = None if batch.background is None else batch.background.expand(3)
        shown, truth = batch.patches(rendering.color, fill), batch.patches(batch.color, fill)
        pixels = [
            torch.cat([color[: batch.singles], patches.permute(0, 2, 3, 1).flatten(0, 2)])
            for color, patches in ((rendering.color, shown), (batch.color, truth))
        ]
        terms = {"reconstruction": self.settings.squared_error * squared_error(pixels[0], pixels[1])}
        if self.settings.lpips and self._perceptual and len(shown):
            terms["lpips"] = self.settings.lpips * self._perceptual[0](shown, truth).mean()
        return terms

    def after_step(self, mode: Mode, capture: Capture) -> Literal["continue", "restart"]:
        """See `Avatar.after_step`: after some steps, "restart" if one of a few training frames shows nobody."""
        if mode.step is None or mode.step + 1 not in self.settings.guard_steps:
            return "continue"
        frames = spread(capture.train, self.settings.guard_frames)
        color = torch.tensor(capture.background, device=self.device)
        return "restart" if any(self._shows_nobody(frame, color) for frame in frames) else "continue"

    @torch.no_grad()
    def _shows_nobody(self, frame: Frame, color: Float[Tensor, "3"]) -> bool:
        camera, size = frame.camera, self.settings.guard_size
        if size is not None:
            factor = min(1.0, size / max(camera.height, camera.width))
            camera = camera.resized(math.ceil(factor * camera.height), math.ceil(factor * camera.width))
        camera = camera.to(self.device)
        rays = pixel_rays(camera, pixel_grid(camera).flatten(0, 1))
        shown = self.render(rays, self.pose(frame.pose, frame.translation), color).color
        return bool(((shown - color).abs() <= EMPTY).all())

    def parameter_groups(self) -> list[ParameterGroup]:
        """Four: "networks", "volume", "motion" and "pose"."""
        owners = {
            "networks": self.networks,
            "volume": [self.volume],
            "motion": self.motions,
            "pose": [self.correction],
        }
        return [
            ParameterGroup(
                name, getattr(self.rates, name), [p for m in modules for p in m.parameters() if p.requires_grad]
            )
            for name, modules in owners.items()
        ]

    def pose_corrections(self) -> dict[str, float]:
        """See `Avatar.pose_corrections`, over the training poses; empty before corrections begin."""
        if not self.settings.correct_poses or int(self.trained_step) < self.settings.correct_from:
            return {}
        with torch.no_grad():
            poses = self.subject.poses.to(self.device)
            turns = [axis_angle_to_matrix(pose).mT @ self.correction(pose) for pose in poses]
            return {"body": float(matrix_to_axis_angle(torch.stack(turns)[:, 1:]).square().sum(-1).mean().sqrt())}


def aligned(
    joints: Float[Tensor, "24 3"], rotations: Float[Tensor, "24 3 3"], translation: Float[Tensor, "3"]
) -> tuple[Float[Tensor, "4 4"], Float[Tensor, "24 4 4"]]:
    """The methods' pose convention: world to a space in which the root is as in the T-pose, and each bone to there.

    The authors' programs move the root's rotation and translation into the camera; this is the same.

    Args:
        joints: of the T-pose, metres.
        rotations: of each joint relative to its parent, root first.
        translation: SMPL's own, metres.
    """
    root = joint_transforms_of_rotations(joints, rotations, translation)[0]
    still = torch.cat([torch.eye(3, dtype=rotations.dtype, device=rotations.device)[None], rotations[1:]])
    return rigid_inverse(root), joint_transforms_of_rotations(joints, still, torch.zeros_like(translation))


def bounded_rays(rays: Rays, own: SkeletalPose) -> tuple[Rays, Tensor]:
    """World rays in aligned space from where they enter the box of the joints to where they leave it; which meet it."""
    rotation, shift = own.to_aligned[:3, :3], own.to_aligned[:3, 3]
    origins, directions = rays.origins @ rotation.T + shift, rays.directions @ rotation.T
    near = torch.zeros_like(rays.near)
    endless = Rays(origins, directions, near, torch.full_like(near, torch.inf))
    clipped, hit = clip_to_box(without_tiny_components(endless), own.box[0], own.box[1])
    return Rays(origins, directions, clipped.near, clipped.far), hit
