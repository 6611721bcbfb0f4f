"""Pictures as an MP4 that browsers, slides and phones play."""

from collections.abc import Iterable
from fractions import Fraction
from pathlib import Path

import av
import numpy as np
from av.container import OutputContainer
from av.video.reformatter import ColorRange, Colorspace
from jaxtyping import UInt8

from twofold.files import write_atomically

QUALITY = "18"
"""x264's constant rate factor: lower is better and larger; at 18 a loss is hard to see."""


def write_video(path: Path | str, frames: Iterable[UInt8[np.ndarray, "h w 3"]], fps: float | int) -> None:
    """Writes frames as they come, one at a time, as H.264 (or MPEG-4 where the library has no x264).

    Colours are stored with half the resolution (yuv420p: all players know it), so odd sides get one more row or column,
    a copy of the last.

    Args:
        path: ends in .mp4.
        frames: all of one size.
        fps: pictures per second.

    Raises:
        ValueError: there is no frame, or one has another size than the first.
        TwofoldError: the file cannot be written.
    """
    with write_atomically(path) as temporary, av.open(str(temporary), "w", options={"movflags": "faststart"}) as file:
        stream, size = None, (0, 0)
        for picture in frames:
            if stream is None:
                stream, size = _add_stream(file, picture.shape, fps), picture.shape[:2]
            if picture.shape[:2] != size:
                raise ValueError(f"a frame of the video is {picture.shape[:2]}, the first was {size}")
            padded = np.pad(picture, ((0, size[0] % 2), (0, size[1] % 2), (0, 0)), mode="edge")
            frame = av.VideoFrame.from_ndarray(padded, format="rgb24")
            limited = {"dst_colorspace": Colorspace.ITU709, "dst_color_range": ColorRange.MPEG}
            file.mux(stream.encode(frame.reformat(format="yuv420p", **limited)))
        if stream is None:
            raise ValueError("a video needs at least one frame")
        file.mux(stream.encode())


def _add_stream(file: OutputContainer, shape: tuple[int, ...], fps: float | int) -> av.VideoStream:
    codec = "libx264" if "libx264" in av.codecs_available else "mpeg4"
    stream = file.add_stream(codec, rate=Fraction(fps).limit_denominator(1001))
    stream.height, stream.width = shape[0] + shape[0] % 2, shape[1] + shape[1] % 2
    stream.pix_fmt = "yuv420p"
    stream.options = {"crf": QUALITY} if codec == "libx264" else {"qscale": "3"}
    # Without these marks a player guesses the matrix from the picture's size, and colours shift.
    stream.codec_context.colorspace = Colorspace.ITU709
    stream.codec_context.color_range = ColorRange.MPEG
    return stream
