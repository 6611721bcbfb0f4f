"""The paper's tables as experiments: which rows are trained how, and which metrics stand in the columns."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Literal

from twofold.errors import TwofoldError
from twofold.methods.factorized_recipes import ABLATIONS, BEYOND, ablation, demo_recipe, has_grids
from twofold.methods.table import RECIPES, with_settings, with_steps
from twofold.recipe import Recipe
from twofold.reproduce.cells import Cell
from twofold.reproduce.measuring import Measures
from twofold.reproduce.sources import Source

RecipeName = Literal["quick", "fast", "released"]


@dataclass(frozen=True)
class Column:
    """A metric of a table.

    Attributes:
        title: above it.
        section: of a cell's results.
        metric: in that section.
        digits: behind the point.
        better: whether higher or lower is better.
        printed: the paper's columns whose numbers stand in parentheses behind ours.
    """

    title: str
    section: str
    metric: str
    digits: int
    better: Literal["high", "low"]
    printed: tuple[str, ...] = ()


@dataclass(frozen=True)
class TableRow:
    """A way to train.

    Attributes:
        key: its name on the command line (`--methods`).
        label: its name in the table.
        printed: its name in the paper's table.
        recipe: how.
    """

    key: str
    label: str
    printed: str
    recipe: Callable[[], Recipe]


@dataclass(frozen=True)
class Experiment:
    """A table.

    Attributes:
        title: above it.
        columns: metrics.
        rows: from the recipe's name and whether the subjects are synthetic.
        by_subject: whether each subject has rows of its own; else they are averaged.
    """

    title: str
    columns: tuple[Column, ...]
    rows: Callable[[RecipeName, bool], list[TableRow]]
    by_subject: bool = False


@dataclass(frozen=True)
class PlannedCell:
    """A cell and where its results go: row, subject, seed."""

    row: TableRow
    subject: str
    seed: int
    cell: Cell


def base_recipe(name: RecipeName, synthetic: bool) -> Recipe:
    """The full model's recipe; synthetic subjects have the demo's settings for `quick`: 900 steps, exact poses.

    Frequencies are as they are named, whatever the images show.
    """
    recipe = demo_recipe(0) if name == "quick" and synthetic else RECIPES[name]()
    if has_grids(recipe):
        recipe = with_settings(recipe, ["method.field.follow_images=false"])
    return _silent(recipe)


def method_rows(name: RecipeName, synthetic: bool) -> list[TableRow]:
    """All methods of the paper: `released` recipes in their full form, else in the fast one."""
    ending = "" if name == "released" else "_fast"

    def baseline(recipe: str) -> Callable[[], Recipe]:
        return lambda: _silent(RECIPES[recipe + ending]())

    names = {
        "humannerf": ("HumanNeRF", "humannerf"), "monohuman": ("MonoHuman", "monohuman"), "npc": ("NPC", "npc"),
        "pm_avatar": ("PM-Avatar", "pm_avatar"), "vid2avatar": ("Vid2Avatar", "vid2avatar_mask"),
    }  # fmt: skip
    rows = [TableRow(key, label, label, baseline(recipe)) for key, (label, recipe) in names.items()]
    return [*rows, TableRow("factorized", "Ours", "Ours", lambda: base_recipe(name, synthetic))]


def mask_rows(name: RecipeName, synthetic: bool) -> list[TableRow]:
    """Vid2Avatar with its background field, and with masks."""
    ending = "" if name == "released" else "_fast"
    return [
        TableRow("vid2avatar", "V2A*", "V2A*", lambda: _silent(RECIPES[f"vid2avatar{ending}"]())),
        TableRow("vid2avatar_mask", "V2A_mask", "V2A_mask", lambda: _silent(RECIPES[f"vid2avatar_mask{ending}"]())),
    ]


ABLATION_LABELS = {
    "wo_s1c1": "w/o {s1, c1}", "wo_s2c2": "w/o {s2, c2}", "wo_common_loss": "w/o L_com", "wo_feat": "w/o feat",
    "pose_lf": "Pose_lf", "wo_comm": "w/o comm",
}  # fmt: skip
"""The paper's names. It shows "w/o comm" in a figure and has no numbers of it."""


