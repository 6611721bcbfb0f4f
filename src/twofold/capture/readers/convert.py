"""From a foreign data set to a capture folder: read, verify, then image by image, so that memory does not grow."""

import hashlib
import os
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import torch

from twofold.body.skeleton import Body
from twofold.body.smpl import read_smpl
from twofold.capture.folder import CaptureWriter
from twofold.capture.layout import spans
from twofold.capture.readers.image_converter import ImageConverter, agreement
from twofold.capture.readers.known_formats import READERS, Reader, reader_of
from twofold.capture.readers.published_splits import (
    ProtocolName,
    count_images,
    default_protocol,
    needed_frames,
    ordered,
    split,
)
from twofold.capture.readers.sequence import MaskChoice, ReadOptions, Sequence3D, Split
from twofold.capture.readers.world import posed_joints, upright
from twofold.capture.readers.zju_raw import subject_of
from twofold.capture.types import SPLITS, spread
from twofold.errors import TwofoldError
from twofold.geometry.cameras import Camera
from twofold.inputs import is_there, opened, shown_path

USUAL_FPS = 30.0
"""Taken where nothing says how fast the frames were taken."""
SMPL_HINT = "--body FILE names your SMPL file (basicmodel_neutral_lbs_10_207_0_v1.1.0.pkl from smpl.is.tue.mpg.de)"
_MASKS: dict[ProtocolName, MaskChoice] = {"paper": "mask", "neuralbody": "mask_cihp"}
"""Which of ZJU-MoCap's masks a paper takes; the others take the union of both."""
_VERIFIED = 8
"""Training images on which body and masks are compared before the work begins."""
_NO_AGREEMENT = 0.2
"""Silhouette IoU below which body, camera and masks do not belong together."""
_MAX_LOST = 0.5
"""Share of the training images that may be unfit."""


@dataclass(frozen=True)
class ConvertOptions:
    """What to make of a data set.

    Attributes:
        body: the user's SMPL file.
        split: whose split; None for the paper's with several cameras, held-out frames with one.
        scale: of the images: 0.5 for half as many rows and columns.
        masks: which of ZJU-MoCap's masks are taken; None for those that the split's paper takes.
        held_out: every Nth frame is held out, where there is one camera and no split is named.
        fps: frames per second; None for 30.
        credit: whom to name when showing the images.
    """

    body: Path | None = None
    split: ProtocolName | None = None
    scale: float = 1.0
    masks: MaskChoice | None = None
    held_out: int = 10
    fps: float | None = None
    credit: str = ""


@dataclass(frozen=True)
class Converted:
    """What came of it.

    Attributes:
        folder: the capture.
        images: how many in each split.
    """

    folder: Path
    images: Mapping[str, int]

    def summary(self) -> str:
        """What came of it in a few words."""
        return ", ".join(f"{self.images[part]} {part.replace('_', ' ')}" for part in SPLITS) + " images."


def convert(
    source: Path,
    out: Path,
    options: ConvertOptions | None = None,
    overwrite: bool = False,
    progress: Callable[[float, str], None] = lambda done, what: None,
    remark: Callable[[str], None] = lambda sentence: None,
) -> Converted:
    """Makes a capture folder from a foreign data set.

    Args:
        source: folder or file in one of the formats of `READERS`.
        out: the capture folder to make.
        options: see there.
        overwrite: a capture that lies at `out` is overwritten.
        progress: called with the share that is done and what is being done.
        remark: called with each sentence that the user should know.

    Raises:
        TwofoldError: the data set cannot be read, its body and masks do not meet, or `out` cannot be written; nothing
            is left behind then.
    """
    options = options or ConvertOptions()
    _require_options(options)
    reader = _require_reader(source)
    body = read_user_body(options.body, reader.title)
    with CaptureWriter(out, overwrite) as writer:
        progress(0.0, "reading cameras and poses")
        sequence, protocol = _read(reader, source, body, options)
        for sentence in sequence.remarks:
            remark(sentence)
        chosen = sequence.splits if sequence.splits is not None else split(protocol, sequence, options.held_out)
        if sequence.splits is None and options.split is None:
            remark(f"No --split was named; {_words(protocol, options.held_out)}.")
        poses, translations, cameras = upright(
            body, sequence.betas, sequence.poses, sequence.translations, sequence.cameras, sequence.gravity
        )
        joints = posed_joints(body, sequence.betas, poses, translations)
        shown = {camera for camera, _ in ordered(chosen)}
        converters = {
            name: ImageConverter(camera, _first(sequence, chosen, name), options.scale, joints)
            for name, camera in cameras.items() if name in shown
        }  # fmt: skip
        remark(_verify(sequence, chosen, converters, body, poses, translations))
        lost = _write_images(writer, sequence, chosen, converters, progress)
        if lost:
            remark(_about_lost(lost))
        kept = without(chosen, lost)
        _require_enough(chosen, kept, sequence)
        if options.fps is None:
            remark(f"Nothing says how many frames a second there are; {USUAL_FPS:g} is taken, --fps sets it.")
        fitting: dict[str, Camera] = {name: converter.camera for name, converter in converters.items()}
        writer.finish(
            name=sequence.name, body=body, betas=sequence.betas.float(), poses=poses.float(),
            translations=translations.float(), cameras=fitting, splits=kept, fps=options.fps or USUAL_FPS,
            credit=options.credit, notes=_notes(source, sequence, protocol, options, lost),
        )  # fmt: skip
    progress(1.0, "done")
    return Converted(out, count_images(kept))


