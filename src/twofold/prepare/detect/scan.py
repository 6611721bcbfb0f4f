"""One camera's clip gone through once: images and masks put aside as files, landmarks kept.

Memory does not grow with the clip's length but for the landmarks, a few hundred bytes an image.
"""

import io
from collections.abc import Callable, Generator, Iterable, Sequence
from contextlib import closing
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Float, UInt8
from PIL import Image
from scipy import ndimage

from twofold.errors import TwofoldError
from twofold.files import plain_errors
from twofold.geometry.silhouettes import overlap
from twofold.kernels.parallel import ahead
from twofold.prepare.detect.background import Surroundings, background_motion, surroundings_of
from twofold.prepare.detect.person import Region, around_mask, only
from twofold.prepare.detections import Estimator, Observation, Track, track_of
from twofold.prepare.video.frames import VideoFrame

_SAMPLES, _VIEWS = 12, 40
"""Images that are kept to count people, and backgrounds that are compared."""

_QUALITY = 95
"""Of the stored images; video has lost more already."""

Undistort = Callable[[UInt8[np.ndarray, "h w 3"]], UInt8[np.ndarray, "h w 3"]]
Own = Callable[[int], UInt8[np.ndarray, "h w"] | None]


@dataclass(frozen=True)
class Watched:
    """What was seen in a clip.

    Attributes:
        images: files of the images.
        masks: files of the masks, 0 outside .. 255 on the person.
        track: landmarks.
        sources: which image of the clip itself each one is; none comes twice.
        seconds: when each was taken.
        steps: the even step of time that each stands for (`VideoFrame.step`).
        moved: how far the background moves at most, pixels; None where that is unknown.
        sample: some images spread over the clip.
        repeated: images that show the same as the one before, and are left out.
        overlaps: of each reading of the user's own masks the IoU with the estimator's, NaN where one is missing; empty
            unless there are several readings.
        offsets: how far the estimator usually marks points off a body's (`Estimator.offsets`), metres.
        refined: share of the masks' pixels that comparing them with the background changed; None where it was not done.
    """

    images: tuple[Path, ...]
    masks: tuple[Path, ...]
    track: Track
    sources: tuple[int, ...]
    seconds: tuple[float, ...]
    steps: tuple[int, ...]
    moved: float | None
    sample: tuple[UInt8[np.ndarray, "h w 3"], ...]
    repeated: int = 0
    overlaps: tuple[tuple[float, ...], ...] = ()
    refined: float | None = None
    offsets: Float[np.ndarray, "33 3"] | None = None

    def at(self, places: Sequence[int]) -> "Watched":
        """Only some of the images, by their places."""
        chosen = list(places)
        track = replace(self.track, **{name: value[chosen] for name, value in vars(self.track).items()})
        names = ("images", "masks", "sources", "seconds", "steps")
        return replace(self, track=track, **{name: tuple(getattr(self, name)[i] for i in chosen) for name in names})


