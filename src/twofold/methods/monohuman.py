"""MonoHuman (Yu et al., CVPR 2023): HumanNeRF's skinning in both directions, and features of two key frames."""

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor, nn

from twofold.body.skeleton import skin
from twofold.capture.types import Capture
from twofold.config import require, require_within
from twofold.deform.weight_volume import SkeletalPoints, canonical_box, skeletal_forward
from twofold.field.nerf import ImageConditionedNerf, NonRigidMotion, offset_to_nearest_bone
from twofold.field.output import RadianceOutput
from twofold.field.resunet import ResUNet, ViewBlending, sample_maps
from twofold.geometry.rotations import axis_angle_to_matrix, rigid_inverse
from twofold.losses import CONSISTENT_LIKELIHOOD, deformation_consistency
from twofold.methods.base import EVALUATION, Batch, MethodConfig, Mode, Rendering
from twofold.methods.key_frames import MIN_SIDE, named_frames, read_key_frames
from twofold.methods.skeletal import Posed, SkeletalAvatar, aligned
from twofold.methods.skeletal_config import MAX_STEPS, SkeletalConfig, SkeletalRates, affordable
from twofold.methods.subject import Subject
from twofold.recipe import PixelConfig, Recipe, TrainingConfig

MAX_SIDE = 16_384
"""Of a stored key frame's image, pixels."""
MIN_DEPTH = 1e-6
"""Depths closer to zero than this are not divided by, metres."""


def released_skeletal() -> SkeletalConfig:
    """What the authors' program sets for ZJU-MoCap."""
    return SkeletalConfig(correct_poses=False, motion_from=5000, motion_full=50_000, motion_sees_pose="always")


@dataclass(frozen=True)
class MonoHumanConfig(MethodConfig):
    """MonoHuman; the defaults are the authors' program for ZJU-MoCap."""

    skeletal: SkeletalConfig = dataclasses.field(default_factory=released_skeletal)
    rates: SkeletalRates = SkeletalRates(volume=5e-6)
    key_frames: tuple[int, ...] = ()
    """Frame indices of the two key frames, front and back; none: chosen by how the body is turned and posed."""
    features_every: int = 1
    """Steps from one in which the network of the key frames' features learns to the next."""
    consistency: float = 1.0
    """Weight of the distance at which points come back after both deformations."""

    def __post_init__(self) -> None:
        """Refuses settings that nothing can be made of."""
        require_within(self, key_frames=(0, MAX_STEPS), features_every=(1, MAX_STEPS), consistency=(0, 1e6))
        two = len(self.key_frames) in (0, 2)
        require(two, f"key_frames should be two frame indices or none, not {self.key_frames}")

    def scaled(self, factor: float) -> "MonoHumanConfig":
        """See `MethodConfig.scaled`."""
        return replace(self, skeletal=self.skeletal.scaled(factor))

    def build(self, subject: Subject, seed: int = 0) -> "MonoHumanAvatar":
        """An untrained avatar of a subject."""
        return MonoHumanAvatar(self, subject, seed)


