"""What a path is that is not what a command expected, and what to do with it."""

from pathlib import Path

from twofold.errors import TwofoldError
from twofold.inputs import is_there, shown_path

_VIDEOS = {".mp4", ".mov", ".m4v", ".avi", ".mkv", ".webm", ".mpg", ".mpeg", ".mts", ".3gp", ".wmv", ".gif"}
_IMAGES = {".png", ".jpg", ".jpeg", ".webp", ".tif", ".tiff", ".bmp"}
_ARCHIVES = {".zip", ".tar", ".gz", ".tgz", ".bz2", ".xz", ".7z", ".rar"}


def require_capture(path: Path) -> None:
    """Refuses what is plainly something else than a capture folder; what could be one is left to its reader.

    Raises:
        TwofoldError: says what it is and which command takes it.
    """
    what = _other_than_capture(path)
    if what:
        raise TwofoldError(f"{shown_path(path)} is {what}")


def require_run(path: Path) -> None:
    """Refuses what is plainly something else than a run folder; what could be one is left to its reader.

    Raises:
        TwofoldError: says what it is and which command takes it.
    """
    if is_there(path / "recipe.json"):
        return
    if is_there(path / "capture.json"):
        raise TwofoldError(
            f"{shown_path(path)} is a capture, expected a run; train an avatar from it first: twofold train {path}"
        )
    what = _other_than_capture(path)
    if what:
        raise TwofoldError(f"{shown_path(path)} is {what}".replace("expected a capture folder", "expected a run"))


def require_fitted(path: Path) -> None:
    """Refuses folders of other programs that `twofold convert` cannot read, and says how their images can be used.

    Raises:
        TwofoldError: says what it is and which command takes it.
    """
    if is_there(path / "capture.npz"):
        return
    if all(is_there(path / name) for name in ("cameras.pkl", "mesh_infos.pkl")):
        raise TwofoldError(
            f"{shown_path(path)} is a HumanNeRF folder without {path}/images; get its images, or make a capture of a "
            "video of your own: twofold prepare VIDEO --out CAPTURE"
        )
    if any(is_there(path / name) for name in ("wham_output.pkl", "slam_results.pth")):
        raise TwofoldError(
            f"{shown_path(path)} is output of WHAM, which has no images; give the video with the poses: "
            f"twofold prepare VIDEO --poses {path}/wham_output.pkl --body SMPL_FILE --out CAPTURE"
        )
    what = _other_than_capture(path)
    if what and "twofold prepare" in what:
        raise TwofoldError(
            f"{shown_path(path)} is {what}".replace("expected a capture folder", "expected a folder with capture.npz")
        )


def _other_than_capture(path: Path) -> str | None:
    """The rest of the sentence about a path that cannot be a capture folder; None where it may be one."""
    if path.is_file():
        ending = path.suffix.lower()
        if ending in _VIDEOS:
            return f"a video, expected a capture folder; make one of it: twofold prepare {path} --out {path.stem}"
        if ending in _IMAGES:
            return "an image, expected a capture folder; it takes a video or a folder of images: twofold prepare"
        if ending in _ARCHIVES:
            return "an archive, expected a capture folder; unpack it first."
        return None
    if not path.is_dir() or is_there(path / "capture.json"):
        return None
    if is_there(path / "recipe.json"):
        return "a run, expected a capture folder; name the capture that it was trained on, or another one."
    if is_there(path / "capture.npz"):
        return f"not yet a capture folder; make one of it: twofold convert {path} {path.name}-capture"
    try:
        endings = {entry.suffix.lower() for entry in path.iterdir()}
    except OSError:
        return None
    if endings & _IMAGES:
        return f"a folder of images, expected a capture folder; make one of it: twofold prepare {path} --out CAPTURE"
    if endings & _VIDEOS:
        return f"a folder of videos, expected a capture folder; make one: twofold prepare {path}/VIDEO --out CAPTURE"
    return None


def after_rendering(run: Path, capture: Path, words: str, recipe: str) -> str:
    """What to do when the images are there: measure, unless that has been done since the training.

    Args:
        run: folder.
        capture: its capture.
        words: the command that measures.
        recipe: name of the run's recipe.
    """
    metrics, checkpoint = run / "metrics.json", run / "checkpoint.safetensors"
    if not metrics.is_file() or metrics.stat().st_mtime < checkpoint.stat().st_mtime:
        return words
    return f"twofold report {run}, one page with all of it{_finer(capture, recipe)}"


def after_evaluation(run: Path, capture: Path, words: str, recipe: str) -> str:
    """What to do when the metrics are there: render, unless that has been done since the training.

    Args:
        run: folder.
        capture: its capture.
        words: the command that renders.
        recipe: name of the run's recipe.
    """
    renders, checkpoint = run / "renders", run / "checkpoint.safetensors"
    if not renders.is_dir() or renders.stat().st_mtime < checkpoint.stat().st_mtime:
        return words
    return f"twofold report {run}, one page with all of it{_finer(capture, recipe)}"


def _finer(capture: Path, recipe: str) -> str:
    """How to get a better avatar, where there is a way."""
    if recipe != "quick":
        return ""
    return f"; for finer detail, in hours on a CPU: twofold train {capture} --recipe fast"
