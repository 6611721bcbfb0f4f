"""NPC (Neural Point Characters): a cloud of points on the person, found by DANBO, and a surface read from it."""

from collections.abc import Callable, Collection
from dataclasses import dataclass, field, replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from twofold.capture.types import Capture
from twofold.config import require_within
from twofold.field.bone_boxes import RIGID_PARTS, initial_half_sizes
from twofold.geometry.cameras import Rays
from twofold.losses import background, box_assignment, box_volumes
from twofold.methods.base import Batch, MethodConfig, Mode, PosedAvatar, Rendering, Stage
from twofold.methods.boxed_avatar import CODE_SPREAD, BoxedAvatar
from twofold.methods.boxed_config import (
    BoxedPose,
    BoxedSettings,
    Radiance,
    affordable,
    released_training,
    short_training,
)
from twofold.methods.local_radiance import POSE_OCTAVES, LocalRadiance, inside_rigid
from twofold.methods.parameter_group import ParameterGroup
from twofold.methods.point_needs import body_surface, require_points, unseen_parts
from twofold.methods.point_networks import BETA, PointNetworks, PointWeights, ReadyPoints, surface_positions
from twofold.methods.subject import Subject
from twofold.recipe import Recipe, TrainingConfig, scaled_count
from twofold.volume.nerf_compositing import open_density_weights, without_thin_density
from twofold.volume.samples import Samples

DECAY_STEPS = 500_000
"""Steps after which the first stage's rates are a tenth, and the second's a fifth."""


@dataclass(frozen=True)
class NpcRates:
    """Learning rates of the stages, before schedules; the defaults are the authors' program."""

    boxes: float = 5e-4
    """Of everything in the first stage."""
    points: float = 5e-4
    """Of everything in the second."""

    def __post_init__(self) -> None:
        """Refuses rates that diverge at once."""
        require_within(self, boxes=(0, 1000), points=(0, 1000))


@dataclass(frozen=True)
class NpcConfig(MethodConfig):
    """NPC with its DANBO stage; the defaults are the authors' program."""

    first: BoxedSettings = field(default_factory=lambda: BoxedSettings(level_density=20.0))
    """Rays of the first stage; its surface gives the points."""
    boxed: BoxedSettings = field(default_factory=lambda: BoxedSettings(coarse=64, fine=32))
    """Rays of the second stage."""
    first_steps: int = 10_000
    """Steps of the first stage; `training.steps` are those of the second."""
    first_rays: int = 192
    """Rays of an image in the first stage."""
    first_decay: float = 0.1 ** (10_000 / DECAY_STEPS)
    """What the rates are multiplied with at the end of the first stage."""
    points: int = 200
    """Points of each of the 19 parts."""
    point_voxel: float = 2.6 / 511
    """Spacing of the grid on which the points are found, metres."""
    box_volume: float = 1e-3
    """Weight of the volume of the boxes, first stage."""
    box_assignment: float = 1e-3
    """Weight of the term that gives each sample on the person to one box, first stage."""
    weights: PointWeights = field(default_factory=PointWeights)
    beta: float = BETA
    """Initial scale of the density in the second stage, metres."""
    background: float = 1.0
    """Weight of the learned background, second stage; 0 leaves it out."""
    rates: NpcRates = field(default_factory=NpcRates)

    def __post_init__(self) -> None:
        """Refuses what no points can be made of."""
        require_within(
            self, first_steps=(1, 100_000_000), first_rays=(1, 1_000_000), first_decay=(1e-9, 1), points=(8, 5000),
            point_voxel=(1e-3, 0.1), beta=(1e-3, 1), box_volume=(0, 1e6), box_assignment=(0, 1e6), background=(0, 1e6),
        )  # fmt: skip

    def total_steps(self, training: TrainingConfig) -> int:
        """See `MethodConfig.total_steps`: of both stages."""
        return self.first_steps + training.steps

    def scaled(self, factor: float) -> "NpcConfig":
        """See `MethodConfig.scaled`."""
        return replace(self, first_steps=scaled_count(self.first_steps, factor))

    def build(self, subject: Subject, seed: int = 0) -> "NpcAvatar":
        """An untrained avatar of a subject, in its first stage."""
        return NpcAvatar(self, subject, seed)


