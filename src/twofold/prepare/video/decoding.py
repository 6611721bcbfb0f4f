"""A video file as upright images, one after the other, each with its time."""

import contextlib
from collections.abc import Generator, Iterator
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path

import av
import numpy as np
from av.container import InputContainer
from av.error import FFmpegError
from av.stream import Disposition
from av.video.reformatter import Colorspace, Interpolation, VideoReformatter
from av.video.stream import VideoStream
from jaxtyping import Shaped, UInt8

from twofold.errors import TwofoldError
from twofold.inputs import is_there, require_file, shown_path
from twofold.prepare.video.focal import focal_of_video
from twofold.prepare.video.hdr import ColorSpace, to_srgb

_LONGEST_GAP = 5.0  # Seconds; what is longer is a fault of the file's clock, not a pause.
_USUAL_RATE = Fraction(25)
_SAME_RATE = 0.01  # Time stamps are rounded, often to milliseconds: rates that differ by less are the same.


@dataclass(frozen=True)
class Orientation:
    """How stored images are brought upright: first transposed, then reversed.

    Attributes:
        transpose: rows become columns.
        flip_rows: the last row comes first.
        flip_columns: the last column comes first.
        off: angle between this and what the file asks for, degrees.
    """

    transpose: bool = False
    flip_rows: bool = False
    flip_columns: bool = False
    off: float = 0.0

    def upright(self, image: Shaped[np.ndarray, "h w *c"]) -> Shaped[np.ndarray, "H W *c"]:
        """A stored image as it is meant to be seen."""
        turned = np.swapaxes(image, 0, 1) if self.transpose else image
        turned = turned[::-1] if self.flip_rows else turned
        return turned[:, ::-1] if self.flip_columns else turned


def orientation(matrix: bytes) -> Orientation:
    """What a display matrix asks for, as quarter turns and reflections.

    Args:
        matrix: nine integers of 32 bits, of which a, b and c, d say where steps to the right and down go (ISO/IEC
            14496-12, 8.3.2); it is how phones say how they were held.
    """
    a, b, _, c, d = np.frombuffer(matrix, "i4")[:5].tolist()
    transpose = abs(b) + abs(c) > abs(a) + abs(d)
    off = np.degrees(np.arctan2(abs(a), abs(b)) if transpose else np.arctan2(abs(b), abs(a)))
    if transpose:
        return Orientation(True, b < 0, c < 0, float(off))
    return Orientation(False, d < 0, a < 0, float(off))


@dataclass(frozen=True)
class VideoInfo:
    """What a file says of its images, held against the first one.

    Attributes:
        width: columns of an upright image with square pixels.
        height: its rows.
        orientation: how it is brought upright.
        fps: images per second by their time stamps, on average.
        frames: how many there are; those that are damaged count.
        duration: seconds, about.
        says_duration: the file itself says how long it is.
        remarks: sentences for the user.
        focal: focal length over the longer side, as the file states it; None where it does not.
        color: how colours are coded.
    """

    width: int
    height: int
    orientation: Orientation
    fps: float
    frames: int
    duration: float
    says_duration: bool
    remarks: tuple[str, ...]
    focal: float | None = None
    color: ColorSpace = ColorSpace(1, 1)


def describe_video(path: Path) -> VideoInfo:
    """What is known after the first image.

    Raises:
        TwofoldError: the file is missing, no video, sound only, or no image in it can be decoded.
    """
    with _opened(path) as (container, stream):
        remarks: list[str] = []
        stated = stream.average_rate or stream.guessed_rate
        first = next(_images(container, stream, []), None)
        if first is None:
            raise TwofoldError(f"No image of {path} can be decoded; it is damaged or empty, export it again.")
        matrix = first.side_data.get("DISPLAYMATRIX")
        turn = Orientation() if matrix is None else orientation(bytes(memoryview(matrix)))
        if turn.off > 3:
            remarks.append(f"{path.name} asks to be turned by {turn.off:.0f} degrees more than it is; it is left so.")
        if first.interlaced_frame:
            remarks.append(f"{path.name} is interlaced, so moving edges are combed; deinterlace it for better results.")
        color = ColorSpace(int(first.color_trc), int(first.color_primaries))
        if not color.is_srgb:
            remarks.append(color.remark(path.name))
        aspect = stream.sample_aspect_ratio or Fraction(1)
        if not Fraction(1, 5) <= aspect <= 5:
            aspect = Fraction(1)
        sides = round(first.width * aspect), first.height
        seconds = _stated_duration(container, stream)
        focal = focal_of_video({**container.metadata, **stream.metadata})
    frames, measured = _clock(path)
    rate = _rate(stated, measured, path, remarks)
    width, height = sides[::-1] if turn.transpose else sides
    duration = seconds or frames / rate
    return VideoInfo(width, height, turn, rate, frames, duration, seconds is not None, tuple(remarks), focal, color)


def _rate(stated: Fraction | None, measured: float | None, path: Path, remarks: list[str]) -> float:
    """Images per second: what the file states where its time stamps agree, else what these show."""
    given = 0.0 if stated is None else float(stated)
    possible = 0.1 <= given <= 1000
    if measured is None or not 0.1 <= measured <= 1000:
        if possible:
            return given
        remarks.append(f"{path.name} does not say its frame rate; {_USUAL_RATE} a second is taken.")
        return float(_USUAL_RATE)
    if possible and abs(measured / given - 1) <= _SAME_RATE:
        return given
    if possible:
        remarks.append(
            f"{path.name} states {given:.4g} frames a second and its time stamps show {measured:.4g} on "
            "average, which is taken; such videos have a variable frame rate, and the fit uses the time of each image."
        )
    return measured


