"""The command line: `twofold studio`, `train`, `render` and the other commands of `COMMANDS`.

What a command needs is imported when it runs, so that `--help` answers at once.
"""

import functools
import inspect
import logging
import os
import shlex
import sys
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from twofold import __version__
from twofold.cli.advice import after_evaluation, after_rendering, require_capture, require_run
from twofold.cli.captures import check, prepare, studio
from twofold.cli.compare import compare
from twofold.cli.console import ALONE, bar, console, say, within
from twofold.cli.datasets import SplitName, capture_from, convert
from twofold.cli.experiments_command import reproduce
from twofold.cli.exports import export
from twofold.cli.motions import NO_MOTION, MotionView, motion, render_by_mesh, render_motion
from twofold.cli.protocol_table import networks_asked_for, print_protocols
from twofold.cli.reports import report
from twofold.cli.streams import streams_that_never_fail
from twofold.cli.viewing import NO_VIEW, LiveView, training_view, view
from twofold.errors import TwofoldError

if TYPE_CHECKING:
    from twofold.recipe import Recipe
    from twofold.training.loop import Progress

Parts = Literal["all", "orbit", "views", "poses", "canonical"]


def train(
    capture: Annotated[Path | None, tyro.conf.Positional] = None,
    out: Path | None = None,
    recipe: str = "quick",
    set: Annotated[tuple[str, ...], tyro.conf.UseAppendAction] = (),
    seed: int = 0,
    device: str = "auto",
    resume: Path | None = None,
    settings: bool = False,
    body: Path | None = None,
    split: SplitName | None = None,
    live: Annotated[LiveView, tyro.conf.OmitArgPrefixes] = NO_VIEW,
    complete: Literal["on", "off"] | None = None,
    steps: int | None = None,
) -> None:
    """Train an avatar from a capture folder.

    Args:
        capture: Capture folder (`twofold prepare`, `twofold studio`, `twofold convert`), or a data set that
            `twofold convert` knows; captures/NAME is made of that first.
        out: Run folder to make; by default runs/NAME-RECIPE.
        recipe: Method and its settings; `twofold train --help` lists all.
        set: Settings, such as training.steps=500; one or several, once or several times.
        seed: Seed of all random numbers.
        device: auto, cpu, cuda or cuda:N.
        resume: Run folder of an interrupted training to continue.
        settings: Shows every setting that --set can change, as the recipe has it, and does nothing else.
        body: Your own SMPL file, for a data set.
        split: Whose training and test images, for a data set.
        live: A viewer in the browser.
        complete: Whether regions that no training image shows are completed; by default as the recipe has it.
        steps: Steps of the training, all stages together; the whole schedule of the recipe (decay, warm-up, when parts
            of the method begin) is scaled to it. --set training.steps=N changes that number alone.
    """
    from twofold.methods.table import chosen_recipe

    within(steps=(steps, 1, 100_000_000))
    completion = None if complete is None else complete == "on"
    if settings:
        _show_settings(chosen_recipe(recipe, set, seed, completion, steps))
        return
    from twofold.capture.folder import read_capture
    from twofold.capture.validate import require, validate
    from twofold.outputs.gallery import save_preview
    from twofold.training import loop
    from twofold.training.lock import require_unlocked
    from twofold.training.run import RECIPE, choose_device, find_capture, read_recipe

    if resume is None:
        wanted = chosen_recipe(recipe, set, seed, completion, steps)
        chosen, folder, source = _new_run(capture, out, recipe, wanted, body, split)
    elif set or out or seed or recipe != "quick" or body or split or complete or steps:
        raise TwofoldError(
            "--resume continues a run as it was begun; leave --set, --out, --seed, --recipe, --body, --split, "
            "--complete and --steps out, or start a new run."
        )
    else:
        require_run(resume)
        chosen, folder = read_recipe(resume), resume
        source = find_capture(resume, capture, "twofold train CAPTURE --resume RUN")
    if ALONE:
        require_unlocked(folder)
    where = choose_device(device)
    require(validate(source), source)
    read = read_capture(source)
    try:
        with training_view(live, read, folder) as watched, bar("Training") as progress:
            loop.train(
                read, chosen, folder, where, resume is not None,
                lambda p: watched.after_step(progress(p.step / p.steps, _note(p))), watched.before_first,
                lambda avatar, step: save_preview(avatar, read, folder, step),
                lambda note: console().print(note, soft_wrap=True),
            )  # fmt: skip
    except KeyboardInterrupt:
        if not (folder / RECIPE).is_file():
            raise
        moved = [str(capture)] if resume and capture else []
        where_asked = ["--device", device] if device != "auto" else []
        words = ["twofold", "train", *moved, "--resume", str(folder), *where_asked]
        raise KeyboardInterrupt(f"The training continues with: {shlex.join(words)}") from None
    moved = capture if resume else None
    say(f"The avatar is in {folder}.", _with_capture(["twofold", "render", str(folder)], moved))