Shared = Tensor | ReadyPoints
"""What a pose gives: the volumes' tables in the first stage, the posed points in the second."""
Posed = PosedAvatar[BoxedPose[Shared]]


class NpcAvatar(BoxedAvatar[Shared]):
    """See `NpcConfig`. The second stage has other networks in place of the first one's, and boxes that stay."""

    parts = RIGID_PARTS
    cameras: Tensor
    camera_sizes: Tensor

    def __init__(self, config: NpcConfig, subject: Subject, seed: int) -> None:
        """Builds the first stage."""
        generator = torch.Generator().manual_seed(seed)
        super().__init__(config.first, POSE_OCTAVES, subject, generator)
        self.config = config
        self.local: LocalRadiance | None = LocalRadiance(generator)
        self.points: PointNetworks | None = None
        self.background_codes: nn.Parameter | None = None

    # ---- stages

    def stages(self, training: TrainingConfig) -> tuple[Stage, ...]:
        """See `Avatar.stages`: DANBO, then the points."""
        config = self.config
        pixels = replace(training.pixels, rays=config.first_rays)
        first = replace(training, steps=config.first_steps, decay=config.first_decay, pixels=pixels)
        return Stage("boxes", first), Stage("points", training)

    def check_capture(self, capture: Capture) -> str | None:
        """See `Avatar.check_capture`: nearly every body part has to be shown, and be large enough for its points.

        Raises:
            TwofoldError: see `require_points`.
        """
        return require_points(capture, self._first_sizes, self.config.points, self.config.point_voxel)

    @property
    def _first_sizes(self) -> Float[Tensor, "19 3"]:
        """Half sizes of the rigid parts' boxes before they are trained, metres."""
        return initial_half_sizes(self.rest_joints.cpu())[list(RIGID_PARTS)]

    def prepare_training(self, capture: Capture, stage: int, generator: torch.Generator) -> None:
        """See `Avatar.prepare_training`: the second stage begins with points on the surface of the first one's field.

        Raises:
            TwofoldError: there is no such surface, or too little of it in a part.
        """
        if stage == 1:
            cameras = [(f.frame_index, f.camera) for f in capture.train]
            # By the boxes as they began, as `check_capture` told the user.
            unseen = unseen_parts(capture, self._first_sizes)
            self.begin_points(self.find_positions(unseen), generator, len(cameras))
            rows = torch.stack([torch.cat([c.world_to_camera, _intrinsics(c.intrinsics)]) for _, c in cameras])
            sizes = torch.tensor([[time, c.width, c.height] for time, c in cameras])
            self.cameras, self.camera_sizes = rows.to(self.device), sizes.to(self.device)

    @torch.no_grad()
    def find_positions(self, unseen: Collection[int] = ()) -> Float[Tensor, "m 19 3"]:
        """Points on the first stage's surface in the T-pose; the field is computed inside its boxes only.

        Args:
            unseen: parts that no image shows, whose points lie on the body's surface instead.

        Raises:
            TwofoldError: there is no surface, or too little of it in a part.
        """
        config, rest = self.config, torch.zeros(24, 3)
        posed, voxel = self.pose(rest, rest[0]), self.config.point_voxel
        reach = float(posed.own.half_sizes.max()) * 2
        low, high = self.rest_joints.amin(0) - reach, self.rest_joints.amax(0) + reach
        counts = [int(n) for n in ((high - low) / voxel).ceil() + 1]
        axes = [low[i] + voxel * torch.arange(counts[i], device=low.device) for i in range(3)]
        across = torch.stack(torch.meshgrid(axes[1], axes[2], indexing="ij"), -1).flatten(0, 1)
        slabs = [
            self.level(torch.cat([x.expand(len(across), 1), across], -1), posed).unflatten(0, (counts[1], counts[2]))
            for x in axes[0]
        ]
        volume = torch.stack(slabs).cpu().numpy()
        body = body_surface(self.subject.body, self.subject.betas)[0] if unseen else None
        sizes = posed.own.half_sizes
        return surface_positions(volume, low, voxel, self.rest_joints, sizes, config.points, unseen, body)

    def begin_points(self, positions: Float[Tensor, "m 19 3"], generator: torch.Generator | None, cameras: int) -> None:
        """Puts the networks of the second stage in the place of the first one's.

        Args:
            positions: box coordinates of the points.
            generator: draws the start.
            cameras: how many training images there are.
        """
        sizes = self.boxes().detach()
        joints = self.rest_joints.cpu()
        beta = self.config.beta
        self.points = PointNetworks(positions.cpu(), joints, sizes.cpu(), generator, beta).to(self.device)
        self.boxes.requires_grad_(False)
        self.settings = self.config.boxed
        codes = [CODE_SPREAD * torch.randn(self.codes.shape, generator=generator) for _ in range(2)]
        with torch.no_grad():
            self.codes.copy_(codes[0])
        learned = self.config.background > 0
        self.points.background.requires_grad_(learned)
        self.background_codes = nn.Parameter(codes[1].to(self.device), requires_grad=learned)
        self.register_buffer("cameras", torch.zeros(cameras, 7, 4, device=self.device))
        self.register_buffer("camera_sizes", torch.zeros(cameras, 3, dtype=torch.long, device=self.device))
        self.local = None

    def load_stored(self, state: dict[str, Tensor]) -> None:
        """See `Avatar.load_stored`: a state of the second stage brings the number of its points."""
        positions, cameras = state.get("points.cloud.positions"), state.get("cameras")
        fits = positions is not None and positions.dim() == 3 and positions.shape[1:] == (len(RIGID_PARTS), 3)
        if self.points is None and fits and positions is not None and cameras is not None and len(positions) >= 8:
            self.begin_points(torch.zeros(positions.shape), None, len(cameras))

    # ---- the field

    def shared(self, features: Float[Tensor, "24 f"], transforms: Float[Tensor, "24 4 4"]) -> Shared:
        """See `BoxedAvatar.shared`."""
        if self.points is not None:
            return self.points.ready(features, transforms)
        assert self.local is not None
        return self.local.volumes.tables(features)

    def reached(self, coordinates: Float[Tensor, "S 24 3"]) -> Bool[Tensor, "S"]:
        """See `BoxedAvatar.reached`: points in the boxes of the rigid parts."""
        return inside_rigid(coordinates)

    def radiance_at(
        self, points: Float[Tensor, "S 3"], coordinates: Float[Tensor, "S 24 3"], views: Float[Tensor, "S 3"],
        own: BoxedPose[Shared], generator: torch.Generator | None,
    ) -> Radiance:  # fmt: skip
        """See `BoxedAvatar.radiance_at`. Test images of the second stage have no densities below 2."""
        if self.points is None:
            assert self.local is not None
            assert isinstance(own.shared, Tensor)
            return self.local(own.shared, coordinates, views, own.code, generator)
        assert isinstance(own.shared, ReadyPoints)
        answer = self.points(own.shared, points, views, own.code)
        return answer if own.training else replace(answer, density=without_thin_density(answer.density))

    def density_at(
        self, points: Float[Tensor, "S 3"], coordinates: Float[Tensor, "S 24 3"], own: BoxedPose[Shared]
    ) -> Float[Tensor, "S"]:
        """See `BoxedAvatar.density_at`."""
        if self.points is None:
            assert self.local is not None
            assert isinstance(own.shared, Tensor)
            return self.local.density(own.shared, coordinates)
        assert isinstance(own.shared, ReadyPoints)
        return self.points.density(own.shared, points)

    def weights(self, density: Float[Tensor, "S"], samples: Samples) -> Float[Tensor, "S"]:
        """See `BoxedAvatar.weights`: NeRF's rule in the first stage, integrated density in the second."""
        if self.points is None:
            return super().weights(density, samples)
        return open_density_weights(density, samples.delta, samples.ray_index)

    # ---- training

    def losses(
        self, rendering: Rendering, batch: Batch, posed: Posed, mode: Mode, generator: torch.Generator
    ) -> dict[str, Float[Tensor, ""]]:
        """See `BoxedAvatar.losses`; DANBO's terms in the first stage, those of the points in the second."""
        terms, config = super().losses(rendering, batch, posed, mode, generator), self.config
        if self.points is None or not isinstance(posed.own.shared, ReadyPoints):
            seen = (rendering.extras["weights"].detach() > 0).to(rendering.color.dtype).flatten()
            assigned = rendering.extras["extra"].flatten()[:, None]
            return terms | {
                "boxes": config.box_volume * box_volumes(posed.own.half_sizes),
                "assignment": config.box_assignment * box_assignment(assigned, seen),
            }
        terms |= self.points.constraints(posed.own.shared, config.weights, generator)
        if config.background > 0:
            terms["background"] = config.background * self._background_term(self.points, rendering, batch)
        return terms

    def _background_term(self, points: PointNetworks, rendering: Rendering, batch: Batch) -> Float[Tensor, ""]:
        """How far the learned background is from the image where the person is not."""
        assert self.background_codes is not None
        row = self._rows.get(batch.frame_index)
        code = self.background_codes.mean(0) if row is None else self.background_codes[row]
        pixels = self._pixels(batch.rays, batch.frame_index)
        predicted = points.background(pixels, torch.zeros_like(batch.image), code)
        return background(predicted, batch.image, rendering.opacity)

    def _pixels(self, rays: Rays, time: int) -> Float[Tensor, "R 2"]:
        """(column, row) over width and height of training rays: of the camera of that time which they come from."""
        rotations, shifts = self.cameras[:, :3, :3], self.cameras[:, :3, 3]
        centers = -(rotations.mT @ shifts[..., None])[..., 0]
        away = (centers - rays.origins[0]).norm(dim=-1)
        row = int(away.masked_fill(self.camera_sizes[:, 0] != time, torch.inf).argmin())
        seen = rays.directions @ rotations[row].T @ self.cameras[row, 4:, :3].T
        return seen[:, :2] / seen[:, 2:] / self.camera_sizes[row, 1:]

    def parameter_groups(self) -> list[ParameterGroup]:
        """See `Avatar.parameter_groups`: all of the stage in one."""
        name = "boxes" if self.points is None else "points"
        trainable = [p for p in self.parameters() if p.requires_grad]
        return [ParameterGroup(name, getattr(self.config.rates, name), trainable)]

    def scalars(self) -> dict[str, float]:
        """See `Avatar.scalars`: the scale of the density in the second stage; not a number before."""
        return {} if self.points is None else {"beta": float(self.points.beta.detach())}


def _intrinsics(matrix: Float[Tensor, "3 3"]) -> Float[Tensor, "3 4"]:
    return torch.cat([matrix, torch.zeros_like(matrix[:, :1])], 1)


def npc() -> Recipe:
    """The authors' program: DANBO's 10,000 steps, then 300,000 of 4096 rays from 16 images. Days on a CPU."""
    training = released_training(steps=300_000, rays=256, decay=0.2 ** (300_000 / DECAY_STEPS))
    return Recipe("npc", NpcConfig(), training)


def npc_fast() -> Recipe:
    """The same networks and losses; only samples near the body, one image a step, short schedules."""
    start = npc()
    method = replace(
        start.method,
        first=affordable(start.method.first),
        boxed=affordable(start.method.boxed, coarse=40, fine=20),
        first_steps=500, first_rays=192, first_decay=0.1, point_voxel=0.006, background=0.0, beta=0.02,
        rates=NpcRates(boxes=1e-3, points=1e-3),
    )  # fmt: skip
    return replace(start, name="npc_fast", method=method, training=short_training(start.training, steps=1500))


RECIPES: dict[str, Callable[[], Recipe]] = {"npc": npc, "npc_fast": npc_fast}
"""What `--recipe` offers."""