def read_user_body(path: Path | None, what: str) -> Body:
    """The user's SMPL file.

    Args:
        path: where it lies.
        what: needs it, for the sentence.

    Raises:
        TwofoldError: it was not named, or cannot be read.
    """
    if path is None:
        raise TwofoldError(f"The poses of {what} are SMPL's, whose body model may not be shipped; {SMPL_HINT}.")
    return read_smpl(path)


def sha256_of(path: Path) -> str:
    """The SHA-256 of a file, in hexadecimal digits."""
    digest = hashlib.sha256()
    with opened(path, 2**40) as file:
        while block := file.read(1 << 20):
            digest.update(block)
    return digest.hexdigest()


def _require_options(options: ConvertOptions) -> None:
    if not 0.05 <= options.scale <= 1:
        raise TwofoldError(f"--scale {options.scale:g} should be 0.05 to 1; 0.5 halves rows and columns.")
    if options.held_out < 3:
        raise TwofoldError(
            f"One frame of {options.held_out} cannot be held out between two that train; take 3 or more."
        )
    if options.fps is not None and not 0.01 <= options.fps <= 1000:
        raise TwofoldError(f"The frame rate {options.fps:g} makes no sense; give frames per second, 30 for example.")


def _require_reader(source: Path) -> Reader:
    """The reader of a data set.

    Raises:
        TwofoldError: nothing lies there, or nothing that is known.
    """
    if not is_there(source):
        raise TwofoldError(f"{shown_path(source)} does not exist; correct the path.")
    reader = reader_of(source)
    if reader is None:
        known = ", ".join(reader.title for reader in READERS.values())
        raise TwofoldError(
            f"{shown_path(source)} is no data set of a known format ({known}, or a folder with capture.npz); "
            "docs/data.md says which files each of them has."
        )
    return reader


def _read(reader: Reader, source: Path, body: Body, options: ConvertOptions) -> tuple[Sequence3D, ProtocolName]:
    wished = options.split or "paper"
    masks = options.masks or _MASKS.get(wished, "union")
    sequence = reader.read(source, ReadOptions(body, masks, needed_frames(wished, subject_of(source))))
    if sequence.splits is not None and options.split not in (None, "paper"):
        raise TwofoldError(f"{source} has the paper's own split; leave --split out, or name the raw data set.")
    if sequence.splits is not None:
        return sequence, "paper"
    return sequence, options.split or default_protocol(sequence)


def _words(protocol: ProtocolName, held_out: int) -> str:
    if protocol == "every_nth":
        return f"there is one camera, so every {held_out}th frame is held out (--held-out)"
    return "the paper's is taken: the first four fifths train on the first camera"


def _first(sequence: Sequence3D, chosen: Split, camera: str) -> tuple[int, int]:
    """Rows and columns of a camera's images, as its first one has them."""
    frame = min(f for cameras in chosen.values() for f in cameras.get(camera, ()))
    image, mask = sequence.images[camera, frame].read()
    if image.shape[:2] != mask.shape:
        raise TwofoldError(
            f"The mask of {sequence.images[camera, frame].where} has {mask.shape[1]} x {mask.shape[0]} pixels, the "
            f"image {image.shape[1]} x {image.shape[0]}; give masks of the images' size."
        )
    return image.shape[0], image.shape[1]


