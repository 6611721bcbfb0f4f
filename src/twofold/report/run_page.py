"""`twofold report`: one page about a run, gathered from its folder, its capture and its avatar."""

import shlex
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from twofold.capture.coverage_map import CAPTION, coverage_map
from twofold.capture.types import Capture
from twofold.config import list_settings
from twofold.evaluation import with_protocols
from twofold.methods.base import Avatar
from twofold.methods.table import RECIPES
from twofold.outputs.shares import Shares
from twofold.recipe import Recipe
from twofold.report import page_images as own
from twofold.report.page_character import PageCharacter
from twofold.report.parts import (
    CaptionedImage,
    Chart,
    Commands,
    Curve,
    KeyMetric,
    Part,
    Row,
    Section,
    Table,
    Video,
    key_metric,
    metrics_table,
    write_report,
)
from twofold.training.curves import read_curves
from twofold.training.run import CURVES, read_about, read_coverage, read_recipe

Progress = Callable[[float, str], None]


@dataclass(frozen=True)
class PageImages:
    """What a page shows of an avatar, rendered.

    Attributes:
        held_out: frames with their renderings.
        canonical: front and back, as a row.
        videos: in order.
    """

    held_out: Sequence[own.HeldOut]
    canonical: Row
    videos: Sequence[Video]


@dataclass(frozen=True)
class PageTexts:
    """Words of a page that depend on the occasion.

    Attributes:
        title: of the page.
        subtitle: below it.
        key_metrics: to see first.
        reproduce: command lines, each with its purpose, that lead to the same page.
        following: command lines to go on with.
        credit: at the foot.
    """

    title: str
    subtitle: str
    key_metrics: Sequence[KeyMetric] = ()
    reproduce: Sequence[tuple[str, str]] = ()
    following: Sequence[tuple[str, str]] = ()
    credit: str = ""


@dataclass(frozen=True)
class PageOptions:
    """How much a page shows.

    Attributes:
        frames: held-out frames of each split.
        size: rows of the canonical images and the orbit, pixels.
        views: images of the orbit.
        mesh: render the orbit by the baked mesh.
    """

    frames: int = 3
    size: int = 384
    views: int = 24
    mesh: bool = False


def render_images(
    avatar: Avatar, capture: Capture, options: PageOptions, folder: Path, character: PageCharacter | None,
    progress: Progress = lambda _done, _note: None,
) -> PageImages:  # fmt: skip
    """Renders what a page shows.

    Args:
        avatar: trained.
        capture: that it was trained on.
        options: how much.
        folder: gets orbit.mp4 and novel_pose.mp4.
        character: for images by the mesh; None renders all by the field.
        progress: called with the fraction that is done and what is done.
    """
    held = sum(len(own.one_each(capture.splits.get(split, ()), options.frames)) for split in own.SPLITS)
    by_mesh = options.mesh and character is not None
    _, moving = own.held_out_motion(capture)
    pieces = {"held-out frames": held, "canonical": 2, "orbit": 0 if by_mesh else options.views, "motion": moving}
    shares = Shares(pieces, {}, lambda share: progress(share, "rendering"))
    found = own.held_out(avatar, capture, options.frames, lambda: shares.done("held-out frames"))
    canonical = own.canonical_images(avatar, capture, options.size, lambda: shares.done("canonical"))
    turning = own.write_orbit(
        folder / "orbit.mp4", avatar, capture, options.size, options.views, character if by_mesh else None,
        lambda: shares.done("orbit"),
    )  # fmt: skip
    poses = own.write_novel_poses(
        folder / "novel_pose.mp4", avatar, capture, options.size, lambda: shares.done("motion")
    )
    return PageImages(found, own.canonical_row(canonical), [turning, *([poses] if poses else [])])