def _note(done: "Progress") -> str:
    return f"step {done.step}  loss {sum(done.losses.values()):.4f}  {done.psnr:.1f} dB"


def _show_settings(recipe: "Recipe") -> None:
    """Every setting on a line of standard output."""
    from twofold.config import describe

    print("\n".join(describe(recipe)))


def _new_run(
    capture: Path | None, out: Path | None, name: str, recipe: "Recipe", body: Path | None, split: SplitName | None
) -> "tuple[Recipe, Path, Path]":
    """Recipe, folder and capture of a run to begin."""
    from twofold.training.run import require_free

    if capture is None:
        raise TwofoldError("Expected a capture folder (`twofold train CAPTURE`) or --resume RUN; neither was given.")
    if out is not None:
        require_free(out)
    capture = capture_from(capture, body, split)
    folder = out or Path("runs") / f"{capture.resolve().name}-{name}"
    require_free(folder)
    return recipe, folder, capture


def render(
    run: Annotated[Path, tyro.conf.Positional],
    what: Parts = "all",
    size: int = 512,
    capture: Path | None = None,
    out: Path | None = None,
    chunk: int | None = None,
    device: str = "auto",
    motion_video: Annotated[MotionView, tyro.conf.OmitArgPrefixes] = NO_MOTION,
) -> None:
    """Render an avatar: an orbit, unseen views, unseen poses, front and back; branches, normals, opacity; or a motion.

    Args:
        run: Run folder.
        what: Everything, or one part.
        size: Rows of the images of the orbit and of the canonical pose, 16 to 4096.
        capture: Capture folder, if it has moved since training.
        out: Folder for the images; by default RUN/renders. With --motion a video or a folder.
        chunk: Rays at once; by default as many as the free memory holds.
        device: auto, cpu, cuda or cuda:N.
        motion_video: A video of a motion; the others need --motion.
    """
    from twofold.capture.folder import read_capture
    from twofold.files import made_folder
    from twofold.outputs.gallery import render_run
    from twofold.training.run import choose_device, find_capture, load, read_recipe, require_same

    within(size=(size, 16, 4096), chunk=(chunk, 1, None))
    require_run(run)
    if motion_video.motion is not None:
        render_motion(run, motion_video, size, out, chunk, device, capture)
        return
    if motion_video != replace(NO_MOTION, mesh=motion_video.mesh):
        raise TwofoldError("--follow, --fps, --up, --units, --start-at-origin, --background and --alpha need --motion.")
    if motion_video.mesh:
        render_by_mesh(run, what, size, out, device, capture)
        return
    avatar, _ = load(run, choose_device(device))
    source = find_capture(run, capture)
    require_capture(source)
    read = read_capture(source)
    require_same(run, read, motion=False)
    folder = out or run / "renders"
    with made_folder(folder), bar("Rendering") as progress:
        render_run(avatar, read, folder, what, size, chunk, lambda done: progress(done, ""))
    measure = _with_capture(["twofold", "evaluate", str(run)], capture)
    say(f"The images are in {folder}.", after_rendering(run, source, measure, read_recipe(run).name))


