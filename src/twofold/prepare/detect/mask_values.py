"""What the values of mask files mean, decided once for a folder: opacity or brightness, how bright white is, labels."""

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import UInt8
from PIL import Image

from twofold.errors import TwofoldError
from twofold.images import load_image, read_header
from twofold.prepare.video.intensity import deep_values, inferred_white, to_8_bits

LABELS = 32
"""Whole numbers that stay below this in all files are labels of objects, not brightness."""
_CUT_OUT = (0.002, 0.9995)
"""Share of transparent pixels, over all files, between which the opacity is the mask."""
_TINT = 16
"""By so much the channels of a grey JPEG differ."""


@dataclass(frozen=True)
class MaskValues:
    """What the values in a folder of masks mean.

    Attributes:
        opacity: files with an opacity channel hold the mask there.
        white: the value of the person in files of 8 bits, and in those of more.
        labels: the person is a label: whatever is not 0.
        remarks: sentences for the user, where something had to be inferred.
    """

    opacity: bool
    white: tuple[float, float]
    labels: bool
    remarks: tuple[str, ...] = ()


@dataclass(frozen=True)
class _File:
    """What one file holds.

    Attributes:
        peak: largest value, without opacity.
        deep: it has more than 8 bits.
        floating: it holds floating-point numbers.
        transparent: pixels that are more transparent than not; None without an opacity channel.
        pixels: how many there are.
        colored: channels differ.
        objects: colours other than black in a palette of colours.
    """

    peak: float
    deep: bool
    floating: bool
    transparent: int | None
    pixels: int
    colored: bool
    objects: frozenset[tuple[int, ...]]


def mask_values(files: Sequence[Path]) -> MaskValues:
    """What the values of all these files mean, which are the masks of one clip.

    * Opacity is the mask if it hides a part of the pixels; a file with a single pixel of 254 is no cut-out.
    * White is 255 in files of 8 bits, else the largest value of the fewest bits that hold all of them.
    * Values of 0 and 1 alone are labels, and 1 is the person.
    * Grey palettes are brightness, whichever index comes first; of palettes with colours, black is outside.

    Raises:
        TwofoldError: a file cannot be decoded or is a coloured image, several objects are marked, all are black, or
            values reach neither white nor 1.
    """
    with ThreadPoolExecutor(4) as pool:
        found = list(pool.map(_look_at, files))
    where = files[0].parent if len(files) > 1 else files[0]
    with_opacity = [f for f in found if f.transparent is not None]
    hidden = sum(f.transparent or 0 for f in with_opacity) / max(sum(f.pixels for f in with_opacity), 1)
    opacity = _CUT_OUT[0] <= hidden <= _CUT_OUT[1]
    grey = [f for f in found if not (opacity and f.transparent is not None)]
    colored = next((path for path, f in zip(files, found, strict=True) if f in grey and f.colored), None)
    if colored is not None:
        raise TwofoldError(f"{colored} is a coloured image; expected a mask, white on the person and black elsewhere.")
    objects = frozenset[tuple[int, ...]]().union(*(f.objects for f in found))
    if len(objects) > 1:
        raise TwofoldError(f"{where} marks {len(objects)} objects; keep the person alone, in white.")
    shallow = max((f.peak for f in grey if not f.deep), default=0.0)
    deep = max((f.peak for f in grey if f.deep), default=0.0)
    floating = any(f.floating for f in grey)
    peak = max(shallow, deep)
    if not grey or floating:
        labels = False
    else:
        labels = peak == 1
        _require_white(peak, shallow, where)
    white, remarks = inferred_white(deep, floating, str(where)) if deep else (65535.0, [])
    return MaskValues(opacity, (255.0, white), labels, tuple(remarks))


def _require_white(peak: float, shallow: float, where: Path) -> None:
    if peak == 0:
        raise TwofoldError(f"All masks in {where} are black, so nobody is in them; make them white on the person.")
    if 1 < peak < LABELS:
        raise TwofoldError(
            f"The values of the masks in {where} reach only {peak:.0f}: are they labels of several objects or body "
            "parts? Make the person 255 and everything else 0."
        )
    if shallow == peak and 1 < shallow <= 127:
        raise TwofoldError(
            f"The values of the masks in {where} reach only {peak:.0f}, so nobody is in them; make the person 255."
        )


def read_mask(path: Path, values: MaskValues | None = None) -> UInt8[np.ndarray, "h w"]:
    """One mask, 0 outside .. 255 on the person.

    Args:
        path: its file.
        values: what its folder's values mean; by default what this file's mean.

    Raises:
        TwofoldError: as `mask_values`.
    """
    values = values or mask_values([path])
    numbers, deep, opacity, palette = _numbers(path)
    if opacity is not None and values.opacity:
        return opacity
    if palette:
        return (numbers > 0).astype(np.uint8) * np.uint8(255)
    if values.labels:
        return (numbers > 0).astype(np.uint8) * np.uint8(255)
    return to_8_bits(numbers, values.white[deep])


def _numbers(path: Path) -> tuple[np.ndarray, bool, UInt8[np.ndarray, "h w"] | None, bool]:
    """Grey values, whether they have more than 8 bits, the opacity if there is one, and whether colours are labels.

    Colours that are not grey are left as channels.
    """
    header = read_header(path)
    image = load_image(path)
    if header.mode == "P":
        colors = np.asarray(image.convert("RGB"))
        if np.ptp(colors.astype(np.int16), axis=2).max() == 0:
            return colors[..., 0], False, None, False
        return _objects(np.asarray(image), colors), False, None, True
    if header.deep:
        return _grey(deep_values(path, header)), True, _opacity(image), False
    if header.mode in ("LA", "La"):
        return np.asarray(image.getchannel(0)), False, _opacity(image), False
    if header.mode in ("1", "L"):
        return np.asarray(image.convert("L")), False, None, False
    return _grey(np.asarray(image.convert("RGB"))), False, _opacity(image), False


def _opacity(image: Image.Image) -> UInt8[np.ndarray, "h w"] | None:
    return np.asarray(image.getchannel("A")) if image.mode in ("LA", "RGBA") else None


def _grey(values: np.ndarray) -> np.ndarray:
    """The mean of the channels where they are alike, else the channels."""
    if values.ndim == 2:
        return values
    wide = values.astype(np.float64)
    if np.ptp(wide, axis=2).max(initial=0) > _TINT * (1 if values.dtype == np.uint8 else 257):
        return values
    return np.round(wide.mean(2)).astype(values.dtype)


def _objects(indices: np.ndarray, colors: UInt8[np.ndarray, "h w 3"]) -> np.ndarray:
    """For each pixel its colour as one number, 0 outside: on black, or on index 0 where black is not used."""
    codes = colors.astype(np.int32) @ np.array([65536, 256, 1])
    return codes if (codes == 0).any() else np.where(indices == 0, 0, codes)


def _look_at(path: Path) -> _File:
    numbers, deep, opacity, palette = _numbers(path)
    transparent = None if opacity is None else int(np.count_nonzero(opacity < 128))
    if palette:
        objects = frozenset((int(code),) for code in np.unique(numbers[numbers > 0]))
        return _File(255.0 if objects else 0.0, False, False, None, numbers.size, False, objects)
    finite = np.nan_to_num(numbers.astype(np.float64), nan=0.0, posinf=0.0, neginf=0.0)
    peak, floating = float(finite.max(initial=0)), numbers.dtype.kind == "f"
    return _File(
        peak, deep, floating, transparent, numbers.shape[0] * numbers.shape[1], numbers.ndim == 3, frozenset()
    )  # fmt: skip
