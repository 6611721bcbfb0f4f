"""Recipes: one plain function for each way to train, and the paper's ablations as changes of these."""

import re
from collections.abc import Callable
from dataclasses import replace

from twofold.field.factorized import FactorizedFieldConfig
from twofold.field.factorized_grid import GridFieldConfig
from twofold.losses import LossConfig
from twofold.methods.factorized import FactorizedConfig, PoseConfig
from twofold.methods.placing import ShellSampler
from twofold.recipe import PixelConfig, Recipe, TrainingConfig
from twofold.sampling.error_bounded import ErrorBoundedSampler


def released() -> Recipe:
    """The authors' program: every number of their release. Days on a CPU, hours on a GPU."""
    return Recipe(
        name="released",
        method=FactorizedConfig(
            field=FactorizedFieldConfig(),
            sampler=ErrorBoundedSampler(),
            losses=LossConfig(),
            pose=PoseConfig(),
            beta_form="absolute",
            outliers_in_shading=False,
            scene_scale="released",
        ),
        training=TrainingConfig(),
    )


def paper() -> Recipe:
    """The text of the paper, to the letter where it says something; the release's numbers where it is silent."""
    start = released()
    field = FactorizedFieldConfig(
        include_pi=True, gate_width=None, base_color="linear", sdf_head="linear", color_sees_position=False,
        normals="canonical", pose_code=None, feature_code=None,
    )  # fmt: skip
    method = replace(
        start.method,
        field=field,
        losses=replace(start.method.losses, mask=0.0, s3im=0.0, lpips_start=0, reduction="sum"),
        pose=replace(start.method.pose, divide_by_pi=False, with_root=True, zero_until=0, zero_every=0),
        beta_form="softplus",
        outliers_in_shading=True,
        scene_scale="metres",
    )
    rate = 5e-4
    training = replace(
        start.training, rate_low=rate, rate_high=rate, rate_beta=rate, rate_pose=rate, adam_betas=(0.9, 0.99)
    )
    return replace(start, name="paper", method=method, training=training)


def fast() -> Recipe:
    """The released networks and losses with what makes them fast and changes no equation: shell sampling, bfloat16."""
    start = released()
    method = replace(
        start.method,
        field=replace(start.method.field, hidden_dtype="auto"),
        sampler=ShellSampler(),
        beta_form="softplus",
        outliers_in_shading=True,
        scene_scale="metres",
    )
    return replace(start, name="fast", method=method)


def quick() -> Recipe:
    """The same two branches on feature grids: minutes on a laptop's CPU. The default."""
    return Recipe(
        name="quick",
        method=FactorizedConfig(
            field=GridFieldConfig(),
            sampler=ShellSampler(radius=0.06, step=0.01, least_weight=2e-3, stray=0.006),
            losses=LossConfig(
                eikonal=0.05, mask=0.3, mask_form="mean", s3im=0.0, lpips=0.0, common=0.5, eikonal_points=512
            ),
            pose=PoseConfig(zero_until=200, zero_every=0, drop=0.2, refine_from=200),
            neighbours=6,
            falloff="smooth",
            beta=0.01,
            beta_floor=1.5e-3,
            shell_refresh=400,
        ),
        training=TrainingConfig(
            steps=4000,
            images_per_step=1,
            pixels=PixelConfig(rays=1024, subject_share=0.95, surroundings=6, patches=0),
            rate_low=2e-3,
            rate_high=2e-3,
            rate_grid=1e-2,
            rate_beta=3e-4,
            rate_pose=5e-4,
            milestones=(),
            warmup=30,
            decay=0.1,
            adam_betas=(0.9, 0.99),
            adam_epsilon=1e-15,
            clip=0.0,
            checkpoint_every=250,
            preview_every=500,
        ),
    )


RECIPES: dict[str, Callable[[], Recipe]] = {"quick": quick, "fast": fast, "released": released, "paper": paper}
"""What `--recipe` offers."""

ABLATIONS: dict[str, dict[str, object]] = {
    "wo_s1c1": {"branches": "high"},
    "wo_s2c2": {"branches": "low"},
    "wo_common_loss": {},
    "wo_feat": {"share_features": False},
    "pose_lf": {"pose_into": "low"},
    "wo_comm": {"branches": "high_rendered"},
}
"""The paper's ablations by what they change in the field; see `ablation`."""


def ablation(name: str, start: Recipe) -> Recipe:
    """One of the paper's ablations of a recipe: a name of `ABLATIONS`, or "[a]" or "[x,y]" for other frequency bands.

    Raises:
        ValueError: there is no such ablation, or the recipe's field has no octaves to change.
    """
    losses, field = start.method.losses, start.method.field
    bands = [int(band) for band in re.findall(r"\d+", name)] if re.fullmatch(r"\[\d+(, ?\d+)?\]", name) else []
    if bands and isinstance(field, FactorizedFieldConfig):
        if len(bands) == 1:
            field = replace(field, branches="high", high_octaves=bands[0])
        else:
            field = replace(field, low_octaves=bands[0], high_octaves=bands[1])
    elif name in ABLATIONS:
        field = replace(field, **ABLATIONS[name])  # type: ignore[arg-type]
    else:
        raise ValueError(f"no ablation {name!r} of {start.name}; there are {', '.join(ABLATIONS)}, [a] and [x,y]")
    if name in ("wo_s1c1", "wo_s2c2", "wo_common_loss", "wo_comm") or field.branches != "both":
        losses = replace(losses, common=0.0)
    return replace(start, name=f"{start.name} {name}", method=replace(start.method, field=field, losses=losses))
