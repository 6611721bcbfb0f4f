"""A small density-based method without a body shell, pose refinement or base branch; tests add it to the table."""

from dataclasses import dataclass

import pytest
import torch
from torch import nn

from twofold.body.skeleton import pose_body, shape_body
from twofold.config import require_within
from twofold.field.encoding import fourier_encoding
from twofold.geometry.cameras import clip_to_box
from twofold.losses import mask, reconstruction
from twofold.methods import table
from twofold.methods.base import EVALUATION, Avatar, MethodConfig, PosedAvatar, Rendering
from twofold.methods.parameter_group import ParameterGroup
from twofold.methods.table import Method
from twofold.recipe import PixelConfig, Recipe, TrainingConfig
from twofold.sampling.error_bounded import uniform_depths
from twofold.sampling.joint_box import joint_box
from twofold.volume.nerf_compositing import open_density_weights, open_samples
from twofold.volume.rendering import composite

OCTAVES = 4


@dataclass(frozen=True)
class CloudConfig(MethodConfig):
    """Density and colour in the axes of the pelvis."""

    width: int = 32
    samples: int = 48
    rate: float = 5e-3
    surface: float = 1.0
    """Density of the surface, per metre."""

    def __post_init__(self):
        require_within(self, width=(1, 1024), samples=(2, 1024), rate=(0, 1), surface=(0, 1e6))

    def scaled(self, factor):
        return self

    def build(self, subject, seed=0):
        return CloudAvatar(self, subject, seed)


class CloudAvatar(Avatar[None]):
    def __init__(self, config, subject, seed):
        super().__init__()
        self.config, self.subject = config, subject
        torch.manual_seed(seed)
        self.network = nn.Sequential(
            nn.Linear(3 * (2 * OCTAVES + 1), config.width), nn.ReLU(),
            nn.Linear(config.width, config.width), nn.ReLU(), nn.Linear(config.width, 4),
        )  # fmt: skip

    def pose(self, pose, translation, frame_index=None, mode=EVALUATION):
        shaped = shape_body(self.subject.body, self.subject.betas)
        return PosedAvatar(pose_body(shaped, pose, translation), None)

    def _answer(self, x, posed):
        bone = posed.body.bones[0]
        local = (x - bone[:3, 3]) @ bone[:3, :3]
        out = self.network(fourier_encoding(local, OCTAVES, include_pi=False))
        near = (posed.body.joints[None] - x[:, None]).norm(dim=-1).amin(1) < 0.3
        return nn.functional.softplus(out[:, 0] + 2) * near, out[:, 1:].sigmoid()

    def render(self, rays, posed, background, mode=EVALUATION, generator=None):
        low, high = joint_box(posed.body.joints)
        clipped, hit = clip_to_box(rays, low, high)
        inside = hit.nonzero()[:, 0]
        zero = 0 * next(self.parameters()).sum() + torch.zeros(len(rays))
        behind = background.expand(len(rays), 3)
        if len(inside) == 0:
            return Rendering(behind + zero[:, None], zero, zero, zero[:, None].expand(-1, 3))
        samples = open_samples(uniform_depths(clipped[inside], self.config.samples, generator), last=0.05)
        density, color = self._answer(samples.points(clipped[inside]), posed)
        weights = open_density_weights(density, samples.delta, samples.ray_index)
        values = torch.cat([color, torch.ones(len(color), 1), samples.depth[:, None]], 1)
        out = torch.zeros(len(rays), 5).index_add(0, inside, composite(weights, values, samples, len(inside)))
        opacity = out[:, 3]
        return Rendering(out[:, :3] + (1 - opacity)[:, None] * behind, opacity, out[:, 4], zero[:, None].expand(-1, 3))

    @property
    def level_space(self):
        return "posed"

    def level(self, x, posed, branch="full"):
        density, _ = self._answer(x, posed)
        return 0.02 * (1 - density / self.config.surface).clamp(-1, 1)

    def losses(self, rendering, batch, posed, mode, generator):
        return {
            "reconstruction": reconstruction(rendering.color, batch.color),
            "mask": mask(rendering.opacity, batch.mask, "mean"),
        }

    def parameter_groups(self):
        return [ParameterGroup("network", self.config.rate, list(self.network.parameters()))]


def cloud():
    training = TrainingConfig(
        steps=60, images_per_step=1, pixels=PixelConfig(rays=128, subject_share=0.9, patches=0), milestones=(),
        checkpoint_every=20, preview_every=0,
    )  # fmt: skip
    return Recipe("cloud", CloudConfig(), training)


def add_to_table(monkeypatch: pytest.MonkeyPatch) -> None:
    """The line that a new method needs."""
    monkeypatch.setitem(table.METHODS, "cloud", Method(CloudConfig, {"cloud": cloud}))
    monkeypatch.setitem(table.RECIPES, "cloud", cloud)
