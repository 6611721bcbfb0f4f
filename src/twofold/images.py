"""Images from outside: few formats, a limit on their pixels, and always decoded whole before they are used.

Pillow opens some sixty formats, one of which (EPS) starts another program, finds half of all faults only while it
decodes, and warns on standard error. Everything that reads an image goes through here.
"""

import threading
import warnings
from collections.abc import Generator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
from jaxtyping import UInt8
from PIL import Image, UnidentifiedImageError

from twofold.errors import TwofoldError
from twofold.inputs import opened

FORMATS = ("PNG", "JPEG", "WEBP", "TIFF", "BMP")
"""What is read, whatever a file's ending says."""
MAX_PIXELS = 80_000_000
"""Of an image; cameras have half as many, and decompression bombs more."""
_MAX_BYTES = 2**30
_ORIENTATION = 0x0112
_WARNINGS = threading.Lock()
"""Python's list of warnings to be shown belongs to the whole process."""


@dataclass(frozen=True)
class Header:
    """What an image file says before its pixels.

    Attributes:
        width: columns as they are stored.
        height: rows as they are stored.
        mode: Pillow's name of the pixels' kind: "RGB", "L", "I;16", ...
        deep: channels have more than 8 bits, of which Pillow keeps the upper 8 where they are colours.
        upright: it is decoded as it is meant to be seen, or needs no turn for that.
    """

    width: int
    height: int
    mode: str
    deep: bool = False
    upright: bool = True


def read_header(path: Path) -> Header:
    """What an image file says of itself; its pixels are not decoded.

    Raises:
        TwofoldError: it is missing, no image in one of `FORMATS`, or has more than `MAX_PIXELS`.
    """
    with _opened(path) as image:
        deep = image.mode.startswith("I") or image.mode == "F" or ";16" in str(getattr(image, "tile", ""))
        upright = _orientation(image) == 1
        return Header(*image.size, image.mode, deep, upright)


def upright_size(path: Path) -> tuple[int, int]:
    """Columns and rows of an image as it is meant to be seen (its EXIF orientation), before or after it is brought so.

    Raises:
        TwofoldError: see `read_header`; or what it says of its orientation is damaged.
    """
    with _opened(path) as image:
        width, height = image.size
        return (height, width) if _orientation(image) in (5, 6, 7, 8) else (width, height)


def load_image(path: Path) -> Image.Image:
    """An image with all its pixels decoded, as it is stored.

    Raises:
        TwofoldError: see `read_header`; or its pixels are damaged or not all there.
    """
    with _opened(path) as image:
        image.load()
        return image


def require_checksums(path: Path) -> None:
    """Compares the checksums of a PNG, which is quick; pixels may be missing all the same.

    Raises:
        TwofoldError: see `read_header`; or a checksum is wrong, or the file ends early.
    """
    with _opened(path) as image:
        if image.format == "PNG":
            image.verify()


def read_rgb(path: Path) -> UInt8[np.ndarray, "h w 3"]:
    """An image's colours, 8-bit sRGB; opacity is ignored.

    Raises:
        TwofoldError: see `load_image`.
    """
    return np.array(_converted(path, "RGB"))


def read_grey(path: Path) -> UInt8[np.ndarray, "h w"]:
    """An image's brightness, 8 bits.

    Raises:
        TwofoldError: see `load_image`.
    """
    return np.array(_converted(path, "L"))


def _converted(path: Path, mode: Literal["RGB", "L"]) -> Image.Image:
    with _opened(path) as image:
        return image.convert(mode)


def _orientation(image: Image.Image) -> int:
    """How an image is brought upright: EXIF's number, 1 where there is nothing to do."""
    # Pillow brings TIFF upright by itself, and looks for a PNG's EXIF behind its pixels, which takes decoding them.
    if image.format == "TIFF" or (image.format == "PNG" and "exif" not in image.info):
        return 1
    with _WARNINGS, warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return image.getexif().get(_ORIENTATION, 1)


@contextmanager
def _opened(path: Path) -> Generator[Image.Image, None, None]:
    """The image in a file; what fails within the block is taken for the file's fault."""
    with opened(path, _MAX_BYTES) as file:
        try:
            with _WARNINGS, warnings.catch_warnings():
                warnings.simplefilter("ignore")
                image = Image.open(file, formats=FORMATS)
            if image.width * image.height > MAX_PIXELS:
                raise Image.DecompressionBombError(f"{image.width} x {image.height} pixels are too many")
            yield image
        except TwofoldError:
            raise
        except MemoryError:
            raise
        except UnidentifiedImageError as error:
            raise TwofoldError(f"{path} is no image of a known kind ({', '.join(FORMATS)}); save it as PNG.") from error
        except Image.DecompressionBombError as error:
            raise TwofoldError(
                f"{path} has more pixels than the {MAX_PIXELS // 10**6} million of a large image; make it smaller."
            ) from error
        except Exception as error:  # Pillow's decoders fail in any way: even struct.error, KeyError and IndexError
            reason = str(error).rstrip(".") or type(error).__name__
            raise TwofoldError(f"{path} is damaged ({reason}); save it again as PNG.") from error
