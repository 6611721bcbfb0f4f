"""`twofold report`: one page that shows a run."""

import shutil
import tempfile
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from twofold.cli.advice import require_capture, require_run
from twofold.cli.console import bar, say, tell, within
from twofold.errors import TwofoldError

if TYPE_CHECKING:
    from twofold.body.motion import Motion
    from twofold.capture.types import Capture
    from twofold.methods.base import Avatar


def report(
    run: Annotated[Path, tyro.conf.Positional],
    out: Path | None = None,
    motion: tuple[str, ...] = ("walk", "dance"),
    mesh: bool = False,
    frames: int = 3,
    size: int = 384,
    max_images: int = 9,
    max_meshes: int = 2,
    faces: int = 20_000,
    texture: int = 1024,
    name: str = "avatar",
    capture: Path | None = None,
    device: str = "auto",
) -> None:
    """Write one self-contained page about a run: the avatar in 3-D, videos, held-out frames, metrics, recipe.

    Args:
        run: Run folder.
        out: HTML file to write; by default RUN/report.html.
        motion: What the character can do besides the capture's motion: .bvh or .npz files, walk, turn, dance,
            range-of-motion, or none.
        mesh: Render the orbit by the baked mesh instead of the field: quick.
        frames: Held-out frames shown of each split.
        size: Rows of the canonical images and videos, 64 to 2048.
        max_images: Images measured of each split where the run has no metrics yet.
        max_meshes: Ground-truth meshes measured then.
        faces: Triangles of the character, roughly.
        texture: Rows and columns of its texture.
        name: Of the person, for the GLB that can be saved from the page.
        capture: Capture folder, if it has moved since training.
        device: auto, cpu, cuda or cuda:N.
    """
    from twofold.capture.folder import read_capture
    from twofold.outputs.export.bake_cache import open_cache
    from twofold.report.page_character import PAGE, PageCharacter, lacking, page_character
    from twofold.report.run_page import PageOptions, render_images, run_texts, write_page
    from twofold.training.run import choose_device, find_capture, load, require_same

    within(
        frames=(frames, 1, 30), size=(size, 64, 2048), max_images=(max_images, 1, None),
        max_meshes=(max_meshes, 0, None), faces=(faces, 500, 200_000), texture=(texture, 64, 4096),
    )  # fmt: skip
    require_run(run)
    if out is not None and out.suffix.lower() != ".html":
        raise TwofoldError(f"--out should end in .html; it is {out}.")
    target = out or run / "report.html"
    avatar, _ = load(run, choose_device(device))
    source = find_capture(run, capture)
    require_capture(source)
    read = read_capture(source)
    require_same(run, read, motion=True)
    config = replace(PAGE, faces=faces, texture=texture)
    missing = lacking(avatar, config)
    motions = () if missing else _motions(avatar, motion, read)
    with bar("Report") as progress, tempfile.TemporaryDirectory() as folder:
        metrics = _metrics(avatar, read, run, max_images, max_meshes, lambda done, _: progress(0.3 * done, "measuring"))
        character: PageCharacter | None = None
        if not missing:
            cache = open_cache(run, read, tell)
            character = page_character(
                avatar, read, motions, name, config, cache, lambda done, note: progress(0.3 + 0.3 * done, note)
            )
        options = PageOptions(frames, size, mesh=mesh)
        images = render_images(
            avatar, read, options, Path(folder), character, lambda done, note: progress(0.6 + 0.38 * done, note)
        )
        page = write_page(
            Path(folder), run, read, metrics, images, run_texts(run, source, read, metrics), character, missing
        )
        _place(page, target)
    if missing:
        tell(missing)
    size_mb = target.stat().st_size / 1e6
    following = f"twofold export {run}" if character else f"twofold render {run} --motion dance"
    say(f"The page is {target} ({size_mb:.1f} MB, one file).", f"open it in a browser; or {following}")


def _place(page: Path, target: Path) -> None:
    from twofold.files import made_folder, write_atomically

    with made_folder(target.parent), write_atomically(target) as beside:
        shutil.copyfile(page, beside)


def _metrics(
    avatar: "Avatar", capture: "Capture", run: Path, images: int, meshes: int, progress: Callable[[float, str], None]
) -> dict[str, object]:
    """The run's metrics; measured where there are none since its training."""
    from twofold.evaluation import evaluate
    from twofold.inputs import read_json

    stored, checkpoint = run / "metrics.json", run / "checkpoint.safetensors"
    if stored.is_file() and stored.stat().st_mtime >= checkpoint.stat().st_mtime:
        found = read_json(stored)
        if isinstance(found, dict):
            return {str(key): value for key, value in found.items()}
        raise TwofoldError(f"{stored} should hold an object; remove it, and it is measured again.")
    if not any(capture.splits.get(split) for split in ("novel_view", "novel_pose")):
        tell("The capture has no held-out frames, so only training images are measured.")
    return evaluate(avatar, capture, run, images, meshes, progress)


def _motions(avatar: "Avatar", words: tuple[str, ...], capture: "Capture") -> "tuple[Motion, ...]":
    from twofold.body.motion_files import MotionOptions, read_motion
    from twofold.outputs.motion_video import rest_body

    body = rest_body(avatar)
    return tuple(read_motion(word, body, MotionOptions(), capture.body).motion for word in words if word != "none")
