"""What PM-Avatar, DANBO and NPC share: boxes around the bones, coarse and fine samples, frame codes, density levels.

Everything is computed in the root's space: the T-pose, of which the root is neither turned nor moved. View directions
there are those "in the root frame" of the authors' programs, and turning camera and body together changes nothing.
"""

from abc import abstractmethod
from dataclasses import replace
from typing import Literal

import numpy as np
import torch
from jaxtyping import Bool, Float
from scipy.spatial import KDTree
from torch import Tensor, nn

from twofold.body.skeleton import joint_transforms, pose_body, shape_body
from twofold.config import require
from twofold.field.bone_boxes import BoneFrames, BoxSizes, bone_frames, box_coordinates, initial_half_sizes
from twofold.field.conditioned_radiance import CODE_SIZE
from twofold.field.graph import pose_features
from twofold.field.networks import bf16_is_fast
from twofold.geometry.cameras import Rays
from twofold.geometry.rotations import axis_angle_to_matrix, rigid_inverse
from twofold.kernels.kdtree import search_tree
from twofold.kernels.mlp import MLP
from twofold.losses import reconstruction
from twofold.methods.base import EVALUATION, Avatar, Batch, Mode, PosedAvatar, Rendering
from twofold.methods.boxed_config import BoxedPose, BoxedSettings, Radiance, Shared
from twofold.methods.subject import Subject
from twofold.sampling.box_bounds import BOX_SCALE, clip_to_bone_boxes, clip_to_cylinder
from twofold.sampling.error_bounded import uniform_depths
from twofold.sampling.importance import importance_depths
from twofold.volume.nerf_compositing import alpha_of_density, alpha_weights, open_samples
from twofold.volume.rendering import composite
from twofold.volume.samples import Samples

RAYS_AT_ONCE, POINTS_AT_ONCE = 2048, 16_384
"""Rays and samples that are computed together where no gradient is wanted."""
LEVEL_SCALE = 0.03
"""What `density_level` is where there is no density at all, metres."""
CODE_SPREAD = 0.1
"""Standard deviation of the initial frame codes."""


def root_pose(
    joints: Float[Tensor, "24 3"], pose: Float[Tensor, "24 3"], translation: Float[Tensor, "3"]
) -> tuple[Float[Tensor, "4 4"], Float[Tensor, "24 4 4"]]:
    """The methods' pose convention: from the world to the root's space, and from the T-pose to there for each joint.

    Args:
        joints: of the T-pose, metres.
        pose: axis-angle, root first, radians.
        translation: SMPL's own, metres.
    """
    to_root = rigid_inverse(joint_transforms(joints, pose, translation)[0])
    still = torch.cat([torch.zeros_like(pose[:1]), pose[1:]])
    return to_root, joint_transforms(joints, still, torch.zeros_like(translation))


def density_level(density: Float[Tensor, "S"], surface: float) -> Float[Tensor, "S"]:
    """3 cm (1 - d / d0), at least -3 cm: zero where the density d is that of the surface, negative where it is higher.

    >>> density_level(torch.tensor([0.0, 5.0, 500.0]), 5.0)
    tensor([ 0.0300,  0.0000, -0.0300])

    Args:
        density: per metre.
        surface: the surface's, d0.
    """
    return LEVEL_SCALE * (1 - density / surface).clamp_min(-1)