def ablation_rows(name: RecipeName, synthetic: bool) -> list[TableRow]:
    """The six ablations and the full model."""

    def ablated(key: str) -> Callable[[], Recipe]:
        return lambda: ablation(key, base_recipe(name, synthetic))

    rows = [TableRow(key, ABLATION_LABELS[key], ABLATION_LABELS[key], ablated(key)) for key in ABLATIONS]
    return [*rows, TableRow("full", "Ours", "Ours", lambda: base_recipe(name, synthetic))]


BEYOND_LABELS = {"part_bands": "Bands by body part"}


def beyond_rows(name: RecipeName, synthetic: bool) -> list[TableRow]:
    """Variants that the paper leaves to others, and the full model.

    Raises:
        TwofoldError: the recipe has networks; the variants are changes of feature grids.
    """
    if not has_grids(base_recipe(name, synthetic)):
        raise TwofoldError(f"The table beyond needs feature grids: --recipe quick; {name} has networks.")

    def varied(key: str) -> Callable[[], Recipe]:
        return lambda: ablation(key, base_recipe(name, synthetic))

    rows = [TableRow(key, BEYOND_LABELS[key], BEYOND_LABELS[key], varied(key)) for key in BEYOND]
    return [*rows, TableRow("full", "Ours", "Ours", lambda: base_recipe(name, synthetic))]


FREQUENCIES = ((5,), (6,), (8,), (10,), (6, 6), (6, 8), (8, 8), (6, 10), (8, 10), (10, 10))
"""The paper's, in octaves: [a] is the pose-dependent branch alone."""
GRID_CM = {5: 6, 6: 4, 8: 2, 10: 1}
"""Finest spacing of a feature grid, cm, that stands for a number of octaves; see `docs/reproduce.md`."""


def frequency_rows(name: RecipeName, synthetic: bool) -> list[TableRow]:
    """The grid of frequencies; for feature grids `[x, y]` are the finest spacings of the two branches."""
    grids = has_grids(base_recipe(name, synthetic))

    def banded(key: str) -> Callable[[], Recipe]:
        return lambda: ablation(key, base_recipe(name, synthetic))

    rows: list[TableRow] = []
    for octaves in FREQUENCIES:
        printed = f"[{', '.join(map(str, octaves))}]"
        numbers = [f"{GRID_CM[band]}cm" if grids else str(band) for band in octaves]
        key = f"[{','.join(numbers)}]"
        label = key.replace("cm", " cm").replace(",", ", ")
        rows.append(TableRow(key, label, printed, banded(key)))
    label = "[6 cm, 1 cm] (full)" if grids else "[5, 10] (full)"
    return [*rows, TableRow("full", label, "[5, 10]", lambda: base_recipe(name, synthetic))]


def consistency_rows(name: RecipeName, synthetic: bool) -> list[TableRow]:
    """All methods but the full model, and the frequencies."""
    shown = {"[5]", "[6]", "[8]", "[10]", "[6, 10]", "[8, 10]", "[5, 10]"}
    others = [row for row in method_rows(name, synthetic) if row.key not in ("factorized", "pm_avatar")]
    return [*others, *(row for row in frequency_rows(name, synthetic) if row.printed in shown)]


def _image_columns(*metrics: str) -> tuple[Column, ...]:
    """For novel views, then novel poses: some of the paper's metrics, then two that need no network and no guess."""
    known = {
        "PSNR": ("paper_psnr", 2, "high"), "SSIM": ("paper_ssim", 3, "high"), "LPIPS": ("paper_lpips_x1000", 2, "low"),
        "KID": ("kid_x1000", 2, "low"), "box PSNR": ("psnr_box", 2, "high"),
        "gradient error": ("gradient_error", 3, "low"),
    }  # fmt: skip
    columns: list[Column] = []
    for part, section in (("view", "novel_view"), ("pose", "novel_pose")):
        for title in (*metrics, "box PSNR", "gradient error"):
            metric, digits, better = known[title]
            printed = (f"{part} {title}",) if title in metrics else ()
            columns.append(Column(f"{part} {title}", section, metric, digits, better, printed))  # type: ignore[arg-type]
    return tuple(columns)


_GEOMETRY = (
    Column("CD", "geometry", "chamfer_vertices_m2_x100", 4, "low", ("CD",)),
    Column("NC", "geometry", "normal_consistency", 3, "high", ("NC",)),
    Column("CD, cm", "geometry", "chamfer_cm", 2, "low"),
)

