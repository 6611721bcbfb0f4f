"""Images as an MP4 that browsers, slides and phones play."""

from collections.abc import Iterable
from fractions import Fraction
from pathlib import Path

import av
import numpy as np
from av.video.reformatter import ColorRange, Colorspace
from jaxtyping import UInt8

from twofold.errors import TwofoldError
from twofold.files import write_atomically

ALPHA_CODECS: dict[str, tuple[str, str, dict[str, str]]] = {
    ".webm": ("libvpx-vp9", "yuva420p", {"crf": "24", "b": "0", "cpu-used": "4", "row-mt": "1"}),
    ".mov": ("prores_ks", "yuva444p10le", {"profile": "4444"}),
}
"""Codec, pixels and options of videos with opacity: browsers play WebM, video editors read MOV."""

QUALITY = "18"
"""x264's constant rate factor: lower is better and larger; at 18 a loss is hard to see."""


def write_video(path: Path | str, frames: Iterable[UInt8[np.ndarray, "h w 3"]], fps: float | int) -> None:
    """Writes frames as they come, one at a time, as H.264 (or MPEG-4 where the library has no x264).

    Colours are stored with half the resolution (yuv420p: all players know it), so odd sides get one more row or column,
    a copy of the last. The same frames give the same bytes.

    Args:
        path: ends in .mp4.
        frames: all of one size.
        fps: images per second.

    Raises:
        ValueError: there is no frame, or one has another size than the first.
        TwofoldError: the file cannot be written.
    """
    x264 = "libx264" in av.codecs_available
    # A player takes the matrix that is marked; MPEG-4 has no place for a mark and is taken for the older one.
    matrix = Colorspace.ITU709 if x264 else Colorspace.ITU601
    with write_atomically(path) as temporary, av.open(str(temporary), "w", options={"movflags": "faststart"}) as file:
        stream, size = None, (0, 0)
        for image in frames:
            if stream is None:
                size = image.shape[:2]
                stream = file.add_stream("libx264" if x264 else "mpeg4", rate=Fraction(fps).limit_denominator(1001))
                stream.height, stream.width = size[0] + size[0] % 2, size[1] + size[1] % 2
                stream.pix_fmt = "yuv420p"
                stream.options = {"crf": QUALITY} if x264 else {"qscale": "3"}
                stream.codec_context.colorspace = matrix
                stream.codec_context.thread_count = 1  # with more, the bytes depend on how many processors there are
            if image.shape[:2] != size:
                raise ValueError(f"a frame of the video is {image.shape[:2]}, the first was {size}")
            padded = np.pad(image, ((0, size[0] % 2), (0, size[1] % 2), (0, 0)), mode="edge")
            frame = av.VideoFrame.from_ndarray(padded, format="rgb24")
            limited = frame.reformat(format="yuv420p", dst_colorspace=matrix, dst_color_range=ColorRange.MPEG)
            file.mux(stream.encode(limited))
        if stream is None:
            raise ValueError("a video needs at least one frame")
        file.mux(stream.encode())


def write_alpha_video(path: Path | str, frames: Iterable[UInt8[np.ndarray, "h w 4"]], fps: float | int) -> None:
    """Writes frames with opacity as they come: VP9 in a WebM, ProRes 4444 in a MOV (Apple's QuickTime).

    The same frames give the same bytes.

    Args:
        path: ends in a key of `ALPHA_CODECS`.
        frames: straight (not premultiplied) colour and opacity, all of one size.
        fps: frames per second.

    Raises:
        ValueError: there is no frame.
        TwofoldError: the file cannot be written, or the library lacks the codec.
    """
    ending = Path(path).suffix.lower()
    codec, pixels, options = ALPHA_CODECS[ending]
    if codec not in av.codecs_available:
        raise TwofoldError(
            f"The installed PyAV lacks {codec}, which {ending} with opacity needs; name a folder instead."
        )
    exact = {"fflags": "+bitexact"}  # else a WebM gets a random number of its own
    with write_atomically(path) as temporary, av.open(str(temporary), "w", options=exact) as file:
        stream = None
        for image in frames:
            if stream is None:
                stream = file.add_stream(codec, rate=Fraction(fps).limit_denominator(1001))
                stream.height, stream.width = image.shape[0] + image.shape[0] % 2, image.shape[1] + image.shape[1] % 2
                stream.pix_fmt, stream.options = pixels, options
                stream.codec_context.colorspace = Colorspace.ITU709
                stream.codec_context.thread_count = 1
            padded = np.pad(image, ((0, image.shape[0] % 2), (0, image.shape[1] % 2), (0, 0)), mode="edge")
            frame = av.VideoFrame.from_ndarray(padded, format="rgba")
            limited = frame.reformat(format=pixels, dst_colorspace=Colorspace.ITU709, dst_color_range=ColorRange.MPEG)
            file.mux(stream.encode(limited))
        if stream is None:
            raise ValueError("a video needs at least one frame")
        file.mux(stream.encode())
