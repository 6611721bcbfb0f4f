"""Data sets of other projects: `twofold convert`, and what lets `train` and `check` take them as they are."""

import os
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from twofold.cli.advice import require_capture, require_fitted
from twofold.cli.console import bar, console, say
from twofold.errors import TwofoldError
from twofold.inputs import is_there, read_json, shown_path

if TYPE_CHECKING:
    from twofold.capture.readers.convert import ConvertOptions

SplitName = Literal["paper", "humannerf", "monohuman", "neuralbody"]
MaskName = Literal["union", "mask", "mask_cihp"]
CAPTURES = Path("captures")
"""Where captures are put that `train` and `check` make of data sets."""


def convert(
    source: Annotated[Path, tyro.conf.Positional],
    out: Annotated[Path, tyro.conf.Positional],
    body: Path | None = None,
    split: SplitName | None = None,
    scale: float = 1.0,
    masks: MaskName | None = None,
    held_out: int = 10,
    drop_below_iou: float = 0.0,
    held_objects: Literal["keep", "remove"] = "remove",
    fps: float | None = None,
    credit: str = "",
) -> None:
    """Make a capture folder from a data set of another project, or from a folder with a fitted body.

    Args:
        source: ZJU-MoCap (raw or refined), a folder of HumanNeRF, MonoHuman or Vid2Avatar, an HDF5 file of the paper's
            pipeline, or a folder with images/, masks/ and capture.npz.
        out: Folder to make.
        body: Your own SMPL file, which all but capture.npz need.
        split: Whose training and test images; by default the paper's with several cameras, else held-out frames.
        scale: Of rows and columns; 0.5 for the 512 x 512 pixels of the papers.
        masks: Which of ZJU-MoCap's masks; by default those that the split's paper takes.
        held_out: Every Nth frame is held out, where there is one camera and no --split.
        drop_below_iou: With capture.npz: leaves out frames whose body covers the mask worse than this, 0 to 1.
        held_objects: With capture.npz: whether a ball or the like is taken out of the masks.
        fps: Frames a second; by default what the source says, else 30.
        credit: Whom to name when showing the images.
    """
    from twofold.capture.readers.convert import ConvertOptions
    from twofold.capture.readers.known_formats import reader_of

    if is_there(source / "capture.npz") or reader_of(source) is None:
        if body is not None or split is not None or scale != 1.0 or masks is not None:
            raise TwofoldError(
                f"{shown_path(source)} is no data set of a known format, to which --body, --split, --scale and --masks "
                "belong; docs/data.md says which files each format has."
            )
        _import_fitted(source, out, held_out, drop_below_iou, held_objects, fps, credit)
        return
    if drop_below_iou or held_objects != "remove":
        raise TwofoldError("--drop-below-iou and --held-objects belong to folders with capture.npz; leave them out.")
    summary = _converted(source, out, ConvertOptions(body, split, scale, masks, held_out, fps, credit))
    say(f"The capture is in {out}: {summary}", f"twofold check {out}")


def _import_fitted(
    source: Path,
    out: Path,
    held_out: int,
    iou: float,
    objects: Literal["keep", "remove"],
    fps: float | None,
    credit: str,
) -> None:
    """A folder with a body that another program fitted."""
    from twofold.prepare.import_fitted import import_prepared

    require_fitted(source)
    remarks: list[str] = []
    import_prepared(
        source, out, held_out, iou, held_objects=objects, fps=fps, credit=credit, remark=remarks.append
    )  # fmt: skip
    _print_notes(remarks)
    say(f"The capture is in {out}.", f"twofold check {out}")


def _converted(source: Path, out: Path, options: "ConvertOptions") -> str:
    """Converts and prints the notes; returns what came of it in a few words."""
    from twofold.capture.readers.convert import convert as make

    remarks: list[str] = []
    with bar("Converting") as progress:
        made = make(source, out, options, progress=progress, remark=remarks.append)
    _print_notes(remarks)
    return made.summary()


def _print_notes(remarks: list[str]) -> None:
    for sentence in remarks:
        console().print(f"Note: {sentence}", soft_wrap=True)


def capture_from(path: Path, body: Path | None, split: SplitName | None) -> Path:
    """The capture folder that a command works on: `path`, or for a data set one that is made of it under `captures/`.

    A capture that was made of the same data set, body and split before is taken again.

    Args:
        path: capture folder or data set.
        body: the user's SMPL file, for a data set.
        split: whose split, for a data set.

    Raises:
        TwofoldError: `path` is neither; options do not go with it; the data set cannot be converted; or something else
            lies where the capture would be.
    """
    from twofold.capture.readers.convert import ConvertOptions
    from twofold.capture.readers.known_formats import reader_of

    reader = None if is_there(path / "capture.json") else reader_of(path)
    if reader is None:
        if body is not None or split is not None:
            raise TwofoldError(
                f"--body and --split belong to data sets of other projects; {shown_path(path)} is none that is known "
                "(a capture folder has its own body and splits)."
            )
        require_capture(path)
        return path
    options = replace(ConvertOptions(), body=body, split=split)
    stem = path.resolve().stem if path.is_file() else path.resolve().name
    out = CAPTURES / (f"{stem}-{split}" if split else stem)
    if _made_before(out, path, options):
        _print_notes([f"{out} was made of {path} before and is taken; remove it to convert anew."])
        return out
    if os.environ.get("WORLD_SIZE", "1") != "1":
        raise TwofoldError(f"Several processes cannot convert at once; run twofold convert {path} {out} first.")
    summary = _converted(path, out, options)
    console().print(f"{path} is {reader.title}; the capture made of it is in {out}: {summary}", soft_wrap=True)
    return out


def _made_before(out: Path, source: Path, options: "ConvertOptions") -> bool:
    """Whether the capture at `out` came of the same request.

    Raises:
        TwofoldError: it came of another one.
    """
    from twofold.capture.readers.convert import request_notes

    if not is_there(out / "capture.json"):
        return False
    description = read_json(out / "capture.json")
    notes = description.get("notes") if isinstance(description, dict) else None
    wanted = request_notes(source, options)
    if isinstance(notes, dict) and all(notes.get(key) == value for key, value in wanted.items()):
        return True
    raise TwofoldError(
        f"{out} holds a capture that was not made of {shown_path(source)} with the same --body and --split; convert to "
        f"another folder (twofold convert {source} OUT) and name that."
    )
