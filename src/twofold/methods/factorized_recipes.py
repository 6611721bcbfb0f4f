"""Recipes: one plain function for each way to train, and the paper's ablations as changes of these."""

import re
from collections.abc import Callable
from dataclasses import replace

from twofold.field.factorized import FactorizedFieldConfig
from twofold.field.factorized_grid import GridFieldConfig
from twofold.losses import LossConfig
from twofold.methods.factorized import FactorizedConfig
from twofold.methods.factorized_config import RateConfig
from twofold.methods.pose_schedule import PoseConfig
from twofold.methods.skinned_config import COMPLETING
from twofold.recipe import PixelConfig, Recipe, TrainingConfig
from twofold.sampling.error_bounded import ErrorBoundedSampler
from twofold.sampling.shell_sampler import ShellSampler


def released() -> Recipe:
    """The authors' program: every number of their release, and its habits. Days on a CPU, hours on a GPU."""
    return Recipe(
        name="released",
        method=FactorizedConfig(
            field=FactorizedFieldConfig(),
            sampler=ErrorBoundedSampler(ends="released", units="scene", box="given"),
            losses=LossConfig(
                lpips_start=20_001,
                lpips_dropout=0.5,
                lpips_off_box="picture",
                mask_form="hard",
                s3im_center=2.0,
                eikonal_replacement=False,
            ),
            pose=PoseConfig(epochs="training", canonical_shape="given", test_shape="given"),
            late_neighbours=7,
            falloff="scene",
            normals_by="canonical",
            beta=0.1001,
            beta_form="absolute",
            outliers_in_shading=False,
            scene_scale="released",
        ),
        training=TrainingConfig(pixels=PixelConfig(reachable="box", subject="any", replacement=False), epochs="steps"),
    )


def paper() -> Recipe:
    """The text of the paper, to the letter where it says something; the release's choices where it is silent."""
    start = released()
    field = FactorizedFieldConfig(
        include_pi=True,
        gate_width=None,
        base_color="linear",
        color_sees_position=False,
        normals="canonical",
        pose_code=None,
        feature_code=None,
    )
    # The text sums colour differences over rays and channels. The release's weights belong to means, so the terms that
    # are no sums are weighted by as many as a step's rays have channels.
    pixels = start.training.pixels
    summed = 3 * (pixels.rays + pixels.patches * pixels.patch_size**2)
    weights = start.method.losses
    losses = replace(
        weights, mask=0.0, s3im=0.0, reduction="sum", eikonal=summed * weights.eikonal, lpips=summed * weights.lpips
    )
    pose = replace(start.method.pose, divide_by_pi=False, with_root=True, zero_until=0, zero_every=0)
    rates = RateConfig(low=5e-4, high=5e-4, beta=5e-4, pose=5e-4)
    method = replace(start.method, field=field, losses=losses, pose=pose, rates=rates)
    training = replace(start.training, adam_betas=(0.9, 0.99))
    return replace(start, name="paper", method=method, training=training)


def fast() -> Recipe:
    """The released networks and losses with what makes them fast and changes no equation: shell sampling, bfloat16.

    What the release does otherwise than it could is left out, each by its option: masks count by their parts; normals
    turn by the inverse of what moved the sample; a corrected shape moves canonical space along, in tests too; nothing
    but learning rates and the pose changes at an epoch; all is in metres.
    """
    start = released()
    losses = replace(
        start.method.losses,
        lpips_start=20_000,
        lpips_dropout=0.0,
        lpips_off_box="black",
        mask_form="sides",
        s3im_center=1.5,
        eikonal_replacement=True,
    )
    method = replace(
        start.method,
        field=replace(start.method.field, hidden_dtype="auto"),
        sampler=ShellSampler(),
        losses=losses,
        pose=replace(
            start.method.pose, epochs="moments", canonical_shape="refined", test_shape="refined", observed_only=True
        ),
        late_neighbours=None,
        falloff="exponential",
        normals_by="posed",
        beta=0.1,
        beta_form="softplus",
        outliers_in_shading=True,
        scene_scale="metres",
    )
    pixels = replace(start.training.pixels, reachable="body", subject="half", replacement=True)
    return replace(start, name="fast", method=method, training=replace(start.training, pixels=pixels, epochs="images"))


