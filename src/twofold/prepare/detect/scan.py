"""One camera's clip gone through once: pictures and masks put aside as files, landmarks kept.

Memory does not grow with the clip's length but for the landmarks, a few hundred bytes a picture.
"""

import io
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float, UInt8
from PIL import Image
from scipy import ndimage

from twofold.files import plain_errors
from twofold.prepare.detect.background import background_shift
from twofold.prepare.detections import Estimator, Observation, Track, track_of
from twofold.prepare.video.frames import Picture

_BACKGROUND = 160
"""Longer side of the small grey pictures by which a moving camera is noticed."""

_QUALITY = 95
"""Of the stored pictures; video has lost more already."""

Straighten = Callable[[UInt8[np.ndarray, "h w 3"]], UInt8[np.ndarray, "h w 3"]]


@dataclass(frozen=True)
class Watched:
    """What was seen in a clip.

    Attributes:
        images: files of the pictures.
        masks: files of the masks, 0 outside .. 255 on the person.
        track: landmarks.
        sources: which picture of the clip itself each one is.
        moved: how far the background moves at most, pixels.
        sample: some pictures spread over the clip.
    """

    images: tuple[Path, ...]
    masks: tuple[Path, ...]
    track: Track
    sources: tuple[int, ...]
    moved: float
    sample: tuple[UInt8[np.ndarray, "h w 3"], ...]


def watch_clip(
    pictures: Iterable[Picture],
    expected: int,
    estimator: Estimator,
    scratch: Path,
    straighten: Straighten | None = None,
    given: Callable[[int], UInt8[np.ndarray, "h w"] | None] | None = None,
    show: Callable[[float], None] | None = None,
) -> Watched:
    """Looks at every picture of a clip.

    Args:
        pictures: in order.
        expected: about how many there are.
        estimator: finds the person.
        scratch: folder for the files.
        straighten: takes the lens's distortion out of a picture.
        given: the user's own mask of a picture by its `source`, None where there is none; taken as it is.
        show: told the share that is done.

    Raises:
        TwofoldError: a picture cannot be read, or the disk refuses.
    """
    images: list[Path] = []
    masks: list[Path] = []
    sources: list[int] = []
    seen: list[Observation] = []
    sample: list[np.ndarray] = []
    first: np.ndarray | None = None
    moved: list[float] = []
    every = max(1, expected // 12)
    with plain_errors(scratch):
        scratch.mkdir(parents=True, exist_ok=True)
    for picture in pictures:
        image = picture.image if straighten is None else straighten(picture.image)
        found = estimator(image, picture.seconds)
        own = None if given is None else given(picture.source)
        mask = clean_mask(found.mask) if own is None else own
        if own is not None and straighten is not None:
            mask = straighten(np.repeat(own[..., None], 3, 2))[..., 0]
        stem = f"{picture.index:06d}"
        images.append(scratch / f"{stem}.jpg")
        masks.append(scratch / f"{stem}.png")
        with plain_errors(scratch):
            save_picture(images[-1], image, quality=_QUALITY, subsampling=0)
            save_picture(masks[-1], mask, compress_level=1)
        # The mask is a file now; keeping it would fill the memory.
        seen.append(Observation(found.pixels, found.visibility, found.world, np.zeros((1, 1), np.uint8)))
        sources.append(picture.source)
        if picture.index % every == 0:
            sample.append(image)
            small, person, scale = _small(image, mask)
            if first is None:
                first = small
            else:
                moved.append(scale * background_shift(first, small, person))
        if show is not None:
            show(min(1.0, (picture.index + 1) / max(expected, 1)))
    # A single wrong guess about the shift is no moving camera.
    shift = float(np.quantile(moved, 0.8)) if moved else 0.0
    return Watched(tuple(images), tuple(masks), track_of(seen), tuple(sources), shift, tuple(sample))


def save_picture(path: Path, pixels: UInt8[np.ndarray, "h w *c"], **options: int) -> None:
    """Writes a picture file; unlike Pillow's own writing it notices a disk that takes only a part."""
    buffer = io.BytesIO()
    Image.fromarray(pixels).save(buffer, Image.registered_extensions()[path.suffix], **options)
    path.write_bytes(buffer.getvalue())


def clean_mask(mask: UInt8[np.ndarray, "h w"]) -> UInt8[np.ndarray, "h w"]:
    """A soft mask with the one person only: the largest piece, its small holes filled, its edge a few pixels wide."""
    labels, count = ndimage.label(mask > 127)  # pyright: ignore[reportGeneralTypeIssues]
    if count == 0:
        return np.zeros_like(mask)
    sizes = np.bincount(labels.ravel())[1:]
    person = labels == 1 + int(sizes.argmax())
    holes, count = ndimage.label(~person)  # pyright: ignore[reportGeneralTypeIssues]
    small = np.flatnonzero(np.bincount(holes.ravel()) < 2e-3 * person.sum())
    filled = person | (np.isin(holes, small[small > 0]) if count else False)
    steep = np.clip((mask.astype(np.float32) - 127.5) * 4 + 127.5, 0, 255)
    reach = ndimage.binary_dilation(filled, iterations=3)
    steep = np.where(filled & ~person, 255, np.where(reach, steep, 0))
    return np.where(filled, np.maximum(steep, 128), np.minimum(steep, 127)).astype(np.uint8)


def _small(
    image: UInt8[np.ndarray, "h w 3"], mask: UInt8[np.ndarray, "h w"]
) -> tuple[Float[np.ndarray, "a b"], np.ndarray, float]:
    """A small grey picture, where the person is in it (with a margin), and how many pixels one of its pixels is."""
    height, width = mask.shape
    scale = max(1.0, max(height, width) / _BACKGROUND)
    size = (round(width / scale), round(height / scale))
    grey = Image.fromarray(image).convert("L").resize(size, Image.Resampling.BOX)
    person = np.asarray(Image.fromarray(mask).resize(size, Image.Resampling.BOX)) > 16
    return np.asarray(grey) / np.float32(255), np.asarray(ndimage.binary_dilation(person, iterations=4)), scale


def spread_out(count: int, most: int) -> Sequence[int]:
    """At most so many of 0..count-1, evenly."""
    return sorted({int(i) for i in np.linspace(0, count - 1, min(count, most)).round()}) if count else []