class BoxedAvatar(Avatar[BoxedPose[Shared]]):
    """An avatar with a box around each bone; what is inside, a method says."""

    rest_joints: Tensor
    parts: tuple[int, ...] = tuple(range(24))
    """Joints whose boxes rays are cut with."""

    def __init__(
        self, settings: BoxedSettings, pose_octaves: int, subject: Subject, generator: torch.Generator
    ) -> None:
        """Makes boxes and frame codes.

        Args:
            settings: shared ones.
            pose_octaves: of `field.graph.pose_features`.
            subject: whose skeleton it is.
            generator: draws the codes.
        """
        super().__init__()
        self.settings, self.pose_octaves, self.subject = settings, pose_octaves, subject
        joints = shape_body(subject.body, subject.betas).joints
        self.register_buffer("rest_joints", joints.clone(), persistent=False)
        self.boxes = BoxSizes(initial_half_sizes(joints))
        self.codes = nn.Parameter(CODE_SPREAD * torch.randn(len(subject.times), CODE_SIZE, generator=generator))
        self._rows = {int(time): row for row, time in enumerate(subject.times)}

    # ---- what a method adds

    @abstractmethod
    def shared(self, features: Float[Tensor, "24 f"], transforms: Float[Tensor, "24 4 4"]) -> Shared:
        """What the method's networks make of a pose, once for all samples.

        Args:
            features: of the pose, `field.graph.pose_features`.
            transforms: from the T-pose to the root's space.
        """

    @abstractmethod
    def reached(self, coordinates: Float[Tensor, "S 24 3"]) -> Bool[Tensor, "S"]:
        """Which points may hold density, by their coordinates in the boxes; all others are empty."""

    @abstractmethod
    def radiance_at(
        self, points: Float[Tensor, "S 3"], coordinates: Float[Tensor, "S 24 3"], views: Float[Tensor, "S 3"],
        own: BoxedPose[Shared], generator: torch.Generator | None,
    ) -> Radiance:  # fmt: skip
        """Density and colour at points that are reached.

        Args:
            points: in the root's space, metres.
            coordinates: of the points in the boxes.
            views: unit directions from the camera to the points, in the root's space.
            own: the pose.
            generator: draws noise onto the density, in training; else None.
        """

    @abstractmethod
    def density_at(
        self, points: Float[Tensor, "S 3"], coordinates: Float[Tensor, "S 24 3"], own: BoxedPose[Shared]
    ) -> Float[Tensor, "S"]:
        """The density alone, without noise."""

    def weights(self, density: Float[Tensor, "S"], samples: Samples) -> Float[Tensor, "S"]:
        """What each sample adds to its ray (NeRF's rule)."""
        return alpha_weights(alpha_of_density(density, samples.delta), samples.ray_index)

    def missed(self, rays: Rays, own: BoxedPose[Shared], hit: Bool[Tensor, "R"]) -> tuple[Rays, Bool[Tensor, "R"]]:
        """Bounds of rays that meet no box, and which of all rays are sampled then; none of them, unless overridden."""
        return rays, hit

    # ---- posing

    def pose(
        self, pose: Float[Tensor, "24 3"], translation: Float[Tensor, "3"], frame_index: int | None = None,
        mode: Mode = EVALUATION,
    ) -> PosedAvatar[BoxedPose[Shared]]:  # fmt: skip
        """See `Avatar.pose`. A training frame has its own code; all others have the mean of these."""
        with torch.no_grad():
            body = pose_body(shape_body(self.subject.body, self.subject.betas), pose.cpu(), translation.cpu())
            body = replace(body, **{name: t.to(self.device) for name, t in vars(body).items()})
        self._choose_types()
        pose, translation = pose.to(self.device), translation.to(self.device)
        to_root, transforms = root_pose(self.rest_joints, pose, translation)
        joints = (transforms[:, :3, :3] @ self.rest_joints[..., None])[..., 0] + transforms[:, :3, 3]
        features = pose_features(axis_angle_to_matrix(pose), self.pose_octaves)
        row = None if frame_index is None else self._rows.get(frame_index)
        own = BoxedPose(
            to_root=to_root,
            transforms=transforms,
            to_frame=self._frames().world_to_frame(transforms),
            half_sizes=self.boxes(),
            joints=joints,
            code=self.codes.mean(0) if row is None else self.codes[row],
            tree=self._tree(body.vertices, to_root),
            training=mode.training,
            shared=self.shared(features, transforms),
        )
        return PosedAvatar(body, own)

    def _choose_types(self) -> None:
        """Lets the hidden layers of ReLU networks compute in the type that the settings choose."""
        choice = self.settings.hidden_dtype
        fast = choice == "bfloat16" or (choice == "auto" and bf16_is_fast(self.device))
        for module in self.modules():
            if isinstance(module, MLP):
                module.hidden_dtype = torch.bfloat16 if fast else None

    def _tree(self, vertices: Float[Tensor, "V 3"], to_root: Float[Tensor, "4 4"]) -> KDTree | None:
        if self.settings.max_distance is None:
            return None
        moved = vertices @ to_root[:3, :3].T + to_root[:3, 3]
        return search_tree(moved.cpu().numpy(), quick=True)

    def _frames(self) -> BoneFrames:
        return bone_frames(self.rest_joints)

    # ---- rendering

    def render(
        self, rays: Rays, posed: PosedAvatar[BoxedPose[Shared]], background: Float[Tensor, "*r 3"] | None,
        mode: Mode = EVALUATION, generator: torch.Generator | None = None,
    ) -> Rendering:  # fmt: skip
        """See `Avatar.render`. The generator draws noise onto densities in training; depths are never random.

        Extras: "coarse", the colour by the first samples; "weights" and "extra" of all samples, zero where none is.
        """
        behind = (torch.zeros(3, device=self.device) if background is None else background).expand(len(rays), 3)
        own, count = posed.own, self.settings.coarse + self.settings.fine
        bounded, hit = self.bounded(rays, own)
        which = hit.nonzero()[:, 0]
        parts = which.split(len(which) if torch.is_grad_enabled() else RAYS_AT_ONCE) if len(which) else ()
        noise = generator if mode.training else None
        # Tied to a parameter, so that a step whose rays all miss has a gradient, of zero, like any other.
        nothing = torch.zeros(len(rays), 9 + 2 * count, device=self.device) + 0 * self.codes[0, 0]
        found = [nothing[~hit], *(self._shaded(bounded[part], own, noise) for part in parts)]
        out = torch.cat(found)[torch.cat([(~hit).nonzero()[:, 0], which]).argsort()]
        first, second, weights, extra = out.split([4, 5, count, count], -1)
        opacity = second[:, 3]
        return Rendering(
            color=second[:, :3] + (1 - opacity[:, None]) * behind,
            opacity=opacity,
            depth=second[:, 4] / opacity.detach().clamp_min(1e-6),
            normal=torch.zeros_like(behind),
            extras={
                "coarse": first[:, :3] + (1 - first[:, 3:]) * behind,
                "coarse_opacity": first[:, 3],
                "weights": weights,
                "extra": extra,
            },
        )

    def bounded(self, rays: Rays, own: BoxedPose[Shared]) -> tuple[Rays, Bool[Tensor, "R"]]:
        """World rays in the root's space, between the ends of the boxes that they meet; and which are sampled."""
        rotation, shift = own.to_root[:3, :3], own.to_root[:3, 3]
        turned = Rays(rays.origins @ rotation.T + shift, rays.directions @ rotation.T, rays.near, rays.far)
        boxed, hit = clip_to_bone_boxes(turned, own.to_frame[[*self.parts]], own.half_sizes[[*self.parts]])
        return self.missed(boxed, own, hit)

    def _shaded(self, rays: Rays, own: BoxedPose[Shared], noise: torch.Generator | None) -> Float[Tensor, "R k"]:
        """Coarse colour and opacity; colour, opacity, depth times opacity; weights and extras of all samples."""
        coarse = uniform_depths(rays, self.settings.coarse)
        first = self._along(rays, coarse, own, noise)
        samples = open_samples(coarse)
        weights = self.weights(first.density, samples)
        seen = _composited(weights, first.color, samples, len(rays))
        fine = importance_depths(coarse, weights.detach().view_as(coarse), self.settings.fine)
        second = self._along(rays, fine, own, noise)
        depths, order = torch.cat([coarse, fine], 1).sort(1)
        merged = [_merged(getattr(first, name), getattr(second, name), order) for name in ("density", "color", "extra")]
        samples = open_samples(depths)
        weights = self.weights(merged[0], samples)
        final = _composited(weights, merged[1], samples, len(rays))
        away = composite(weights, samples.depth[:, None], samples, len(rays))
        return torch.cat([seen, final, away, weights.view_as(depths), merged[2].view_as(depths)], -1)

    def _along(
        self, rays: Rays, depths: Float[Tensor, "R n"], own: BoxedPose[Shared], noise: torch.Generator | None
    ) -> Radiance:
        """The field at depths along rays, sample by sample; only what is reached is computed."""
        points = (rays.origins[:, None] + depths[..., None] * rays.directions[:, None]).flatten(0, 1)
        index = self._reached(points, own)
        views = rays.directions[index // depths.shape[1]]
        size = max(len(index), 1) if torch.is_grad_enabled() else POINTS_AT_ONCE
        parts = [
            self.radiance_at(points[part], self._coordinates(points[part], own), view, own, noise)
            for part, view in zip(index.split(size), views.split(size), strict=True)
            if len(part)
        ]
        columns = [torch.cat([p.density[:, None], p.color, p.extra[:, None]], -1) for p in parts]
        values = torch.cat(columns) if columns else points.new_zeros(0, 5)
        whole = torch.zeros(len(points), 5, dtype=values.dtype, device=points.device).index_copy(0, index, values)
        return Radiance(whole[:, 0], whole[:, 1:4], whole[:, 4])

    @torch.no_grad()
    def _reached(self, points: Float[Tensor, "S 3"], own: BoxedPose[Shared]) -> Tensor:
        """Numbers of the points that may hold density."""
        parts = [self.reached(self._coordinates(part, own)) for part in points.split(8 * POINTS_AT_ONCE)]
        index = torch.cat(parts).nonzero()[:, 0] if parts else torch.zeros(0, dtype=torch.long, device=points.device)
        if own.tree is None or self.settings.max_distance is None:
            return index
        distance, _ = own.tree.query(points[index].cpu().numpy(), distance_upper_bound=self.settings.max_distance)
        return index[torch.from_numpy(np.isfinite(distance)).to(index.device)]

    def _coordinates(self, points: Float[Tensor, "S 3"], own: BoxedPose[Shared]) -> Float[Tensor, "S 24 3"]:
        return box_coordinates(points, own.to_frame, own.half_sizes)

    def level(
        self, x: Float[Tensor, "S 3"], posed: PosedAvatar[BoxedPose[Shared]], branch: str = "full"
    ) -> Float[Tensor, "S"]:
        """See `Avatar.level` and `density_level`. Beyond the enlarged boxes, where no ray is sampled, all is empty."""
        require(branch in ("full", "base"), f'branch is "full" or "base"; it is {branch!r}')
        own = posed.own
        points = x @ own.to_root[:3, :3].T + own.to_root[:3, 3]
        density = torch.zeros(len(x), device=x.device)
        for part in self._reached(points, own).split(POINTS_AT_ONCE):
            coordinates = self._coordinates(points[part], own)
            near = (coordinates.detach().abs() <= BOX_SCALE).all(-1).any(-1)
            chosen = part[near]
            if len(chosen):
                density[chosen] = self.density_at(points[chosen], coordinates[near], own)
        return density_level(density, self.settings.level_density)

    @property
    def level_space(self) -> Literal["canonical", "posed"]:
        """See `Avatar.level_space`: boxes move with the bones, so the density belongs to a pose."""
        return "posed"

    # ---- training

    def background(
        self, color: Float[Tensor, "3"], rays: int, generator: torch.Generator
    ) -> Float[Tensor, "*r 3"] | None:
        """See `Avatar.background`: a random colour for each ray, or the capture's own."""
        if self.settings.background == "capture":
            return color
        return torch.rand(rays, 3, generator=generator, device=generator.device).to(color)

    def losses(
        self, rendering: Rendering, batch: Batch, posed: PosedAvatar[BoxedPose[Shared]], mode: Mode,
        generator: torch.Generator,
    ) -> dict[str, Float[Tensor, ""]]:  # fmt: skip
        """See `Avatar.losses`: absolute differences of the colours by all samples and by the first ones."""
        return {
            "reconstruction": reconstruction(rendering.color, batch.color),
            "coarse": reconstruction(rendering.extras["coarse"], batch.color),
        }

    def around(self, rays: Rays, own: BoxedPose[Shared], hit: Bool[Tensor, "R"]) -> tuple[Rays, Bool[Tensor, "R"]]:
        """Rays without a box bounded by the cylinder around the body's upright axis; and which rays are sampled."""
        round_body, meets = clip_to_cylinder(rays, own.joints, own.joints.new_tensor([0.0, 1.0, 0.0]))
        near, far = torch.where(hit, rays.near, round_body.near), torch.where(hit, rays.far, round_body.far)
        return Rays(rays.origins, rays.directions, near, far), hit | meets


def _composited(
    weights: Float[Tensor, "S"], color: Float[Tensor, "S 3"], samples: Samples, rays: int
) -> Float[Tensor, "rays 4"]:
    """Colour and opacity of each ray."""
    return composite(weights, torch.cat([color, torch.ones_like(color[:, :1])], -1), samples, rays)


def _merged(first: Tensor, second: Tensor, order: Tensor) -> Tensor:
    """Values of coarse and fine samples, packed by ray, in the order of their depths."""
    rays = len(order)
    both = torch.cat([first.unflatten(0, (rays, -1)), second.unflatten(0, (rays, -1))], 1)
    index = order if both.dim() == 2 else order[..., None].expand_as(both)
    return both.gather(1, index).flatten(0, 1)