EXPERIMENTS: dict[str, Experiment] = {
    "main": Experiment(
        "Novel views and novel poses, mean of the subjects", _image_columns("PSNR", "SSIM", "LPIPS", "KID"), method_rows
    ),
    "subjects": Experiment(
        "Novel views and novel poses, by subject", _image_columns("PSNR", "SSIM", "LPIPS", "KID"), method_rows, True
    ),
    "wild": Experiment(
        "Videos in the wild (novel poses) and geometry",
        (
            Column("pose LPIPS", "novel_pose", "paper_lpips_x1000", 2, "low", ("Story LPIPS", "Invisible LPIPS")),
            Column("pose FID", "novel_pose", "fid", 2, "low", ("Story FID", "Invisible FID")),
            Column("pose box PSNR", "novel_pose", "psnr_box", 2, "high"),
            Column("pose gradient error", "novel_pose", "gradient_error", 3, "low"),
            *_GEOMETRY,
        ),
        method_rows,
    ),
    "ablation": Experiment(
        "Ablations", (*_image_columns("PSNR", "SSIM", "LPIPS"), replace(_GEOMETRY[2])), ablation_rows
    ),
    "frequency": Experiment("Frequencies of the two branches", _image_columns("PSNR", "SSIM", "LPIPS"), frequency_rows),
    "beyond": Experiment(
        "Beyond the paper: frequency bands that depend on the part of the body",
        (*_image_columns("PSNR", "SSIM", "LPIPS"), replace(_GEOMETRY[2])),
        beyond_rows,
    ),
    "consistency": Experiment(
        "Consistency of successive frames: Horn-Schunck flow",
        (
            Column("flow, pixels", "consistency", "flow_length_px", 3, "low", ("flow",)),
            Column("flow error, pixels", "consistency", "flow_error_px", 3, "low"),
            Column("flow error on the subject, pixels", "consistency", "flow_error_mask_px", 3, "low"),
        ),
        consistency_rows,
    ),
    "masks": Experiment(
        "Vid2Avatar without and with masks", _image_columns("PSNR", "SSIM", "LPIPS"), mask_rows, by_subject=True
    ),
}
"""By the name that `twofold reproduce` takes."""


def planned(
    experiment: str, sources: Sequence[Source], recipe: RecipeName, seeds: int, methods: Sequence[str] = (),
    settings: Sequence[str] = (), measures: Measures | None = None, synthetic: bool = True, steps: int | None = None,
) -> list[PlannedCell]:  # fmt: skip
    """All cells of a table, subject by subject and seed by seed, so that early cells already compare all rows.

    Args:
        experiment: one of `EXPERIMENTS`.
        sources: the subjects.
        recipe: which of the recipes.
        seeds: how many, from 0.
        methods: keys of rows; none for all.
        settings: changes of every recipe, such as "training.steps=300".
        measures: what is measured.
        synthetic: whether the subjects are synthetic.
        steps: of every training, all stages together, with its whole schedule scaled; None for each recipe's own.

    Raises:
        TwofoldError: an unknown row or setting.
    """
    rows = EXPERIMENTS[experiment].rows(recipe, synthetic)
    keys = [row.key for row in rows]
    unknown = [key for key in methods if key not in keys]
    if unknown:
        raise TwofoldError(f"--methods: the table {experiment} has no row {unknown[0]!r}; it has {', '.join(keys)}.")
    chosen = [row for row in rows if row.key in methods or not methods]

    def recipe_of(row: TableRow) -> Recipe:
        own = row.recipe()
        return with_settings(own if steps is None else with_steps(own, steps), settings)

    recipes = {row.key: recipe_of(row) for row in chosen}
    return [
        PlannedCell(row, source.name, seed, Cell(source, replace(recipes[row.key], seed=seed), measures or Measures()))
        for source in sources
        for seed in range(seeds)
        for row in chosen
    ]


def _silent(recipe: Recipe) -> Recipe:
    """Without previews, with checkpoints often enough for whoever stops it."""
    every = min(recipe.training.checkpoint_every, 250)
    return replace(recipe, training=replace(recipe.training, preview_every=0, checkpoint_every=every))
