"""A video, or a folder of pictures, as upright pictures at even steps of time."""

import re
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar, final

import numpy as np
from jaxtyping import UInt8
from PIL import Image, ImageOps

from twofold.errors import TwofoldError
from twofold.images import load_image, upright_size
from twofold.prepare.video.decoding import Converter, VideoInfo, decode, describe_video

PICTURE_ENDINGS = (".png", ".jpg", ".jpeg", ".webp", ".bmp", ".tif", ".tiff")
USUAL_FPS = 30.0
"""Taken for a folder of pictures, which cannot say it."""
Item = TypeVar("Item")

_FASTER = 1.1  # More pictures than a clip has would come twice; clips state their rate only roughly.


@dataclass(frozen=True)
class ClipInfo:
    """What will come of a clip.

    Attributes:
        width: columns of each picture.
        height: rows of each picture.
        fps: pictures per second.
        frames: how many, about; some files do not say, or say it wrong.
        duration: seconds, about.
        full_width: columns before pictures are made smaller.
        full_height: rows before pictures are made smaller.
        sources: how many pictures the clip itself has, about.
        names: what the pictures of a folder are called, without ending; none for a video.
        remarks: a sentence for each thing the user should know.
    """

    width: int
    height: int
    fps: float
    frames: int
    duration: float
    full_width: int
    full_height: int
    sources: int
    names: tuple[str, ...] = ()
    remarks: tuple[str, ...] = ()


@dataclass(frozen=True)
class Picture:
    """One picture of a clip.

    Attributes:
        index: how many came before it.
        seconds: since the first one: index / fps.
        image: 8-bit sRGB.
        source: which picture of the clip itself it is, counted from 0 and before any are left out.
    """

    index: int
    seconds: float
    image: UInt8[np.ndarray, "h w 3"]
    source: int


@final
class Frames:
    """The pictures of a clip in order, decoded while they are asked for; may be gone through again.

    Attributes:
        info: what will come.
        remarks: sentences for the user; complete when all pictures have come.
    """

    def __init__(self, clip: Path | str, fps: float | int | None = None, max_size: int | None = None) -> None:
        """See `describe` for the arguments and errors."""
        self._clip, self._files, self._video, self.info = _look_at(Path(clip), fps, max_size)
        self.remarks = self.info.remarks

    def __iter__(self) -> Iterator[Picture]:
        """Every picture.

        Raises:
            TwofoldError: one in a folder is damaged.
        """
        self.remarks = self.info.remarks
        if self._video is None:
            for index, path in enumerate(self._files):
                yield Picture(index, index / self.info.fps, read_picture(path, self.info), index)
            return
        late: list[str] = []
        convert = Converter(self._video, self.info.width, self.info.height)
        timed = decode(self._clip, self._video, late)
        for index, (source, frame) in enumerate(nearest_in_time(timed, self.info.fps)):
            yield Picture(index, index / self.info.fps, convert(frame), source)
        self.remarks = (*self.info.remarks, *late)


def describe(clip: Path | str, fps: float | int | None = None, max_size: int | None = None) -> ClipInfo:
    """What will come of a clip; only its first picture is decoded.

    Args:
        clip: a video in any form that FFmpeg reads, turned upright as it asks for, or a folder of pictures, taken in
            natural order (2 before 10).
        fps: pictures per second, each the nearest in time; by default a video's average. For a folder: how fast its
            pictures were taken (30 by default); all of them come.
        max_size: the longer side is made this long at most, in pixels; averaged over areas.

    Raises:
        TwofoldError: missing, damaged, of another kind, sound only; a folder without pictures or with pictures of
            several sizes; an impossible `fps` or `max_size`.
    """
    return _look_at(Path(clip), fps, max_size)[3]


def nearest_in_time(timed: Iterable[tuple[float, Item]], fps: float | int) -> Iterator[tuple[int, Item]]:
    """What is nearest to 0, 1/fps, 2/fps, ... seconds, with its number; of two as near, the first.

    Args:
        timed: seconds, from 0 on and growing, and what is there. Only one of them is kept at a time.
        fps: steps per second. The last step is at most half a gap behind the end.

    >>> list(nearest_in_time([(0.0, "a"), (0.1, "b"), (0.4, "c")], fps=5))
    [(0, 'a'), (1, 'b'), (2, 'c')]
    """
    step, gap, before = 0, 0.0, None
    for number, (seconds, item) in enumerate(timed):
        while before is not None and step / fps <= (before[0] + seconds) / 2:
            yield before[1:]
            step += 1
        gap = 0.0 if before is None else seconds - before[0]
        before = seconds, number, item
    while before is not None and step / fps <= before[0] + 0.5 * gap:
        yield before[1:]
        step += 1


def natural_order(name: str) -> tuple[tuple[int, int, str], ...]:
    """A key that sorts numbers within names by their size.

    >>> sorted(["b10", "b9", "a"], key=natural_order)
    ['a', 'b9', 'b10']
    """
    parts = re.findall(r"[0-9]+|[^0-9]+", name.lower())
    return (*((0, int(part), "") if part.isdecimal() else (1, 0, part) for part in parts), (0, 0, name))


def picture_files(folder: Path) -> tuple[Path, ...]:
    """The pictures in a folder in natural order.

    Raises:
        TwofoldError: there is none.
    """
    return files_with(folder, PICTURE_ENDINGS, "pictures; expected PNG or JPEG files, one for each frame")


