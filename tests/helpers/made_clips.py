"""Clips for tests, made on the spot."""

import struct
from collections.abc import Sequence
from fractions import Fraction
from pathlib import Path

import av
import numpy as np
import pytest

CLIPS = Path(__file__).parents[3] / "shared" / "data" / "video"
UPRIGHT, RIGHT, UPSIDE_DOWN, LEFT = (1, 0, 0, 1), (0, 1, -1, 0), (-1, 0, 0, -1), (0, -1, 1, 0)


def real_clip(name: str) -> Path:
    path = CLIPS / name
    if not path.exists():
        pytest.skip(f"the clip {name} is not here")
    return path


def corners(height: int = 48, width: int = 64) -> np.ndarray:
    """Red at the top left, green at the top right, blue at the bottom left, black at the bottom right."""
    image = np.zeros((height, width, 3), np.uint8)
    image[: height // 2, : width // 2] = [255, 0, 0]
    image[: height // 2, width // 2 :] = [0, 255, 0]
    image[height // 2 :, : width // 2] = [0, 0, 255]
    return image


def grey(level: int, height: int = 48, width: int = 64) -> np.ndarray:
    return np.full((height, width, 3), level, np.uint8)


def write_clip(
    path: Path, images: Sequence[np.ndarray], fps: int = 25, seconds: Sequence[float] | None = None,
    pixel_aspect: str | None = None, first_to_last: bool = False,
) -> Path:  # fmt: skip
    """An H.264 (or MPEG-4) video; `first_to_last` puts what a reader needs first at the beginning of an MP4."""
    codec = "libx264" if "libx264" in av.codecs_available else "mpeg4"
    options = {"movflags": "faststart"} if first_to_last else {}
    with av.open(str(path), "w", options=options) as file:
        stream = file.add_stream(codec, rate=fps)
        stream.height, stream.width = images[0].shape[:2]
        stream.pix_fmt = "yuv420p"
        stream.codec_context.time_base = Fraction(1, 10000)
        stream.options = {"crf": "12"} if codec == "libx264" else {"qscale": "2"}
        if pixel_aspect:
            stream.codec_context.sample_aspect_ratio = Fraction(pixel_aspect)
        for index, image in enumerate(images):
            frame = av.VideoFrame.from_ndarray(image, format="rgb24").reformat(format="yuv420p")
            frame.pts = round(10000 * (index / fps if seconds is None else seconds[index]))
            frame.time_base = Fraction(1, 10000)
            file.mux(stream.encode(frame))
        file.mux(stream.encode())
    return path


def write_deep_clip(
    path: Path, images: Sequence[np.ndarray], transfer: int, primaries: int, matrix: int, form: str = "yuv444p10le"
) -> Path:
    """A lossless HEVC video of 10 bits with colour tags, as phones write them but for the losses.

    Args:
        path: to write.
        images: Y'CbCr of 10 bits (limited range), height x width x 3.
        transfer: number of the transfer function (ISO/IEC 23091-2): 18 is HLG, 16 PQ, 1 BT.709.
        primaries: 9 is BT.2020, 12 P3, 1 BT.709.
        matrix: 9 is BT.2020's, 1 BT.709's.
        form: of the pixels; of a subsampled one every second chroma sample is taken.
    """
    if "libx265" not in av.codecs_available:
        pytest.skip("this FFmpeg has no encoder of HEVC")
    with av.open(str(path), "w") as file:
        stream = file.add_stream("libx265", rate=25)
        stream.height, stream.width = images[0].shape[:2]
        stream.pix_fmt = form
        stream.options = {
            "x265-params": "lossless=1:log-level=none:pools=none:frame-threads=1:bframes=0:repeat-headers=0",
            "preset": "ultrafast",
        }
        tags = {"color_trc": transfer, "color_primaries": primaries, "colorspace": matrix, "color_range": 1}
        for name, number in tags.items():
            setattr(stream.codec_context, name, number)
        for index, image in enumerate(images):
            frame = av.VideoFrame(image.shape[1], image.shape[0], form)
            for k, plane in enumerate(frame.planes):
                step = 1 if k == 0 or "444" in form else 2
                values = np.zeros((plane.height, plane.line_size // 2), np.uint16)
                part = image[::step, ::step, k]
                values[:, : part.shape[1]] = part
                plane.update(values.tobytes())
            for name, number in tags.items():
                setattr(frame, name, number)
            frame.pts, frame.time_base = index, Fraction(1, 25)
            file.mux(stream.encode(frame))
        file.mux(stream.encode())
    return path


def write_sound(path: Path) -> Path:
    with av.open(str(path), "w") as file:
        stream = file.add_stream("aac", rate=16000)
        for start in range(0, 16000, 1024):
            sound = av.AudioFrame.from_ndarray(np.zeros((1, 1024), np.float32), format="fltp", layout="mono")
            sound.sample_rate, sound.pts = 16000, start
            file.mux(stream.encode(sound))
        file.mux(stream.encode())
    return path


def hold_phone(path: Path, matrix: Sequence[float]) -> Path:
    """Writes into an MP4 how the phone was held: where a step to the right goes (a, b), where one down goes (c, d)."""
    content = bytearray(path.read_bytes())
    header = content.index(b"tkhd") + 4
    place = header + (40 if content[header] == 0 else 52)
    a, b, c, d = (round(65536 * value) for value in matrix)
    content[place : place + 36] = struct.pack(">9i", a, b, 0, c, d, 0, 0, 0, 1 << 30)
    path.write_bytes(content)
    return path
