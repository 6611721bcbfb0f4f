"""Values of image files with more than 8 bits: what is white there is decided once for all files of a folder."""

from collections.abc import Iterable, Sequence
from pathlib import Path

import av
import numpy as np
from av.error import FFmpegError
from jaxtyping import Shaped, UInt8

from twofold.errors import TwofoldError
from twofold.images import Header, load_image, read_header

DEPTHS = (8, 10, 12, 14, 16)
"""Bits that cameras and programs store in 16."""
SAMPLE = 200
"""Files of a folder whose values are looked at."""
_HIGHLIGHTS = 8.0
"""Floating-point values up to here have their white at 1 and brighter highlights; larger ones count as integers do."""
_GREY = ("I;16", "I;16B", "I;16L", "I;16N", "I", "F")


def deep_values(path: Path, header: Header | None = None) -> Shaped[np.ndarray, "h w *c"]:
    """The numbers that a file with more than 8 bits holds, grey (h w) or colour (h w 3).

    Args:
        path: the file.
        header: its own.

    Raises:
        TwofoldError: it cannot be decoded.
    """
    if (header or read_header(path)).mode in _GREY:
        return np.asarray(load_image(path))
    # Pillow reads colours of 16 bits as 8, by cutting off the lower ones.
    try:
        with av.open(str(path.absolute()), options={"protocol_whitelist": "file"}) as container:
            frame = next(container.decode(video=0))
    except (FFmpegError, StopIteration, OSError) as error:
        raise TwofoldError(f"{path} is damaged ({error}); save it again as PNG.") from error
    return frame.reformat(format="rgb48le").to_ndarray()


def white_level(files: Sequence[Path]) -> tuple[float, list[str]]:
    """The value that is white in all files of a folder, and sentences for the user where it had to be inferred.

    Files of 8 bits have 255. Of integers with 16 bits it is the largest value of the fewest bits (8, 10, 12, 14, 16)
    that holds all of them, of floating-point values 1, unless they are as large as integers are.

    Args:
        files: all of one folder.

    Raises:
        TwofoldError: one of them cannot be decoded.
    """
    peak, floating, deep = 0.0, False, False
    for path in spread_evenly(files, SAMPLE):
        header = read_header(path)
        if not header.deep:
            continue
        values = deep_values(path, header)
        deep, floating = True, floating or values.dtype.kind == "f"
        peak = max(peak, float(np.nan_to_num(values, nan=0.0, posinf=0.0, neginf=0.0).max(initial=0)))
    if not deep:
        return 255.0, []
    return inferred_white(peak, floating, str(files[0].parent))


def inferred_white(peak: float, floating: bool, where: str) -> tuple[float, list[str]]:
    """The value of white where the largest value is `peak`; see `white_level`.

    >>> inferred_white(65535.0, False, "x")
    (65535.0, [])
    >>> inferred_white(0.9, True, "x")[0], inferred_white(4000.0, False, "x")[0]
    (1.0, 4095.0)
    """
    if floating and peak <= _HIGHLIGHTS:
        return 1.0, []
    white = next((2.0**bits - 1 for bits in DEPTHS if peak <= 2**bits - 1), 65535.0)
    if white == 65535 and not floating:
        return white, []
    return white, [f"Files in {where} hold values up to {peak:g}; {white:g} is taken as white."]


def to_8_bits(values: Shaped[np.ndarray, "*s"], white: float) -> UInt8[np.ndarray, "*s"]:
    """Values from 0 to `white` as 0..255; what is no number is 0.

    >>> to_8_bits(np.array([0, 4095, 9000], np.uint16), 4095.0).tolist()
    [0, 255, 255]
    """
    finite = np.nan_to_num(values.astype(np.float64), nan=0.0, posinf=white, neginf=0.0)
    return np.round(np.clip(finite * (255 / white), 0, 255)).astype(np.uint8)


def spread_evenly(files: Sequence[Path], most: int) -> Iterable[Path]:
    """At most this many files, evenly spread."""
    return [files[int(i)] for i in np.unique(np.linspace(0, len(files) - 1, min(len(files), most)).round())]