def files_with(folder: Path, endings: tuple[str, ...], what: str) -> tuple[Path, ...]:
    """Files of some kinds in natural order; hidden ones are left out.

    Raises:
        TwofoldError: there is none ("holds no" `what`), or the folder cannot be read.
    """
    try:
        found = [p for p in folder.iterdir() if p.suffix.lower() in endings and not p.name.startswith(".")]
    except OSError as error:
        raise TwofoldError(f"The folder {folder} cannot be read ({error.strerror}); check its permissions.") from error
    if not found:
        raise TwofoldError(f"The folder {folder} holds no {what}.")
    return tuple(sorted(found, key=lambda path: natural_order(path.name)))


def files_by_picture(files: Sequence[Path], info: ClipInfo, what: str) -> dict[int, Path]:
    """Which picture of a clip each file belongs to, counted as `Picture.source` is.

    By name, if the clip is a folder whose pictures are called the same; else by the last number in the name, counted
    from 0 or 1; else, where there are no such numbers or they are too large, in natural order, one for each picture.

    Args:
        files: in natural order, all of one folder.
        info: the clip.
        what: they are, for the sentences: "masks".

    Raises:
        TwofoldError: they belong to no picture, or there is another number of them.
    """
    places = {name: place for place, name in enumerate(info.names)}
    if len(places) == len(info.names) and all(path.stem in places for path in files):
        return {places[path.stem]: path for path in files}
    slack = max(1, info.sources // 50)  # What a video says of its length is not always right.
    last_numbers = [re.findall(r"[0-9]+", path.stem)[-1:] for path in files]
    numbers = [int(found[0]) for found in last_numbers if found]
    if len(set(numbers)) == len(files):
        from_one = min(numbers) == 1 or (min(numbers) > 1 and max(numbers) >= info.sources)
        if max(numbers) - from_one < info.sources + slack:
            return {number - from_one: path for number, path in zip(numbers, files, strict=True)}
    if abs(len(files) - info.sources) <= slack:
        return dict(enumerate(files))
    numbered = f", numbered from {min(numbers)} to {max(numbers)}" if len(set(numbers)) == len(files) else ""
    raise TwofoldError(
        f"{files[0].parent} holds {len(files)} {what}{numbered}, and the clip has {info.sources} pictures; number them "
        "as its pictures are, from 0, or give one for each."
    )


def picture_size(path: Path) -> tuple[int, int]:
    """Columns and rows of a picture as it is meant to be seen; its pixels are not read.

    Raises:
        TwofoldError: it is no picture.
    """
    return upright_size(path)


def read_picture(path: Path, info: ClipInfo) -> UInt8[np.ndarray, "h w 3"]:
    """One picture of a folder, upright and of the clip's size; transparency is ignored.

    Raises:
        TwofoldError: it cannot be decoded.
    """
    image = load_image(path)
    upright = ImageOps.exif_transpose(image)
    if image.mode.startswith("I;16"):  # Pillow would cut off what is brighter than 255.
        upright = Image.fromarray((np.asarray(upright) >> 8).astype(np.uint8))
    upright = upright.convert("RGB")
    if upright.size != (info.width, info.height):
        upright = upright.resize((info.width, info.height), Image.Resampling.BOX)
    return np.asarray(upright)


def shrunk(width: int, height: int, max_size: int | None) -> tuple[int, int]:
    """Columns and rows with the longer side at most `max_size`.

    >>> shrunk(1920, 1080, 960)
    (960, 540)
    """
    if max_size is None or max(width, height) <= max_size:
        return width, height
    scale = max_size / max(width, height)
    return max(round(width * scale), 1), max(round(height * scale), 1)


def _look_at(
    clip: Path, fps: float | int | None, max_size: int | None
) -> tuple[Path, tuple[Path, ...], VideoInfo | None, ClipInfo]:
    """The clip, its pictures if it is a folder, else what kind of video it is; and what will come of it."""
    if fps is not None and not 0.01 <= fps <= 1000:
        raise TwofoldError(f"The frame rate {fps:g} makes no sense; give pictures per second, 10 for example.")
    if max_size is not None and max_size < 64:
        raise TwofoldError(f"Pictures with a longer side of {max_size} show too little; give at least 64 pixels.")
    if clip.is_dir():
        files = picture_files(clip)
        width, height = picture_size(files[0])
        for path in files[1:]:
            if (size := picture_size(path)) != (width, height):
                raise TwofoldError(
                    f"The pictures in {clip} have several sizes: {files[0].name} is {width} x {height}, {path.name} is "
                    f"{size[0]} x {size[1]}; keep those of one clip."
                )
        rate, names = float(fps or USUAL_FPS), tuple(path.stem for path in files)
        count = len(files)
        small = shrunk(width, height, max_size)
        return clip, files, None, ClipInfo(*small, rate, count, count / rate, width, height, count, names)
    video = describe_video(clip)
    if fps is not None and fps > _FASTER * video.fps:
        raise TwofoldError(
            f"{fps:g} pictures a second were asked for, and {clip.name} has {video.fps:.4g}; ask for that at most."
        )
    rate = float(fps or video.fps)
    count = max(round(video.frames * rate / video.fps), 1)
    small = shrunk(video.width, video.height, max_size)
    full = video.width, video.height
    return clip, (), video, ClipInfo(*small, rate, count, count / rate, *full, video.frames, (), video.remarks)