def write_page(
    folder: Path, run: Path, capture: Capture, metrics: Mapping[str, object], images: PageImages, texts: PageTexts,
    character: PageCharacter | None, lacking: str = "",
) -> Path:  # fmt: skip
    """Writes `report.html` into a folder.

    Args:
        folder: exists.
        run: whose curves, recipe and versions are shown.
        capture: for the ground truth.
        metrics: as `evaluate` gives them.
        images: rendered.
        texts: of the occasion.
        character: None where there can be none.
        lacking: why.

    Raises:
        TwofoldError: the run is damaged, or the disk refuses.
    """
    recipe = read_recipe(run)
    sections = [
        _character_section(character, lacking),
        *_held_out_sections(capture, images),
        Section(
            "Canonical space",
            f"All frames share one canonical space. Renderer: {own.FIELD}.",
            (images.canonical,),
        ),
        *_branches_section(images),
        _coverage_section(run, capture),
        *_curves_section(run),
        _metrics_section(metrics),
        _recipe_section(run, recipe, texts),
    ]
    shown = [section for section in sections if section.parts or section.text]
    return write_report(
        folder, texts.title, shown, texts.subtitle, texts.key_metrics, images.videos[0], texts.credit
    )  # fmt: skip


def _character_section(character: PageCharacter | None, lacking: str) -> Section:
    if character is None:
        return Section("The character", lacking)
    shown = character.character
    lit = "colours with the capture's light" if shown.lit else "colours without the capture's light, lit by the page"
    text = (
        f"Drag to look around. A mesh of {len(shown.faces):,} triangles with {len(shown.targets)} morph targets, baked "
        f"from the field: {lit}."
    )
    return Section("The character", text, (character.part,))


def _held_out_sections(capture: Capture, images: PageImages) -> list[Section]:
    texts = {
        "novel_view": "Held-out frames: other cameras, or other frames, than those that were trained on.",
        "novel_pose": "Held-out frames of poses that were not trained on.",
    }
    sections: list[Section] = []
    for split, heading in own.SPLITS.items():
        shown = [held for held in images.held_out if held.split == split]
        if not shown:
            continue
        parts: list[Part] = [own.comparison_row(capture, shown)]
        if split == "novel_pose":
            parts += images.videos[1:]
        sections.append(Section(heading, f"{texts[split]} Renderer: {own.FIELD}. {own.ERROR_TEXT}", tuple(parts)))
    return sections


def _branches_section(images: PageImages) -> list[Section]:
    held = [next((h for h in images.held_out if h.split == split), None) for split in own.SPLITS]
    rows = [row for h in held if h is not None and (row := own.branches_row(h)) is not None]
    text = (
        "The low-frequency branch holds what is the same in all frames; the high-frequency branch adds what changes "
        "with the pose. Their sum is the avatar. Residuals are shown around grey."
    )
    return [Section("Two branches", text, tuple(rows))] if rows else []


def _coverage_section(run: Path, capture: Capture) -> Section:
    coverage = read_coverage(run, capture)
    text = f"{coverage.sentence().capitalize()}. {CAPTION}"
    return Section("Coverage", text, (Row((CaptionedImage(coverage_map(capture, coverage)),)),))


def _curves_section(run: Path) -> list[Section]:
    if not (run / CURVES).is_file():
        return []
    rows = read_curves(run)
    names = list(dict.fromkeys(name for row in rows for name in row if name != "step"))

    def curve(name: str) -> Curve:
        own_rows = [row for row in rows if name in row]
        return Curve(name, [row["step"] for row in own_rows], [row[name] for row in own_rows])

    charts: list[Part] = []
    if "psnr" in names:
        charts.append(Chart("PSNR of each step's rays, dB", (curve("psnr"),)))
    losses = [name for name in names if name not in _NO_LOSSES and any(row.get(name, 0) > 0 for row in rows)]
    if losses:
        charts.append(Chart("Losses", tuple(curve(name) for name in losses[:5]), logarithmic=True))
    return [Section("Training", "", tuple(charts))] if charts else []


