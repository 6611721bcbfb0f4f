"""The command line: `twofold studio`, `import`, `train`, `render`, `evaluate`, `demo`."""

import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Literal

import tyro
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from twofold.errors import TwofoldError

Parts = Literal["all", "orbit", "views", "poses", "canonical"]
Recipes = Literal["quick", "fast", "released", "paper"]
_console = Console(stderr=True, highlight=False)


@contextmanager
def _bar(title: str) -> Iterator[Callable[[float, str], None]]:
    """A progress bar; the function it gives takes the share that is done and a word about it."""
    columns = (TextColumn("{task.description}"), BarColumn(), TextColumn("{task.percentage:>3.0f} %"))
    with Progress(
        *columns, TimeElapsedColumn(), TextColumn("left"), TimeRemainingColumn(), TextColumn("{task.fields[note]}"),
        console=_console, refresh_per_second=4, speed_estimate_period=60,
    ) as progress:  # fmt: skip
        task = progress.add_task(title, total=1.0, note="")
        yield lambda done, note="": progress.update(task, completed=done, note=note)


def studio(
    out: Annotated[Path, tyro.conf.Positional],
    seed: int = 0,
    size: int = 256,
    frames: int = 80,
    cameras: int = 8,
    pose_noise: float = 0.0,
    mask_noise: float = 0.0,
    background: Literal["black", "textured"] = "black",
) -> None:
    """Makes a capture of a person who never lived, with the truth about shape and pose.

    Args:
        out: Folder to make.
        seed: Who, wearing what, moving how.
        size: Rows and columns of the pictures.
        frames: Moments; the last fifth shows a motion that is not trained on.
        cameras: In a ring around the person; the first one trains.
        pose_noise: Error of the given poses, radians (standard deviation).
        mask_noise: Faults of the masks, 0 to 1.
        background: What stands behind the person.
    """
    from twofold.capture.studio import StudioConfig, make_studio

    config = StudioConfig(seed, size, frames, cameras, pose_noise, mask_noise, background)
    with _bar("Filming") as show:
        make_studio(config, out, lambda done: show(done, ""))
    _say(f"The capture is in {out}.", f"twofold train {out}")


def import_capture(
    source: Annotated[Path, tyro.conf.Positional],
    out: Annotated[Path, tyro.conf.Positional],
    held_out: int = 10,
    drop_below_iou: float = 0.0,
    held_objects: Literal["keep", "remove"] = "remove",
) -> None:
    """Makes a capture folder from one that was prepared elsewhere (images, masks, capture.npz).

    Args:
        source: Folder with images/, masks/ and capture.npz.
        out: Folder to make.
        held_out: Of so many frames one is kept for testing.
        drop_below_iou: Leaves out frames whose fitted body covers the mask worse than this, 0 to 1.
        held_objects: Whether what is thick and sticks out of the body, such as a ball, leaves the masks.
    """
    from twofold.capture.prepared import import_prepared

    import_prepared(source, out, held_out, drop_below_iou, held_objects=held_objects)
    _say(f"The capture is in {out}.", f"twofold train {out}")


def train(
    capture: Annotated[Path | None, tyro.conf.Positional] = None,
    out: Path | None = None,
    recipe: Recipes = "quick",
    set: Annotated[tuple[str, ...], tyro.conf.UseAppendAction] = (),
    seed: int = 0,
    device: str = "auto",
    resume: Path | None = None,
) -> None:
    """Trains an avatar from a capture folder.

    Args:
        capture: Capture folder (`twofold studio`, `twofold import`).
        out: Run folder to make; by default runs/NAME-RECIPE.
        recipe: quick (minutes on a CPU), fast (the released networks, sampled near the body), released, paper.
        set: One setting, such as training.steps=500; may be given several times.
        seed: Of everything random.
        device: auto, cpu, cuda or cuda:N.
        resume: Run folder of an interrupted training to continue.
    """
    from dataclasses import replace

    from twofold.capture.folder import read_capture
    from twofold.capture.validate import require, validate
    from twofold.config import with_overrides
    from twofold.recipes import RECIPES
    from twofold.train import loop
    from twofold.train.run import choose_device, read_about, read_recipe

    where = choose_device(device)
    if resume is not None:
        if set or out:
            raise TwofoldError(
                "--resume continues a run as it was begun; leave --set and --out out, or start a new run."
            )
        chosen, folder = read_recipe(resume), resume
        capture = capture or Path(str(read_about(resume)["capture"]))
    else:
        if capture is None:
            raise TwofoldError(
                "Expected a capture folder (`twofold train CAPTURE`) or --resume RUN; neither was given."
            )
        chosen = with_overrides(replace(RECIPES[recipe](), seed=seed), list(set))
        folder = out or Path("runs") / f"{capture.resolve().name}-{recipe}"
        if (folder / "checkpoint.safetensors").exists():
            raise TwofoldError(
                f"{folder} already holds a run; continue it with --resume {folder}, or choose another --out."
            )
    require(validate(capture), capture)
    read = read_capture(capture)
    with _bar("Training") as show:
        loop.train(
            read, chosen, folder, where, resume is not None,
            lambda p: show(p.step / p.steps, f"step {p.step}  loss {sum(p.losses.values()):.4f}  {p.psnr:.1f} dB"),
            _attach_lpips,
        )  # fmt: skip
    _say(f"The avatar is in {folder}.", f"twofold render {folder}")