class MonoHumanAvatar(SkeletalAvatar):
    """See `MonoHumanConfig`. The key frames are part of its state; before `prepare_training` they are black."""

    key_images: Tensor
    key_poses: Tensor
    key_translations: Tensor
    key_projections: Tensor

    def __init__(self, config: MonoHumanConfig, subject: Subject, seed: int) -> None:
        """Builds the networks."""
        generator = torch.Generator().manual_seed(seed)
        super().__init__(config.skeletal, config.rates, subject, generator)
        self.config = config
        self.backward_motion = NonRigidMotion(generator=generator)
        self.forward_motion = NonRigidMotion(generator=generator)
        self.field = ImageConditionedNerf(generator)
        self.features = ResUNet(generator)
        self.blending = ViewBlending(with_unused_heads=True, generator=generator)
        self.register_buffer("key_images", torch.zeros(2, 3, MIN_SIDE, MIN_SIDE, dtype=torch.uint8))
        self.register_buffer("key_poses", torch.zeros(2, 24, 3))
        self.register_buffer("key_translations", torch.zeros(2, 3))
        # Of cameras ten metres away, so that all is well before there are key frames.
        away = torch.cat([torch.eye(3), torch.tensor([[0.0], [0.0], [10.0]])], 1)
        self.register_buffer("key_projections", away.repeat(2, 1, 1))
        self._kept_maps: tuple[tuple[object, ...], Tensor] | None = None

    @property
    def networks(self) -> list[nn.Module]:
        """See `SkeletalAvatar.networks`."""
        return [self.field, self.features, self.blending]

    @property
    def motions(self) -> list[nn.Module]:
        """See `SkeletalAvatar.motions`."""
        return [self.backward_motion, self.forward_motion]

    def check_capture(self, capture: Capture) -> None:
        """See `Avatar.check_capture`: key frames that the settings name have to be there.

        Raises:
            TwofoldError: see `named_frames`.
        """
        named_frames(capture, self.config.key_frames)

    def prepare_training(self, capture: Capture, stage: int, generator: torch.Generator) -> None:
        """See `Avatar.prepare_training`: reads the key frames.

        Raises:
            TwofoldError: see `read_key_frames`.
        """
        for name, value in vars(read_key_frames(capture, self.config.key_frames)).items():
            setattr(self, f"key_{name}", value.to(self.device))

    def load_stored(self, state: dict[str, Tensor]) -> None:
        """See `Avatar.load_stored`: takes on the size of the key frames' images."""
        images = state.get("key_images")
        if images is not None and images.ndim == 4 and MIN_SIDE <= min(images.shape[2:]) <= MAX_SIDE:
            self.key_images = torch.zeros(2, 3, *images.shape[2:], dtype=torch.uint8, device=self.device)

    def pose(
        self, pose: Float[Tensor, "24 3"], translation: Float[Tensor, "3"], frame_index: int | None = None,
        mode: Mode = EVALUATION,
    ) -> Posed:  # fmt: skip
        """See `SkeletalAvatar.pose`."""
        posed = super().pose(pose, translation, frame_index, mode)
        return replace(posed, own=replace(posed.own, maps=self._maps(mode)))

    def _maps(self, mode: Mode) -> Float[Tensor, "v c i j"]:
        """Features of the key frames; where they do not learn, they are kept until images or network change."""
        images = self.key_images.float() / 255
        if torch.is_grad_enabled() and mode.step is not None and mode.step % self.config.features_every == 0:
            # The fused optimizer changes parameters without changing their version.
            self._kept_maps = None
            return self.features(images)
        tensors = (self.key_images, *self.features.parameters())
        version = self.device, *((t.data_ptr(), t._version) for t in tensors)
        if self._kept_maps is None or self._kept_maps[0] != version:
            with torch.no_grad():
                self._kept_maps = version, self.features(images)
        return self._kept_maps[1]

    def radiance(
        self, moved: SkeletalPoints, observed: Float[Tensor, "n 3"], posed: Posed, mode: Mode
    ) -> tuple[RadianceOutput, dict[str, Tensor]]:
        """See `SkeletalAvatar.radiance`; extras are likely points and where both deformations bring them."""
        own = posed.own
        x_canonical = self.backward_motion(moved.points, own.condition, own.open_bands)
        offset = offset_to_nearest_bone(x_canonical, self.rest_joints)
        answer = self.field(x_canonical, offset, self.image_features(x_canonical, posed))
        if not mode.training:
            return answer, {}
        likely = (moved.likelihood > CONSISTENT_LIKELIHOOD).nonzero()[:, 0]
        returned = self.to_posed(x_canonical[likely], own.from_canonical, posed)
        return answer, {"observed": observed[likely], "returned": returned, "likelihood": moved.likelihood[likely]}

    def density(self, moved: SkeletalPoints, posed: Posed) -> Float[Tensor, "n"]:
        """See `SkeletalAvatar.density`. It does not depend on the key frames' images."""
        x_canonical = self.backward_motion(moved.points, posed.own.condition, posed.own.open_bands)
        return self.field.density(x_canonical, offset_to_nearest_bone(x_canonical, self.rest_joints))

    def to_posed(
        self, x_canonical: Float[Tensor, "S 3"], from_canonical: Float[Tensor, "24 4 4"], posed: Posed
    ) -> Float[Tensor, "S 3"]:
        """T-pose points in the aligned space of a pose: skinned with the weights at their place, then F without a pose.

        Args:
            x_canonical: metres.
            from_canonical: of each bone, T-pose to there.
            posed: whose weights and open frequencies count.
        """
        own = posed.own
        x = skeletal_forward(own.weights, x_canonical, from_canonical, canonical_box(self.rest_joints))
        return self.forward_motion(x, torch.zeros_like(own.condition), own.open_bands)

    def image_features(self, x_canonical: Float[Tensor, "S 3"], posed: Posed) -> Float[Tensor, "S c"]:
        """g: colour and features of the key frames where T-pose points are seen in them, blended."""
        pixels: list[Tensor] = []
        for pose, translation, projection in zip(
            self.key_poses, self.key_translations, self.key_projections, strict=True
        ):
            to_aligned, from_canonical = aligned(self.rest_joints, axis_angle_to_matrix(pose), translation)
            x = self.to_posed(x_canonical, from_canonical, posed)
            world = skin(x, x.new_ones(len(x), 1), rigid_inverse(to_aligned)[None])
            homogeneous = world @ projection[:, :3].T + projection[:, 3]
            depth = homogeneous[:, 2:]
            depth = torch.where(depth.abs() < MIN_DEPTH, torch.full_like(depth, MIN_DEPTH), depth)
            pixels.append(homogeneous[:, :2] / depth)
        places, size = torch.stack(pixels), (self.key_images.shape[2], self.key_images.shape[3])
        assert posed.own.maps is not None
        images = self.key_images.float() / 255
        return self.blending(torch.cat([sample_maps(maps, places, size) for maps in (images, posed.own.maps)], -1))

    def losses(
        self, rendering: Rendering, batch: Batch, posed: Posed, mode: Mode, generator: torch.Generator
    ) -> dict[str, Float[Tensor, ""]]:
        """See `Avatar.losses`: HumanNeRF's, and the consistency of both deformations."""
        terms, extras = super().losses(rendering, batch, posed, mode, generator), rendering.extras
        if self.config.consistency:
            term = rendering.color.sum() * 0
            if extras:
                term = deformation_consistency(extras["observed"], extras["returned"], extras["likelihood"])
            terms["consistency"] = self.config.consistency * term
        return terms