def watch_clip(
    frames: Iterable[VideoFrame],
    expected: int,
    estimator: Estimator,
    scratch: Path,
    undistort: Undistort | None = None,
    given: Sequence[Own] = (),
    progress: Callable[[float], None] | None = None,
    region: Callable[[UInt8[np.ndarray, "h w 3"], int], Region | None] | None = None,
) -> Watched:
    """Looks at every image of a clip. One that equals the one before it, as stretched videos have them, is left out.

    While one image is put aside, the estimator looks at the next, and the one after that is decoded, each in a thread
    of its own. The estimator sees all images one after the other, as it follows the person from one to the next.

    Args:
        frames: in order.
        expected: about how many there are.
        estimator: finds the person.
        scratch: folder for the files.
        undistort: takes the lens's distortion out of an image.
        given: the user's own mask of an image by its `source`, None where there is none; taken as it is. Where several
            readings are given the estimator's masks are kept, to choose by (`with_masks`).
        progress: called with the fraction that is done.
        region: where the person is in an undistorted image with its `source`, None for anywhere. By default around
            the user's own mask; where an image has none, around the last one.

    Raises:
        TwofoldError: an image cannot be read, or the disk refuses.
    """
    images: list[Path] = []
    masks: list[Path] = []
    sources: list[tuple[int, float, int]] = []
    seen: list[Observation] = []
    sample: list[np.ndarray] = []
    views: list[Surroundings] = []
    overlaps: list[tuple[float, ...]] = []
    repeated = [0]
    with plain_errors(scratch):
        scratch.mkdir(parents=True, exist_ok=True)
    decoded = ahead(_distinct(frames, repeated, undistort))
    looked = ahead(_looked_at(decoded, estimator, undistort, given, region))
    with closing(decoded), closing(looked):
        for look in looked:
            mask = clean_mask(look.found.mask)
            drawn = [own for own in look.own if own is not None]
            if len(given) > 1:
                overlaps.append(tuple(np.nan if m is None else overlap(m > 127, mask > 127) for m in look.own))
            elif drawn:
                mask = drawn[0]
            number = len(images)
            images.append(scratch / f"{number:06d}.jpg")
            masks.append(scratch / f"{number:06d}.png")
            with plain_errors(scratch):
                save_picture(images[-1], look.image, quality=_QUALITY, subsampling=0)
                save_picture(masks[-1], mask, compress_level=1)
            # The mask is a file now; keeping it would fill the memory.
            found = look.found
            seen.append(Observation(found.pixels, found.visibility, found.world, np.zeros((1, 1), np.uint8)))
            sources.append((look.frame.source, look.frame.seconds, look.frame.step))
            if number % max(1, expected // _SAMPLES) == 0:
                sample.append(look.image)
            if number % max(1, expected // _VIEWS) == 0:
                views.append(surroundings_of(look.image, mask))
            share = min(1.0, (look.frame.index + 1) / max(expected, 1))
            del look, found, mask, drawn
            if progress is not None:
                progress(share)
    if not images:
        raise TwofoldError("A clip without any image cannot be prepared; choose another.")
    places, seconds, steps = zip(*sources, strict=True)
    return Watched(
        tuple(images), tuple(masks), track_of(seen), places, seconds, steps, background_motion(views).moved,
        tuple(sample), repeated[0], tuple(zip(*overlaps, strict=True)), offsets=estimator.offsets,
    )  # fmt: skip


@dataclass(frozen=True)
class _Look:
    """One image with what was found in it and the user's own masks of it."""

    frame: VideoFrame
    image: UInt8[np.ndarray, "h w 3"]
    found: Observation
    own: list[UInt8[np.ndarray, "h w"] | None]


def _distinct(
    frames: Iterable[VideoFrame], repeated: list[int], undistort: Undistort | None
) -> Generator[tuple[VideoFrame, UInt8[np.ndarray, "h w 3"]]]:
    """Each image that differs from the one before it, with its undistorted form; the others are counted."""
    before: np.ndarray | None = None
    for frame in frames:
        if before is not None and np.array_equal(before, frame.image):
            repeated[0] += 1
            continue
        before = frame.image
        yield frame, frame.image if undistort is None else undistort(frame.image)


def _looked_at(
    decoded: Iterable[tuple[VideoFrame, UInt8[np.ndarray, "h w 3"]]],
    estimator: Estimator,
    undistort: Undistort | None,
    given: Sequence[Own],
    region: Callable[[UInt8[np.ndarray, "h w 3"], int], Region | None] | None,
) -> Generator[_Look]:
    """What the estimator finds in each image; see `watch_clip`."""
    around: Region | None = None
    for frame, image in decoded:
        own = [_straight(reading(frame.source), undistort) for reading in given]
        drawn = [mask for mask in own if mask is not None]
        if region is not None:
            around = region(image, frame.source)
        elif drawn:
            around = around_mask(np.max(drawn, axis=0))
        yield _Look(frame, image, estimator(only(image, around), frame.seconds), own)


def with_masks(watched: Watched, given: Own, undistort: Undistort | None = None) -> Watched:
    """The user's own masks in place of the estimator's, where there are any; the files are written anew."""
    for path, source in zip(watched.masks, watched.sources, strict=True):
        mask = _straight(given(source), undistort)
        if mask is not None:
            with plain_errors(path.parent):
                save_picture(path, mask, compress_level=1)
    return watched


def _straight(mask: UInt8[np.ndarray, "h w"] | None, undistort: Undistort | None) -> UInt8[np.ndarray, "h w"] | None:
    if mask is None or undistort is None:
        return mask
    return np.ascontiguousarray(undistort(np.repeat(mask[..., None], 3, 2))[..., 0])


def save_picture(path: Path, pixels: UInt8[np.ndarray, "h w *c"], **options: int) -> None:
    """Writes an image file; unlike Pillow's own writing it notices a disk that takes only a part."""
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


def spread_out(count: int, most: int) -> Sequence[int]:
    """At most this many of 0..count-1, evenly."""
    return sorted({int(i) for i in np.linspace(0, count - 1, min(count, most)).round()}) if count else []