def evaluate(
    run: Annotated[Path, tyro.conf.Positional],
    capture: Path | None = None,
    max_images: int | Literal["all"] = 30,
    max_meshes: int | Literal["all"] = 4,
    protocol: Literal["default", "all"] = "default",
    weights: Path | None = None,
    unverified_weights: bool = False,
    device: str = "auto",
) -> None:
    """Measure an avatar against its capture's held-out images and ground truth; writes RUN/metrics.json.

    Args:
        run: Run folder.
        capture: Capture folder, if it has moved since training.
        max_images: Images measured of each split, evenly spread; all for all.
        max_meshes: Ground-truth meshes measured, evenly spread; all for all.
        protocol: default, or all: also under the settings of several papers, with LPIPS, KID and FID where their
            weights are there, and the consistency of a video.
        weights: Folder with the networks' published weights; by default the usual caches.
        unverified_weights: Accept other weights than the published ones and mark what is measured with them.
        device: auto, cpu, cuda or cuda:N.
    """
    from twofold.capture.folder import read_capture
    from twofold.evaluation import evaluate as measure
    from twofold.training.run import choose_device, find_capture, load, read_recipe, require_same

    images, meshes = (None if given == "all" else given for given in (max_images, max_meshes))
    within(max_images=(images, 1, None), max_meshes=(meshes, 0, None))
    require_run(run)
    networks = networks_asked_for(protocol, weights, unverified_weights)
    avatar, _ = load(run, choose_device(device))
    source = find_capture(run, capture)
    require_capture(source)
    read = read_capture(source)
    require_same(run, read, motion=True)
    with bar("Measuring") as progress:
        metrics = measure(avatar, read, run, images, meshes, progress, networks=networks)
    for section, values in metrics.items():
        if section.endswith("_protocols"):
            print_protocols(section, values)
        elif isinstance(values, dict):
            numbers = {k: v for k, v in values.items() if isinstance(v, int | float)}
            line = f"{section}: " + ", ".join(
                f"{k} {v:,}" if isinstance(v, int) else f"{k} {v:.4g}" for k, v in numbers.items()
            )
            console().print(line if numbers else f"{section}: {values.get('protocol')}", soft_wrap=True)
    sampled = {split: len(read.splits.get(split, ())) for split in ("novel_view", "novel_pose")}
    if images is not None and max(sampled.values()) > images:
        counts = ", ".join(f"{min(images, count)} of {count} of {split}" for split, count in sampled.items() if count)
        note = f"These are means over images that are evenly spread: {counts}; --max-images all measures all."
        console().print(note, soft_wrap=True)
    draw = _with_capture(["twofold", "render", str(run)], capture)
    say(f"The metrics are in {run / 'metrics.json'}.", after_evaluation(run, source, draw, read_recipe(run).name))


def _with_capture(words: list[str], capture: Path | None) -> str:
    """A command about a run, which names a capture that has moved, as the one before it did."""
    return shlex.join([*words, *(["--capture", str(capture)] if capture else [])])


def demo(out: Path = Path("demo"), seed: int = 0) -> None:
    """Show the whole pipeline in minutes: film a synthetic subject, train an avatar, measure it, write a page.

    Args:
        out: Folder to make.
        seed: Seed of the subject.
    """
    from twofold.cli.demo import run_demo

    with bar("Demo") as progress:
        page = run_demo(out, seed, progress)
    files = " and ".join(name for name in ("avatar.glb", "avatar.vrm") if (page.parent / name).is_file())
    character = f"; the character is in {files} beside it" if files else ""
    say(f"The page is {page}{character}.", f"open {page}, or train on your own: twofold train CAPTURE")


COMMANDS: dict[str, Callable[..., None]] = {
    "demo": demo,
    "studio": studio,
    "convert": convert,
    "prepare": prepare,
    "check": check,
    "train": train,
    "render": render,
    "evaluate": evaluate,
    "compare": compare,
    "motion": motion,
    "export": export,
    "reproduce": reproduce,
    "report": report,
    "view": view,
}