def monohuman() -> Recipe:
    """The authors' program for ZJU-MoCap. Days on a GPU, years on a CPU."""
    return Recipe(
        name="monohuman",
        method=MonoHumanConfig(),
        training=TrainingConfig(
            steps=400_000,
            images_per_step=1,
            pixels=PixelConfig(
                rays=0, patches=12, patch_size=16, patch_on_subject=0.9, reachable="box", subject="any"
            ),
            milestones=(),
            decay=0.1**0.8,
            decay_from=0.0,
            clip=0.0,
            checkpoint_every=2500,
            preview_every=5000,
        ),
    )  # fmt: skip


def monohuman_fast() -> Recipe:
    """The same equations within reach of two cores: only likely samples, fewer of them, shortened schedules."""
    start = monohuman()
    skeletal = affordable(start.method.skeletal)
    rates = SkeletalRates(networks=1e-3, volume=1e-4, motion=1e-4, pose=5e-5)
    # Beside squared differences alone the authors' weight would leave the images no say in volume and motions: some
    # samples in a thousand, where limbs meet, give a gradient a hundred times theirs.
    method = replace(start.method, skeletal=skeletal, rates=rates, features_every=8, consistency=0.01)
    pixels = PixelConfig(
        rays=192, subject_share=0.9, surroundings=8, patches=1, patch_size=16, patch_on_subject=0.9,
        reachable="body", subject="half",
    )  # fmt: skip
    training = replace(
        start.training, steps=1500, pixels=pixels, warmup=50, decay=0.03, decay_from=0.1, checkpoint_every=250,
        preview_every=500,
    )  # fmt: skip
    return replace(start, name="monohuman_fast", method=method, training=training)


RECIPES: dict[str, Callable[[], Recipe]] = {"monohuman": monohuman, "monohuman_fast": monohuman_fast}
"""What `--recipe` offers."""
