"""Recipes of Vid2Avatar: with a background field, and with masks in its place."""

from collections.abc import Callable
from dataclasses import replace

from twofold.field.implicit_geometry import ImplicitFieldConfig
from twofold.field.inverted_sphere import InvertedSphereFieldConfig
from twofold.field.prefit import PrefitConfig
from twofold.losses import LossConfig
from twofold.methods.pose_schedule import PoseConfig
from twofold.methods.vid2avatar import NO_SEPARATION, SeparationConfig, Vid2AvatarConfig, Vid2AvatarRates
from twofold.recipe import PixelConfig, Recipe, TrainingConfig
from twofold.sampling.error_bounded import ErrorBoundedSampler
from twofold.sampling.shell_sampler import ShellSampler


def vid2avatar() -> Recipe:
    """The authors' program: person and background are learned together, without masks. Days on a CPU."""
    return Recipe(
        name="vid2avatar",
        method=Vid2AvatarConfig(
            field=ImplicitFieldConfig(gradients="autograd"),
            sampler=ErrorBoundedSampler(ends="ray", units="scene", box="rays"),
            losses=LossConfig(
                common=0.0, lpips=0.0, mask=0.0, s3im=0.0, eikonal_points=512, eikonal_replacement=False
            ),
            pose=PoseConfig(
                zero_until=0, zero_epochs=20, zero_every=20, epochs="training", canonical_shape="given",
                test_shape="refined",
            ),
            falloff="scene",
            normals_by="canonical",
            beta=0.1001,
            beta_form="absolute",
            scene_scale="released",
            center="body",
            prefit=PrefitConfig(steps=3000),
        ),
        training=TrainingConfig(
            images_per_step=1,
            pixels=PixelConfig(
                rays=512, subject_share=0.9, patches=0, reachable="image", subject="any", between=True
            ),
            milestones=(200, 500),
            epochs="steps",
            clip=0.0,
        ),
    )  # fmt: skip


def vid2avatar_mask() -> Recipe:
    """The same person in front of the capture's colour, with the masks as truth: what the paper compares with."""
    start = vid2avatar()
    method = replace(
        start.method,
        scene=None,
        separation=NO_SEPARATION,
        sampler=ErrorBoundedSampler(ends="released", units="scene", box="given"),
        losses=replace(start.method.losses, mask=0.1, mask_form="hard"),
    )
    pixels = replace(start.training.pixels, reachable="box", between=False, replacement=False)
    training = replace(start.training, images_per_step=2, pixels=pixels)
    return replace(start, name="vid2avatar_mask", method=method, training=training)


def vid2avatar_fast() -> Recipe:
    """`vid2avatar` with what makes it affordable and changes no equation, and a short schedule."""
    recipe = _faster(vid2avatar())
    # The weights of separation move on four epochs in one, so that they end where the long training does. In a short
    # training the field that explains a pixel first keeps it. The background has to learn faster than the person grows,
    # or the person becomes as wide as samples are placed; opacity inside the body has to count for more, or legs that
    # hardly move become background, and not for much more, or thin chords of the outline make the person grow. A
    # density that sharpens at once would freeze what is there, since no sample but the first one would have a gradient.
    separation = SeparationConfig(pace=4.0, in_shape=4.0)
    scene = InvertedSphereFieldConfig(hidden_dtype="auto")
    rates = Vid2AvatarRates(scene=2e-3, beta=3e-5)
    method = replace(recipe.method, center="world", scene=scene, separation=separation, beta=0.008, rates=rates)
    return replace(recipe, name="vid2avatar_fast", method=method, training=replace(recipe.training, steps=1500))


def vid2avatar_mask_fast() -> Recipe:
    """`vid2avatar_mask` with what makes it affordable and changes no equation, and shorter schedules."""
    recipe = _faster(vid2avatar_mask())
    losses = replace(recipe.method.losses, mask_form="sides")
    pixels = replace(recipe.training.pixels, reachable="body")
    training = replace(recipe.training, images_per_step=1, pixels=pixels)
    return replace(recipe, name="vid2avatar_mask_fast", method=replace(recipe.method, losses=losses), training=training)


def _faster(recipe: Recipe) -> Recipe:
    """Samples near the body alone, of these the visible ones; gradients written out; everything in metres."""
    start = recipe.method
    method = replace(
        start,
        field=replace(start.field, gradients="analytic", hidden_dtype="auto"),
        sampler=ShellSampler(radius=0.08, step=0.01, min_weight=2e-3),
        losses=replace(start.losses, eikonal_replacement=True),
        pose=replace(start.pose, zero_epochs=5, canonical_shape="refined", observed_only=True),
        falloff="exponential",
        normals_by="posed",
        beta=0.02,
        beta_form="softplus",
        scene_scale="metres",
        prefit=PrefitConfig(steps=400, learning_rate=2e-3, points=384, pool=20_000),
    )
    pixels = replace(recipe.training.pixels, rays=384, subject="half", replacement=True)
    training = replace(
        recipe.training, steps=1500, pixels=pixels, milestones=(), decay=0.03, decay_from=0.1, epochs="images",
        checkpoint_every=250,
    )  # fmt: skip
    return replace(recipe, method=method, training=training)


RECIPES: dict[str, Callable[[], Recipe]] = {
    "vid2avatar": vid2avatar,
    "vid2avatar_mask": vid2avatar_mask,
    "vid2avatar_fast": vid2avatar_fast,
    "vid2avatar_mask_fast": vid2avatar_mask_fast,
}
"""What `--recipe` offers of this method."""