def decode(path: Path, info: VideoInfo, remarks: list[str]) -> Generator[tuple[float, av.VideoFrame]]:
    """The images of a video as they are stored, each with the seconds since the first one.

    Pieces that cannot be decoded are left out. Times always grow: where the file's clock jumps, the next image comes
    one step after the last.

    Args:
        path: the file.
        info: what `describe_video` said of it.
        remarks: sentences for the user are added here, at the end.

    Raises:
        TwofoldError: as `describe_video`.
    """
    damaged: list[str] = []
    start, last, count, jumps = 0.0, -1 / info.fps, 0, 0
    with _opened(path) as (container, stream):
        for frame in _images(container, stream, damaged):
            expected = last + 1 / info.fps
            clock = start + expected if frame.pts is None else frame.time
            start = clock if count == 0 else start
            seconds = clock - start
            if count and not last < seconds <= last + _LONGEST_GAP:
                jumps += 1
                start, seconds = clock - expected, expected
            yield seconds, frame
            last, count = seconds, count + 1
    if jumps:
        remarks.append(f"The clock of {path.name} jumps at {jumps} images; they are taken as following closely.")
    ended = last + 1 / info.fps
    if info.says_duration and ended < info.duration - max(0.5, 0.05 * info.duration):
        remarks.append(
            f"{path.name} ends early: it says {info.duration:.1f} seconds and {ended:.1f} can be read; "
            "the rest is missing or damaged."
        )
    elif damaged:
        remarks.append(f"{path.name} is damaged: {len(damaged)} pieces could not be decoded and are left out.")


class Converter:
    """Makes upright 8-bit sRGB arrays of one size from decoded images."""

    def __init__(self, info: VideoInfo, width: int, height: int) -> None:
        """Images come out with `width` columns and `height` rows, averaged over areas."""
        self._turn, self._color = info.orientation, info.color
        self._stored = (height, width) if info.orientation.transpose else (width, height)
        self._reformatter = VideoReformatter()

    def __call__(self, frame: av.VideoFrame) -> UInt8[np.ndarray, "h w 3"]:
        """The image."""
        width, height = self._stored
        # Players take the newer matrix for large images that name none.
        unnamed = int(frame.colorspace) == 2 and frame.height >= 720
        rgb = self._reformatter.reformat(
            frame, width, height, "rgb24" if self._color.is_srgb else "rgb48le", interpolation=Interpolation.AREA,
            src_colorspace=Colorspace.ITU709 if unnamed else None,
        ).to_ndarray()  # fmt: skip
        return np.ascontiguousarray(self._turn.upright(rgb if self._color.is_srgb else to_srgb(rgb, self._color)))


@contextlib.contextmanager
def _opened(path: Path) -> Generator[tuple[InputContainer, VideoStream]]:
    """The file and its first real video stream."""
    if not is_there(path):
        raise TwofoldError(f"{shown_path(path)} does not exist; correct the path.")
    require_file(path)
    unknown = TwofoldError(
        f"{path} cannot be read as a video (damaged, cut off, or of another kind); export it again, as MP4 say."
    )
    try:
        # Only this very file is read, whatever addresses a playlist may hold.
        container = av.open(str(path.absolute()), options={"protocol_whitelist": "file"}, metadata_errors="ignore")
    except PermissionError as error:
        raise TwofoldError(f"{path} may not be read; change its permissions.") from error
    except (FFmpegError, OSError) as error:
        raise unknown from error
    with container:
        if container.format.name == "tty":  # Plain text, which FFmpeg would paint.
            raise unknown
        covers = Disposition.attached_pic
        videos = [stream for stream in container.streams.video if not stream.disposition & covers]
        if not videos:
            what = "holds only sound" if container.streams.audio else "holds no images"
            raise TwofoldError(f"{path} {what}; a video of a person is needed.")
        stream = videos[0]
        try:
            stream.thread_type = "AUTO"
        except AttributeError as error:  # A stream without a decoder has no such thing
            raise TwofoldError(f"{path} is coded in a way that cannot be decoded here; export it as H.264.") from error
        yield container, stream


def _images(container: InputContainer, stream: VideoStream, damaged: list[str]) -> Iterator[av.VideoFrame]:
    """All images that can be decoded; what cannot is noted in `damaged`."""
    packets = container.demux(stream)
    while True:
        try:
            packet = next(packets)
        except StopIteration:
            return
        except (FFmpegError, OSError) as error:  # Nothing can be read beyond.
            damaged.append(str(error))
            return
        try:
            frames = packet.decode()
        except FFmpegError as error:
            damaged.append(str(error))
            continue
        for frame in frames:
            assert isinstance(frame, av.VideoFrame)
            yield frame


def _stated_duration(container: InputContainer, stream: VideoStream) -> float | None:
    """Seconds, where the file says so."""
    if stream.duration and stream.time_base:
        return float(stream.duration * stream.time_base)
    return container.duration / 1e6 if container.duration and container.duration > 0 else None


def _clock(path: Path) -> tuple[int, float | None]:
    """How many pieces of video there are, and how many a second by their time stamps; nothing is decoded.

    Gaps at which the clock jumps do not count.
    """
    stamps: list[float] = []
    count = 0
    with _opened(path) as (container, stream), contextlib.suppress(FFmpegError, OSError):
        for packet in container.demux(stream):
            if packet.size <= 0 or packet.is_discard:
                continue
            count += 1
            if packet.pts is not None and packet.time_base:
                stamps.append(float(packet.pts * packet.time_base))
    gaps = np.diff(np.sort(np.array(stamps)))
    gaps = gaps[(gaps > 0) & (gaps <= _LONGEST_GAP)]
    return max(count, 1), len(gaps) / float(gaps.sum()) if len(gaps) else None