def _verify(
    sequence: Sequence3D,
    chosen: Split,
    converters: Mapping[str, ImageConverter],
    body: Body,
    poses: torch.Tensor,
    translations: torch.Tensor,
) -> str:
    """How well body and masks agree in a few training images, as a sentence.

    Raises:
        TwofoldError: they hardly meet.
    """
    images = [(camera, frame) for camera, frames in chosen["train"].items() for frame in frames]
    overlaps: list[float] = []
    for camera, frame in spread(images, _VERIFIED):
        _, mask = converters[camera].converted(sequence.images[camera, frame])
        if mask.max() > 127:
            view = converters[camera].camera
            overlaps.append(agreement(view, mask, body, sequence.betas, poses[frame], translations[frame]))
    mean = sum(overlaps) / max(len(overlaps), 1)
    if mean < _NO_AGREEMENT:
        raise TwofoldError(
            f"The posed body and the masks of {sequence.name} hardly meet (silhouette IoU {mean:.2f} over "
            f"{len(overlaps)} training images); poses, cameras and images are of different recordings, frames or sizes."
        )
    return f"Body and masks agree with a silhouette IoU of {mean:.2f} over {len(overlaps)} training images."


def _write_images(
    writer: CaptureWriter,
    sequence: Sequence3D,
    chosen: Split,
    converters: Mapping[str, ImageConverter],
    progress: Callable[[float, str], None],
) -> dict[tuple[str, int], str]:
    """Writes every image that a split shows; returns those that are unfit, with the reason."""
    images = ordered(chosen)
    lost: dict[tuple[str, int], str] = {}

    def write(key: tuple[str, int]) -> str:
        camera, frame = key
        image, mask = converters[camera].converted(sequence.images[key])
        fault = converters[camera].fault(mask, frame)
        if not fault:
            writer.image(camera, frame, image)
            writer.mask(camera, frame, mask)
        return fault

    # Few at a time: an image of 1024 x 1024 takes some 50 MB on its way.
    with ThreadPoolExecutor(min(4, os.cpu_count() or 1)) as pool:
        for done, (key, fault) in enumerate(zip(images, pool.map(write, images), strict=True), 1):
            if fault:
                lost[key] = fault
            progress(0.05 + 0.93 * done / len(images), f"{done} of {len(images)} images")
    return lost


def _about_lost(lost: Mapping[tuple[str, int], str]) -> str:
    camera = next(iter(lost))[0]
    frames = spans(frame for name, frame in lost if name == camera)
    more = sum(name != camera for name, _ in lost)
    others = f" and {more} images of other cameras" if more else ""
    return f"Left out, because {next(iter(lost.values()))}: frames {frames} of {camera}{others}."


def without(chosen: Split, lost: Mapping[tuple[str, int], str]) -> dict[str, dict[str, list[int]]]:
    """The splits without some images, and without novel views of frames that no camera trains on any more."""
    kept = {
        part: {camera: [f for f in frames if (camera, f) not in lost] for camera, frames in cameras.items()}
        for part, cameras in chosen.items()
    }
    return {part: {camera: frames for camera, frames in cameras.items() if frames} for part, cameras in kept.items()}


def _require_enough(chosen: Split, kept: Split, sequence: Sequence3D) -> None:
    before, after = count_images(chosen)["train"], count_images(kept)["train"]
    if after < 2 or after < (1 - _MAX_LOST) * before:
        raise TwofoldError(
            f"Only {after} of {before} training images of {sequence.name} have a mask that the body meets; check that "
            "masks, images and poses are of the same recording."
        )


def _notes(
    source: Path,
    sequence: Sequence3D,
    protocol: ProtocolName,
    options: ConvertOptions,
    lost: Mapping[tuple[str, int], str],
) -> dict[str, object]:
    body = options.body
    return {
        "made_by": "twofold convert",
        **request_notes(source, options),
        "reader": sequence.reader,
        "split_taken": protocol,
        "body_file": "" if body is None else body.name,
        "masks": options.masks or _MASKS.get(protocol, "union"),
        "frames_of_recording": sequence.total,
        "frame_names": list(sequence.frame_names),
        "left_out": [[camera, frame, why] for (camera, frame), why in lost.items()],
        **sequence.notes,
    }


def request_notes(source: Path, options: ConvertOptions) -> dict[str, object]:
    """What was asked for, by which a capture is known that came of the same request."""
    return {
        "converted_from": str(source.resolve()),
        "body_sha256": "" if options.body is None else sha256_of(options.body),
        "split": options.split or "",
        "scale": options.scale,
        "held_out": options.held_out,
    }
