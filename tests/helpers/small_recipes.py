"""Every recipe and every ablation, shrunk until a step takes milliseconds."""

from dataclasses import replace

from tiny_person import tiny_recipe

from twofold.field.factorized import FactorizedFieldConfig
from twofold.field.prefit import PrefitConfig
from twofold.methods.factorized_recipes import ABLATIONS, ablation
from twofold.methods.table import RECIPES
from twofold.methods.vid2avatar import Vid2AvatarConfig
from twofold.recipe import Recipe
from twofold.sampling.error_bounded import ErrorBoundedSampler
from twofold.sampling.shell_sampler import ShellSampler

LATE = 20_006
"""A step at which every schedule has begun and, of five frames, no zero pose is shown."""


def shrunk(recipe: Recipe) -> Recipe:
    """The same switches with smaller networks and fewer samples."""
    if recipe.name.startswith("quick"):
        return replace(tiny_recipe(), name=recipe.name)
    method = recipe.method
    if hasattr(method, "boxed"):
        return shrunk_boxed(recipe)
    if isinstance(method, Vid2AvatarConfig):
        return shrunk_vid2avatar(recipe, method)
    if hasattr(method, "skeletal"):
        return shrunk_skeletal(recipe)
    assert isinstance(method.field, FactorizedFieldConfig)
    # In float32, so that tolerances hold whatever the hardware is good at; `field` tests the other types.
    field = replace(method.field, width=72, high_sdf_depth=4, high_color_depth=2, hidden_dtype="float32")
    sampler = shrunk_sampler(method.sampler)
    losses = replace(method.losses, eikonal_points=32)
    pixels = replace(recipe.training.pixels, rays=64, patches=1, patch_size=16)
    method = replace(method, field=field, sampler=sampler, losses=losses)
    return replace(recipe, method=method, training=replace(recipe.training, pixels=pixels))


def shrunk_boxed(recipe: Recipe) -> Recipe:
    """PM-Avatar, DANBO and NPC with few samples; their networks are the whole ones."""
    # Not 12: between twelve samples of boxes enlarged by 1.1 some middles lie exactly on the faces, where rounding
    # decides whether they are inside.
    few = {"coarse": 13, "fine": 6, "hidden_dtype": "float32"}
    method = replace(recipe.method, boxed=replace(recipe.method.boxed, **few))
    if hasattr(method, "first"):
        method = replace(
            method, first=replace(method.first, **few), points=8, point_voxel=0.03, first_steps=3, first_rays=64
        )
    pixels = replace(recipe.training.pixels, rays=64)
    return replace(recipe, method=method, training=replace(recipe.training, pixels=pixels))


def shrunk_sampler(sampler: ErrorBoundedSampler | ShellSampler) -> ErrorBoundedSampler | ShellSampler:
    if isinstance(sampler, ErrorBoundedSampler):
        return replace(sampler, refined=24, shaded=12, extra=6, rounds=2)
    return replace(sampler, step=0.02, voxel=0.03)


def shrunk_vid2avatar(recipe: Recipe, method: Vid2AvatarConfig) -> Recipe:
    field = replace(method.field, width=56, sdf_depth=4, color_depth=2, skip_layer=2, hidden_dtype="float32")
    scene = method.scene and replace(
        method.scene, width=120, depth=3, skip_layer=2, color_width=16, code_size=4, hidden_dtype="float32"
    )
    method = replace(
        method,
        field=field,
        scene=scene,
        scene_samples=6,
        sampler=shrunk_sampler(method.sampler),
        losses=replace(method.losses, eikonal_points=32),
        separation=replace(method.separation, surface_cells=32),
        prefit=PrefitConfig(steps=5, points=32, pool=64),
    )
    pixels = replace(recipe.training.pixels, rays=64)
    return replace(recipe, method=method, training=replace(recipe.training, pixels=pixels))


def shrunk_skeletal(recipe: Recipe) -> Recipe:
    """HumanNeRF and MonoHuman with a small weight volume and few samples."""
    changed = {"samples": 32, "volume_channels": (16, 16, 16, 8), "volume_code": 8, "hidden_dtype": "float32"}
    changed |= {"volume_every": min(recipe.method.skeletal.volume_every, 2), "guard_frames": 2, "guard_size": 16}
    method = replace(recipe.method, skeletal=replace(recipe.method.skeletal, **changed))
    if hasattr(method, "features_every"):
        method = replace(method, features_every=min(method.features_every, 2))
    pixels = replace(recipe.training.pixels, rays=min(recipe.training.pixels.rays, 64), patches=1, patch_size=16)
    return replace(recipe, method=method, training=replace(recipe.training, pixels=pixels))


CASES: dict[str, Recipe] = {name: shrunk(recipe()) for name, recipe in RECIPES.items()}
for start in ("quick", "fast"):
    CASES |= {f"{start} {name}": ablation(name, CASES[start]) for name in ABLATIONS}
CASES |= {f"fast {name}": ablation(name, CASES["fast"]) for name in ("[8]", "[6,8]")}