def _offer_recipes() -> None:
    """Lets `--recipe` take the names in the table of methods. It imports torch, so only `train` does it."""
    from twofold.kernels.runtime import tune_process

    tune_process()
    from twofold.methods.table import RECIPES

    names = Literal[tuple(RECIPES)]
    train.__annotations__["recipe"] = Annotated[names, tyro.conf.arg(help=_recipe_help())]


def _recipe_help() -> str:
    """A line for each recipe: the first one of its function's docstring."""
    from twofold.methods.table import RECIPES

    lines = [f"{name}: {inspect.getdoc(recipe) or ''}".split("\n", maxsplit=1)[0] for name, recipe in RECIPES.items()]
    return "\n".join(["Method and its settings:", *lines])


def _later(command: Callable[..., None]) -> Callable[..., Callable[[], None]]:
    """The command with the same arguments, to be run when they have all been read."""

    @functools.wraps(command)
    def chosen(*args: object, **options: object) -> Callable[[], None]:
        return functools.partial(command, *args, **options)

    return chosen


ALIASES = {"import": "convert"}
"""Commands that had another name; the old one still works."""

RENAMED = {
    "check": {"--most": "--max-images"},
    "evaluate": {"--most": "--max-images", "--meshes": "--max-meshes"},
}
"""Options that had another name in version 0.1.0 of some command; the old name still works."""


def _renamed(words: Sequence[str]) -> list[str]:
    """The words with the present names of options.

    >>> _renamed(["evaluate", "run", "--most=5"])
    ['evaluate', 'run', '--max-images=5']
    """
    names = RENAMED.get(words[0], {}) if words else {}
    parts = (word.partition("=") for word in words)
    return ["".join((names.get(name, name), sign, value)) for name, sign, value in parts]


def _one_by_one(words: Sequence[str]) -> list[str]:
    """`--set a=1 b=2` as `--set a=1 --set b=2`, which is how the parser takes lists of any length."""
    spread: list[str] = []
    setting = False
    for word in words:
        setting = word == "--set" or (setting and "=" in word and not word.startswith("-"))
        if setting and word != "--set" and spread[-1] != "--set":
            spread.append("--set")
        spread.append(word)
    return spread


def main(arguments: Sequence[str] | None = None) -> None:
    """Entry point of the `twofold` command: exit code 0, 1 where a check fails, 2 for bad input, 130 after Ctrl-C."""
    words = [*(sys.argv[1:] if arguments is None else arguments)]
    with streams_that_never_fail():
        _run(words)


def _run(words: list[str]) -> None:
    """One command from its words to its exit code."""
    try:
        if words == ["--version"]:
            print(f"twofold {__version__}")
            return
        if words[:1] == ["train"]:
            _offer_recipes()
        command = tyro.extras.subcommand_cli_from_dict(
            {name: _later(command) for name, command in COMMANDS.items()}, prog="twofold",
            args=_one_by_one(_renamed([ALIASES.get(word, word) for word in words[:1]] + words[1:])),
            description="A video of a person goes in, an avatar comes out. --version prints the version.",
            config=(tyro.conf.AvoidSubcommands,),
        )  # fmt: skip
        from twofold.kernels.runtime import tune_process

        tune_process()
        # Where no cache is writable, it would report where it keeps its fonts instead.
        logging.getLogger("matplotlib").setLevel(logging.ERROR)
        command()
    except TwofoldError as error:
        print(f"twofold{'' if ALONE else ', process ' + os.environ['RANK']}: {error}", file=sys.stderr)
        sys.exit(2)
    except Exception as error:  # the last net
        from twofold.cli.faults import explain

        print(f"twofold{'' if ALONE else ', process ' + os.environ['RANK']}: {explain(error, words)}", file=sys.stderr)
        sys.exit(2)
    except KeyboardInterrupt as stop:
        if ALONE:
            print(" ".join(["twofold: stopped.", *map(str, stop.args)]), file=sys.stderr)
        sys.exit(130)
