"""Images taken out of the splits of a capture that exists; its other files stay as they are."""

from collections.abc import Iterable
from pathlib import Path
from typing import Any

from twofold.capture.layout import DESCRIPTION, read_contents
from twofold.capture.validate import require
from twofold.errors import TwofoldError
from twofold.files import write_json
from twofold.inputs import read_json


def leave_out(folder: Path | str, images: Iterable[tuple[str, int]]) -> list[tuple[str, int]]:
    """Takes images out of all splits, and with a training frame its novel views; the notes list them.

    Args:
        folder: the capture.
        images: camera and time.

    Returns:
        Those that are in no split any more, in order.

    Raises:
        TwofoldError: the folder is no capture, or too little is left to train on; nothing is changed then.
    """
    folder = Path(folder)
    contents, faults = read_contents(folder)
    require(faults, folder)
    unfit = set(images)
    before = {split: set(chosen) for split, chosen in contents.splits.items()}
    after = {split: chosen - unfit for split, chosen in before.items()}
    times = {time for _, time in after["train"]}
    if len(times) < 2:
        raise TwofoldError(
            f"Without the images to leave out, {folder} would train on {len(times)} frames; two are needed. "
            "Prepare the capture again."
        )
    after["novel_view"] = {(camera, time) for camera, time in after["novel_view"] if time in times}
    description: dict[str, Any] = read_json(folder / DESCRIPTION)
    description["splits"] = {split: _entries(chosen) for split, chosen in after.items()}
    gone = sorted(set[tuple[str, int]]().union(*before.values()) - set[tuple[str, int]]().union(*after.values()))
    notes = description.get("notes")
    notes = dict(notes) if isinstance(notes, dict) else {}
    earlier = notes.get("left_out_by_check")
    notes["left_out_by_check"] = [*(earlier if isinstance(earlier, list) else []), *([c, t] for c, t in gone)]
    write_json(folder / DESCRIPTION, description | {"notes": notes})
    return gone


def _entries(images: Iterable[tuple[str, int]]) -> list[dict[str, Any]]:
    times: dict[str, list[int]] = {}
    for camera, time in sorted(images):
        times.setdefault(camera, []).append(time)
    return [{"camera": camera, "times": group} for camera, group in times.items()]
