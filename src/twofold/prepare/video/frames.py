"""A video, or a folder of images, as upright images at even steps of time."""

import re
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar, final

import numpy as np
from jaxtyping import UInt8
from PIL import Image, ImageOps

from twofold.errors import TwofoldError
from twofold.images import load_image, read_header, upright_size
from twofold.prepare.video.decoding import Converter, VideoInfo, decode, describe_video
from twofold.prepare.video.focal import focal_of_image
from twofold.prepare.video.intensity import deep_values, to_8_bits, white_level

IMAGE_ENDINGS = (".png", ".jpg", ".jpeg", ".webp", ".bmp", ".tif", ".tiff")
USUAL_FPS = 30.0
"""Taken for a folder of images, which cannot say it."""
Item = TypeVar("Item")

_ORIENTATION = 0x0112  # The EXIF field.
_FASTER = 1.1  # More images than a clip has would come twice; clips state their rate only roughly.


@dataclass(frozen=True)
class ClipInfo:
    """What will come of a clip.

    Attributes:
        width: columns of each image.
        height: rows of each image.
        fps: images per second, on average.
        frames: how many, about; damaged ones are counted here and do not come.
        duration: seconds, about.
        full_width: columns before images are made smaller.
        full_height: rows before images are made smaller.
        sources: how many images the clip itself has.
        names: what the images of a folder are called, without ending; none for a video.
        remarks: a sentence for each thing the user should know.
        white: the value of white in images of a folder (`intensity.white_level`); 255 for a video.
        focal: focal length over the longer side, as the file (the first of a folder) states it; None where it does not.
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
    white: float = 255.0
    focal: float | None = None


@dataclass(frozen=True)
class VideoFrame:
    """One image of a clip.

    Attributes:
        index: how many came before it.
        seconds: when it was taken, since the first one, by its own time stamp.
        image: 8-bit sRGB.
        source: which image of the clip itself it is, counted from 0 and before any are left out.
        step: the even step of time (step / fps seconds) that it stands for; grows, with gaps where the clip has no
            image near a step.
    """

    index: int
    seconds: float
    image: UInt8[np.ndarray, "h w 3"]
    source: int
    step: int


@final
class Frames:
    """The images of a clip in order, each once, decoded while they are asked for; may be gone through again.

    Attributes:
        info: what will come.
        remarks: sentences for the user; complete when all images have come.
    """

    def __init__(
        self, clip: Path | str, fps: float | int | None = None, max_size: int | None = None, even: bool = False
    ) -> None:
        """See `describe` for the other arguments and errors.

        Args:
            clip: see `describe`.
            fps: see `describe`.
            max_size: see `describe`.
            even: takes the nearest to even steps of time where no `fps` is given, too, as clips need it that are
                compared with each other.
        """
        self._clip, self._files, self._video, self.info = _look_at(Path(clip), fps, max_size)
        self._even = even or fps is not None
        self.remarks = self.info.remarks

    def __iter__(self) -> Iterator[VideoFrame]:
        """Every image.

        Raises:
            TwofoldError: one in a folder is damaged.
        """
        self.remarks = self.info.remarks
        if self._video is None:
            for index, path in enumerate(self._files):
                yield VideoFrame(index, index / self.info.fps, read_picture(path, self.info), index, index)
            return
        late: list[str] = []
        convert = Converter(self._video, self.info.width, self.info.height)
        timed = decode(self._clip, self._video, late)
        numbered = ((source, source, *found) for source, found in enumerate(timed))
        for index, (step, source, seconds, frame) in enumerate(
            nearest_to_steps(timed, self.info.fps) if self._even else numbered
        ):
            yield VideoFrame(index, seconds, convert(frame), source, step)
        self.remarks = (*self.info.remarks, *late)


def describe(clip: Path | str, fps: float | int | None = None, max_size: int | None = None) -> ClipInfo:
    """What will come of a clip; only its first image is decoded.

    Args:
        clip: a video in any form that FFmpeg reads, turned upright as it asks for, or a folder of images, taken in
            natural order (2 before 10).
        fps: images per second; of those nearest to one step of time one comes, and none comes twice. By default all
            images of a video come, at their own times. For a folder: how fast its images were taken (30 by
            default); all of them come.
        max_size: the longer side is made this long at most, in pixels; averaged over areas.

    Raises:
        TwofoldError: missing, damaged, of another kind, sound only; a folder without images or with images of
            several sizes; an impossible `fps` or `max_size`.
    """
    return _look_at(Path(clip), fps, max_size)[3]


def nearest_to_steps(timed: Iterable[tuple[float, Item]], fps: float | int) -> Iterator[tuple[int, int, float, Item]]:
    """For each of the steps 0, 1/fps, 2/fps, ... seconds the nearest of the items that are nearest to this step.

    No item comes twice: a step with no item of its own is left out. Only one item is kept at a time.

    Args:
        timed: seconds, from 0 on and growing, and what is there.
        fps: steps per second. The last step is at most half a gap behind the end.

    Yields:
        Step, number of the item, its seconds and the item; of two as near, the first.

    >>> [found[:2] for found in nearest_to_steps([(0.0, "a"), (0.15, "b"), (0.4, "c")], fps=5)]
    [(0, 0), (1, 1), (2, 2)]
    >>> [found[:2] for found in nearest_to_steps([(0.0, "a"), (0.6, "b")], fps=5)]
    [(0, 0), (3, 1)]
    """
    best: tuple[int, int, float, Item] | None = None
    last = gap = 0.0
    for number, (seconds, item) in enumerate(timed):
        step = int(np.ceil(seconds * fps - 0.5 - 1e-9))
        last, gap = seconds, seconds - last
        if best is None or step > best[0]:
            if best is not None:
                yield best
            best = step, number, seconds, item
        elif abs(seconds * fps - step) < abs(best[2] * fps - step) - 1e-9:
            best = step, number, seconds, item
    if best is not None and best[0] / fps <= last + 0.5 * gap + 1e-9:
        yield best


def natural_order(name: str) -> tuple[tuple[int, int, str], ...]:
    """A key that sorts numbers within names by their size.

    >>> sorted(["b10", "b9", "a"], key=natural_order)
    ['a', 'b9', 'b10']
    """
    parts = re.findall(r"[0-9]+|[^0-9]+", name.lower())
    return (*((0, int(part), "") if part.isdecimal() else (1, 0, part) for part in parts), (0, 0, name))


def picture_files(folder: Path) -> tuple[Path, ...]:
    """The images in a folder in natural order.

    Raises:
        TwofoldError: there is none.
    """
    return files_with(folder, IMAGE_ENDINGS, "images; expected PNG or JPEG files, one for each frame")


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


def picture_size(path: Path) -> tuple[int, int]:
    """Columns and rows of an image as it is meant to be seen; its pixels are not read.

    Raises:
        TwofoldError: it is no image.
    """
    return upright_size(path)


def read_picture(path: Path, info: ClipInfo) -> UInt8[np.ndarray, "h w 3"]:
    """One image of a folder, upright and of the clip's size; transparency is ignored.

    Raises:
        TwofoldError: it cannot be decoded.
    """
    image = load_image(path)
    header = read_header(path)
    if header.deep:  # Pillow would cut off what is brighter than 255, or keep the upper half of the bits.
        turn = 1 if header.upright else image.getexif().get(_ORIENTATION, 1)
        image = Image.fromarray(to_8_bits(deep_values(path, header), info.white))
        image.getexif()[_ORIENTATION] = turn
    upright = ImageOps.exif_transpose(image).convert("RGB")
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
    """The clip, its images if it is a folder, else what kind of video it is; and what will come of it."""
    if fps is not None and not 0.01 <= fps <= 1000:
        raise TwofoldError(f"The frame rate {fps:g} makes no sense; give images per second, 10 for example.")
    if max_size is not None and max_size < 64:
        raise TwofoldError(f"Images with a longer side of {max_size} show too little; give at least 64 pixels.")
    if clip.is_dir():
        files = picture_files(clip)
        width, height = picture_size(files[0])
        for path in files[1:]:
            if (size := picture_size(path)) != (width, height):
                raise TwofoldError(
                    f"The images in {clip} have several sizes: {files[0].name} is {width} x {height}, {path.name} is "
                    f"{size[0]} x {size[1]}; keep those of one clip."
                )
        rate, names = float(fps or USUAL_FPS), tuple(path.stem for path in files)
        count = len(files)
        small = shrunk(width, height, max_size)
        white, remarks = white_level(files)
        return clip, files, None, ClipInfo(
            *small, rate, count, count / rate, width, height, count, names, tuple(remarks), white,
            focal_of_image(files[0]),
        )  # fmt: skip
    video = describe_video(clip)
    if fps is not None and fps > _FASTER * video.fps:
        raise TwofoldError(
            f"{fps:g} images a second were asked for, and {clip.name} has {video.fps:.4g}; ask for that at most."
        )
    rate = float(fps or video.fps)
    count = max(round(video.frames * rate / video.fps), 1)
    small = shrunk(video.width, video.height, max_size)
    full = video.width, video.height
    info = ClipInfo(*small, rate, count, count / rate, *full, video.frames, remarks=video.remarks, focal=video.focal)
    return clip, (), video, info