_NO_LOSSES = ("psnr", "beta", "seconds")


def _metrics_section(metrics: Mapping[str, object]) -> Section:
    if not metrics:
        return Section("Metrics", "Nothing was measured yet; run `twofold evaluate` and make the report again.")
    return Section("All metrics, and how they were measured", "", (metrics_table(with_protocols(dict(metrics))),))


def _recipe_section(run: Path, recipe: Recipe, texts: PageTexts) -> Section:
    about = read_about(run)
    packages = about.get("packages", {})
    versions = {name: about.get(name) for name in ("twofold", "python", "machine", "threads")}
    versions |= packages if isinstance(packages, dict) else {}
    rows = tuple((name, str(value)) for name, value in versions.items() if value is not None)
    settings = tuple(list_settings(recipe))
    notes = about.get("notes", [])
    text = f"Recipe `{recipe.name}`, seed {recipe.seed}."
    if isinstance(notes, list) and notes:
        text += " " + " ".join(str(note) for note in notes)
    parts: list[Part] = [Commands(tuple(texts.reproduce))] if texts.reproduce else []
    parts.append(Table(("setting", "value", "meaning"), settings, f"All {len(settings)} settings of the recipe"))
    parts.append(Table(("version", "value"), rows, "Versions"))
    if texts.following:
        parts.append(Commands(tuple(texts.following)))
    return Section("Recipe, and how to reproduce this", text, tuple(parts))


def run_texts(run: Path, source: Path, capture: Capture, metrics: Mapping[str, object]) -> PageTexts:
    """The words of a page about any run."""
    recipe = read_recipe(run)
    size = capture.train[0].camera
    shown = [
        key_metric(metrics, "novel_view.psnr_box", "novel view", "dB"),
        key_metric(metrics, "novel_pose.psnr_box", "novel pose", "dB"),
        key_metric(metrics, "novel_pose.silhouette_iou", "silhouette IoU"),
        key_metric(metrics, "geometry.chamfer_cm", "surface error", "cm"),
    ]
    known = [metric for metric in shown if metric.unit or any(letter.isdigit() for letter in metric.value)]
    name = shlex.quote(str(shareable(run)))
    return PageTexts(
        f"Avatar of {source.resolve().name}",
        f"{len(capture.train)} training images of {size.width} x {size.height}, recipe {recipe.name}.",
        known,
        (
            (training_command(recipe, shareable(source), shareable(run)), "train"),
            (f"twofold evaluate {name}", "measure"),
            (f"twofold report {name}", "make this page"),
        ),
        (
            (f"twofold export {name} --format glb vrm", "files for Blender, Unity, three.js"),
            (f"twofold render {name} --motion dance --mesh", "a video of any motion"),
        ),
        capture.credit,
    )


def shareable(path: Path) -> Path:
    """A path without the folders of the person who makes the page: from the current folder, or its name alone."""
    whole = path.resolve()
    return whole.relative_to(Path.cwd()) if whole.is_relative_to(Path.cwd()) else Path(whole.name)


def training_command(recipe: Recipe, source: Path, run: Path) -> str:
    """The command that trains such a run, with every setting that its recipe has otherwise by itself."""
    words = ["twofold", "train", str(source), "--out", str(run)]
    if recipe.name == "demo":
        return shlex.join(["twofold", "demo", "--seed", str(recipe.seed)])
    if recipe.name not in RECIPES:
        return shlex.join(words)
    plain = {key: value for key, value, _ in list_settings(RECIPES[recipe.name]())}
    changed = [f"{key}={value}" for key, value, _ in list_settings(recipe) if plain.get(key) != value]
    seed = [word for word in changed if word.startswith("seed=")]
    others = [word for word in changed if word not in seed]
    words += ["--recipe", recipe.name, *(["--seed", str(recipe.seed)] if seed else [])]
    return shlex.join([*words, *(["--set", *others] if others else [])])
