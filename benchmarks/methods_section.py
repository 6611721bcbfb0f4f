"""Tables of the methods for the documentation: how they did side by side, and the schedules of their fast recipes."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import Any

from twofold.methods.table import METHODS, learning_rates, recipe_to_dict, with_steps
from twofold.recipe import Recipe

Table = Callable[[Sequence[str], Iterable[Sequence[str]]], str]

SHARED = ("training.steps", "training.warmup", "training.milestones")
IDLE = ("method.losses.lpips_start", "method.late_from", "method.completion.start", "method.completion.every")
"""Timed settings of parts that these recipes do not have."""


def side_by_side(result: dict[str, Any], table: Table) -> str:
    """A line for each run of a stored comparison, and how it was made."""
    splits = [split for split in ("novel_view", "novel_pose") if split in result["rows"][0]]
    titles = {"novel_view": "Novel view: box PSNR, SSIM, IoU", "novel_pose": "Novel pose: box PSNR, SSIM, IoU"}
    changed = [row for row in result["rows"] if row["settings"]]
    marks = {id(row): f" ({number + 1})" for number, row in enumerate(changed)}
    rows = [
        (
            f"`{row['recipe']}`{marks.get(id(row), '')}", _steps(row),
            f"{row['cost']['training_processor_seconds']:.0f}",
            *(
                f"{row[split]['psnr_box']:.1f} dB, {row[split]['ssim_box']:.3f}, {row[split]['silhouette_iou']:.3f}"
                for split in splits
            ),
            f"{row['cost']['frame_processor_seconds']:.1f}", f"{row['cost']['parameters']:,}",
        )
        for row in result["rows"]
    ]  # fmt: skip
    head = (
        "Recipe",
        "Steps",
        "Processor, s",
        *(titles[s] for s in splits),
        "An image, processor s",
        "Parameters stored",
    )
    note = f"{result['capture']}. {result['frames'][:1].upper()}{result['frames'][1:]}."
    if changed:
        settings = "; ".join(
            f"{marks[id(row)].strip()} {', '.join(f'`{s}`' for s in row['settings'])}" for row in changed
        )
        note += f" Trained with other settings than the recipe has now: {settings}."
    return f"{table(head, rows)}\n{note}\n"


def schedules(table: Table) -> str:
    """Steps, rays, rates and what begins when, of each fast recipe beside the steps of its authors' program."""
    rows = []
    for method in METHODS.values():
        for name, make in method.recipes.items():
            if name.endswith("_fast"):
                rows.append(_schedule(make(), method.recipes[name.removesuffix("_fast")]()))
    head = ("Recipe", "Steps, authors'", "Steps", "Rays", "Rates", "Rates fall", "Begins or changes at step")
    return table(head, rows)


def _schedule(recipe: Recipe, start: Recipe) -> tuple[str, ...]:
    training = recipe.training
    pixels = training.pixels
    patches = f" + {pixels.patches} x {pixels.patch_size}²" if pixels.patches else ""
    rates = ", ".join(f"{name.rpartition('.')[2]} {rate:g}" for name, rate in learning_rates(recipe).items() if rate)
    fall = f"to {100 * training.decay:g} % from {100 * training.decay_from:g} % of the steps on"
    if training.warmup:
        fall = f"{training.warmup} steps of warm-up; {fall}"
    return (
        f"`{recipe.name}`", f"{start.method.total_steps(start.training):,}", _stages(recipe), f"{pixels.rays}{patches}",
        rates, fall, _timed(recipe) or "nothing",
    )  # fmt: skip


def _timed(recipe: Recipe) -> str:
    """The method's own settings that `--steps` scales, in steps or epochs."""
    total = recipe.method.total_steps(recipe.training)
    own, double = (_flat(recipe_to_dict(r)["method"]) for r in (recipe, with_steps(recipe, 2 * total)))
    parts = [
        f"{key.rpartition('.')[2]} {', '.join(map(str, value)) if isinstance(value, list) else value}"
        for key, value in own.items()
        if double[key] != value and f"method.{key}" not in (*SHARED, *IDLE) and _applies(recipe, key)
    ]
    return ", ".join(f"`{part.partition(' ')[0]}` {part.partition(' ')[2]}" for part in parts)


def _applies(recipe: Recipe, key: str) -> bool:
    """Whether changing a setting can change the training: separation has no schedule where its weights are zero."""
    separation = getattr(recipe.method, "separation", None)
    return not (key.startswith("separation.") and separation is not None and not separation.needs_surface)


def _stages(recipe: Recipe) -> str:
    total = recipe.method.total_steps(recipe.training)
    own = recipe.training.steps
    return f"{total:,}" if total == own else f"{total - own:,} and {own:,}"


def _steps(row: dict[str, Any]) -> str:
    second = row.get("second_stage")
    return f"{row['steps']:,}" if second is None else f"{row['steps'] - second:,} and {second:,}"


def _flat(data: dict[str, Any], above: str = "") -> dict[str, Any]:
    flat: dict[str, Any] = {}
    for name, value in data.items():
        flat |= _flat(value, f"{above}{name}.") if isinstance(value, dict) else {above + name: value}
    return flat