def quick() -> Recipe:
    """The same two branches on feature grids: minutes on a laptop's CPU. The default."""
    return Recipe(
        name="quick",
        method=FactorizedConfig(
            field=GridFieldConfig(follow_images=True),
            sampler=ShellSampler(
                radius=0.06, step=0.01, min_weight=2e-3, miswarp_slack=0.006, finest=0.0025, training_grid_every=50
            ),
            losses=LossConfig(
                eikonal=0.05,
                mask=0.3,
                base_mask=0.3,
                mask_form="mean",
                s3im=0.3,
                lpips=0.0,
                common=0.5,
                eikonal_points=512,
                eikonal_replacement=True,
            ),
            rates=RateConfig(low=2e-3, high=2e-3, grid=1e-2, beta=3e-4, pose=3e-3),
            pose=PoseConfig(
                zero_until=200,
                zero_every=0,
                drop=0.2,
                refine_from=200,
                averages="visits",
                shrinkage=1.5,
                canonical_shape="refined",
                test_shape="refined",
                observed_only=True,
            ),
            neighbours=6,
            late_neighbours=None,
            falloff="smooth",
            normals_by="posed",
            beta=0.01,
            beta_floor=1.5e-3,
            beta_form="softplus",
            outliers_in_shading=True,
            scene_scale="metres",
            shell_refresh=400,
            completion=COMPLETING,
        ),
        training=TrainingConfig(
            steps=4000,
            images_per_step=1,
            pixels=PixelConfig(
                rays=1024,
                subject_share=0.95,
                surroundings=6,
                patches=0,
                reachable="body",
                subject="half",
                replacement=True,
            ),
            milestones=(),
            epochs="images",
            warmup=30,
            decay=0.1,
            adam_betas=(0.9, 0.99),
            adam_epsilon=1e-15,
            clip=0.0,
            checkpoint_every=250,
            preview_every=500,
        ),
    )


def demo_recipe(seed: int) -> Recipe:
    """`quick` with as many steps as two minutes of two cores hold."""
    recipe = quick()
    # With few images and exact poses, slower rates show unseen views better.
    rates = replace(recipe.method.rates, grid=5e-3, low=1e-3, high=1e-3)
    training = replace(recipe.training, steps=900, checkpoint_every=300, preview_every=0)
    # The studio's poses are exact; there is nothing to correct.
    method = replace(recipe.method, pose=replace(recipe.method.pose, refine=()), rates=rates)
    return replace(recipe, name="demo", method=method, training=training, seed=seed)


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


BEYOND: dict[str, dict[str, object]] = {"part_bands": {"detail_voxels": (0.03, 0.015)}}
"""Variants that the paper does not have, by what they change in a field on feature grids.

"part_bands": the pose-independent branch, which ends at 6 cm elsewhere, holds details of face, hands and shoes.
"""


def has_grids(recipe: Recipe) -> bool:
    """Whether the branches are feature grids, whose frequencies are voxel sizes, and not networks."""
    return not isinstance(recipe.method.field, FactorizedFieldConfig)


def ablation(name: str, start: Recipe) -> Recipe:
    """One of the paper's ablations of a recipe.

    Args:
        name: one of `ABLATIONS` or `BEYOND`; or other frequencies. "[a]" is the pose-dependent branch alone and
            "[x,y]" are both branches: of networks a number is the octaves of the encoding ("[5,10]"), of feature grids
            the finest spacing ("[6cm,1cm]"), above which lies one level of twice that.
        start: the recipe of the full model.

    Raises:
        ValueError: there is no such ablation, or it is named as, or exists only for, the other kind of field.
    """
    losses, field = start.method.losses, start.method.field
    known = ABLATIONS | BEYOND
    if name in BEYOND and not has_grids(start):
        raise ValueError(f"{name!r} exists for feature grids only; {start.name} has networks")
    changes: dict[str, object] = dict(known.get(name, {}))
    unit = "" if isinstance(field, FactorizedFieldConfig) else "cm"
    if re.fullmatch(rf"\[[\d.]+{unit}(, ?[\d.]+{unit})?\]", name):
        frequencies = [float(number) for number in re.findall(r"[\d.]+", name)]
        changes = {"branches": "high"} if len(frequencies) == 1 else {}
        if unit:
            changes["follow_images"] = False
        for branch, frequency in zip(("high", "low"), frequencies[::-1], strict=False):
            if unit:
                changes[f"{branch}_voxels"] = (0.02 * frequency, 0.01 * frequency)
            else:
                changes[f"{branch}_octaves"] = int(frequency)
    elif name not in known:
        bands = "[a] and [x,y] in octaves" if not unit else "[a] and [x,y] in centimetres, such as [6cm,1cm]"
        raise ValueError(f"no ablation {name!r} of {start.name}; there are {', '.join(known)}, {bands}")
    field = replace(field, **changes)
    if name in ("wo_s1c1", "wo_s2c2", "wo_common_loss", "wo_comm") or field.branches != "both":
        losses = replace(losses, common=0.0)
    return replace(start, name=f"{start.name} {name}", method=replace(start.method, field=field, losses=losses))