def _attach_lpips(avatar: object) -> None:
    """Gives the avatar its perceptual loss, or says once that it goes without."""
    from twofold.methods.factorized import FactorizedAvatar
    from twofold.metrics.perceptual import load_lpips

    if isinstance(avatar, FactorizedAvatar) and avatar.config.losses.lpips:
        network, message = load_lpips()
        avatar.lpips = network.to(avatar.device) if network else None
        if message:
            _console.print(message)


def render(
    run: Annotated[Path, tyro.conf.Positional],
    what: Parts = "all",
    size: int = 512,
    capture: Path | None = None,
    out: Path | None = None,
    chunk: int | None = None,
    device: str = "auto",
) -> None:
    """Draws an avatar: an orbit, unseen views, unseen poses, front and back; branches, normals, opacity.

    Args:
        run: Run folder.
        what: Everything, or one part.
        size: Rows of the pictures of the orbit and of the canonical pose.
        capture: Capture folder, if it has moved since training.
        out: Folder for the pictures; by default RUN/renders.
        chunk: Rays at once; by default as many as the free memory holds.
        device: auto, cpu, cuda or cuda:N.
    """
    from twofold.capture.folder import read_capture
    from twofold.outputs.gallery import render_run
    from twofold.train.run import choose_device, load, read_about

    avatar, _ = load(run, choose_device(device))
    source = capture or Path(str(read_about(run)["capture"]))
    folder = out or run / "renders"
    with _bar("Drawing") as show:
        render_run(avatar, read_capture(source), folder, what, size, chunk, lambda done: show(done, ""))
    _say(f"The pictures are in {folder}.", f"twofold evaluate {run}")


def evaluate(
    run: Annotated[Path, tyro.conf.Positional],
    capture: Path | None = None,
    most: int | None = None,
    meshes: int | None = 4,
    device: str = "auto",
) -> None:
    """Measures an avatar against what its capture knows to be true; writes RUN/metrics.json.

    Args:
        run: Run folder.
        capture: Capture folder, if it has moved since training.
        most: At most so many pictures a split; by default all.
        meshes: At most so many true meshes.
        device: auto, cpu, cuda or cuda:N.
    """
    from twofold.capture.folder import read_capture
    from twofold.evaluate import evaluate as measure
    from twofold.train.run import choose_device, load, read_about

    avatar, _ = load(run, choose_device(device))
    read = read_capture(capture or Path(str(read_about(run)["capture"])))
    count = sum(min(len(read.splits.get(s, ())), most or 10**9) for s in ("novel_view", "novel_pose"))
    done = 0

    def watch(split: str, frame: object, picture: object) -> None:
        nonlocal done
        done += 1
        show(done / max(count, 1), split)

    with _bar("Measuring") as show:
        metrics = measure(avatar, read, run, most, meshes, watch)
    for section, values in metrics.items():
        if isinstance(values, dict):
            numbers = {k: v for k, v in values.items() if isinstance(v, float)}
            _console.print(f"{section}: " + ", ".join(f"{k} {v:.4g}" for k, v in numbers.items()))
    _say(f"The figures are in {run / 'metrics.json'}.", f"twofold render {run}")


def demo(out: Path = Path("demo"), seed: int = 0) -> None:
    """The whole idea in three minutes: films a made-up person, trains an avatar, measures it, shows it on a page.

    Args:
        out: Folder to make.
        seed: Who is filmed.
    """
    from twofold.demo import run_demo

    with _bar("Demo") as show:
        page = run_demo(out, seed, show)
    _say(f"The page is {page}.", f"open {page}, or train on your own: twofold train CAPTURE")


def _say(result: str, following: str) -> None:
    _console.print(f"{result} Next: {following}", soft_wrap=True)


COMMANDS: dict[str, Callable[..., None]] = {
    "demo": demo,
    "studio": studio,
    "import": import_capture,
    "train": train,
    "render": render,
    "evaluate": evaluate,
}


def main(arguments: Sequence[str] | None = None) -> None:
    """Entry point of the `twofold` command: exit code 0, 2 for input that cannot be used, 130 after Ctrl-C."""
    from twofold.speed import tune_process

    tune_process()
    try:
        tyro.extras.subcommand_cli_from_dict(
            COMMANDS, prog="twofold", args=arguments, description="A video of a person goes in, an avatar comes out.",
            config=(tyro.conf.AvoidSubcommands,),
        )  # fmt: skip
    except TwofoldError as error:
        print(f"twofold: {error}", file=sys.stderr)
        sys.exit(2)
    except KeyboardInterrupt:
        print(
            "twofold: stopped. A training that was stopped continues with `twofold train --resume RUN`.",
            file=sys.stderr,
        )
        sys.exit(130)
