"""Our own capture folder: read it, write it. `docs/captures.md` describes every file in it."""

import contextlib
import io
import shutil
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, UInt8
from PIL import Image
from torch import Tensor

from twofold.body.skeleton import Body
from twofold.capture.layout import (
    BODY,
    CHECK,
    DESCRIPTION,
    FORMAT,
    IGNORED,
    IMAGE_ENDINGS,
    IMAGES,
    MASKS,
    MESHES,
    MOTION,
    VERSION,
    Contents,
    file_stem,
    numbered_files,
    read_contents,
)
from twofold.capture.types import SPLITS, Capture, Frame
from twofold.capture.validate import pixel_faults, quick_faults, require
from twofold.errors import TwofoldError
from twofold.files import new_folder, plain_errors, write_json, write_npz
from twofold.geometry.cameras import Camera
from twofold.inputs import require_file
from twofold.npz import read_npz


def read_capture(folder: Path | str) -> Capture:
    """A capture from its folder. Opens no pixels; `validate` does that.

    Raises:
        TwofoldError: the folder is no capture, or has faults that show without reading the images; they are listed.
    """
    folder = Path(folder)
    contents, faults = read_contents(folder)
    require(faults + quick_faults(contents), folder)
    return capture_of(contents)


def capture_of(contents: Contents) -> Capture:
    """The capture that the small files of a folder describe; all images that its splits name must be there."""
    folder = contents.folder
    body, betas, poses, translations = contents.body, contents.betas, contents.poses, contents.translations
    if body is None or betas is None or poses is None or translations is None:
        raise AssertionError("a part that cannot be read is a fault, and faults are raised before")
    images = {camera: contents.files(IMAGES, camera) for camera in contents.images}
    masks = {camera: contents.files(MASKS, camera) for camera in contents.images}
    ignored = {camera: contents.files(IGNORED, camera) for camera in contents.images}
    splits = {
        split: tuple(
            Frame(
                frame_index=time,
                camera_name=name,
                camera=contents.cameras[name],
                pose=poses[time],
                translation=translations[time],
                image_file=images[name][time],
                mask_file=masks[name][time],
                ignored_file=ignored[name].get(time),
            )
            for name, time in image_files
        )
        for split, image_files in contents.splits.items()
    }
    meshes = numbered_files(folder / MESHES, (".npz",))
    return Capture(
        contents.name, folder, body, betas, contents.fps, contents.background, splits, meshes, contents.credit,
        contents.seconds,
    )  # fmt: skip


def read_true_motion(folder: Path | str) -> tuple[Float[Tensor, "T 24 3"], Float[Tensor, "T 3"]] | None:
    """The true poses (radians) and translations (metres) of a capture whose own were disturbed; None where unknown.

    Raises:
        TwofoldError: `motion.npz` cannot be read.
    """
    arrays = read_npz(Path(folder) / MOTION, ("true_poses", "true_translations"))
    if "true_poses" not in arrays or "true_translations" not in arrays:
        return None
    poses, translations = (torch.as_tensor(arrays[f"true_{n}"].astype(np.float32)) for n in ("poses", "translations"))
    return poses, translations


class CaptureWriter:
    """Writes a capture folder, image by image; it appears under its name only when complete and free of faults.

    The methods for images and meshes may be called from several threads at once. The same input gives the same bytes.

        with CaptureWriter("out") as writer:
            writer.image("cam", 0, image)
            writer.mask("cam", 0, mask)
            ...
            writer.finish(name="me", body=body, ...)

    Args:
        folder: where to; missing folders above are made.
        overwrite: a capture that stands there is overwritten (nothing else is).

    Raises:
        TwofoldError: on entry where the folder is taken or cannot be made, later where the disk refuses.
    """

    def __init__(self, folder: Path | str, overwrite: bool = False) -> None:
        self._folder = Path(folder)
        self._overwrite = overwrite
        self._stack = contextlib.ExitStack()
        self._partial: Path | None = None
        self._finished = False

    def __enter__(self) -> "CaptureWriter":
        self._partial = self._stack.enter_context(new_folder(self._folder, replace=self._may_replace()))
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if error is None and not self._finished:
            error = RuntimeError("A capture was left unfinished: call finish() last.")
            kind = type(error)
            self._stack.__exit__(kind, error, None)
            raise error
        self._stack.__exit__(kind, error, trace)

    def image(self, camera: str, time: int, image: UInt8[np.ndarray, "h w 3"]) -> None:
        """One 8-bit sRGB image, as PNG."""
        self._image(IMAGES, camera, time, image)

    def mask(self, camera: str, time: int, mask: UInt8[np.ndarray, "h w"]) -> None:
        """Its mask, 0 outside .. 255 on the person, as PNG."""
        self._image(MASKS, camera, time, mask)

    def ignored(self, camera: str, time: int, ignored: UInt8[np.ndarray, "h w"]) -> None:
        """Where nobody knows what the person looks like there (255, else 0), as PNG; images may do without."""
        self._image(IGNORED, camera, time, ignored)

    def image_file(self, camera: str, time: int, source: Path) -> None:
        """An image file (PNG or JPEG) taken over as it is, so that nothing is lost in coding it anew."""
        self._copy(IMAGES, camera, time, source)

    def mask_file(self, camera: str, time: int, source: Path) -> None:
        """A mask file (PNG) taken over as it is."""
        self._copy(MASKS, camera, time, source)

    def ignored_file(self, camera: str, time: int, source: Path) -> None:
        """A file of ignored pixels (PNG) taken over as it is."""
        self._copy(IGNORED, camera, time, source)

    def mesh(self, time: int, vertices: Float[np.ndarray, "V 3"], faces: np.ndarray) -> None:
        """The true surface of a frame: vertices in the world, metres, and triangles."""
        buffer = io.BytesIO()
        np.savez(buffer, vertices=vertices.astype(np.float32), faces=faces.astype(np.int32))
        self._put(f"{MESHES}/{file_stem(time)}.npz", buffer.getvalue())

    def finish(
        self,
        *,
        name: str,
        body: Body,
        betas: Float[Tensor, "S"],
        poses: Float[Tensor, "T 24 3"],
        translations: Float[Tensor, "T 3"],
        cameras: Mapping[str, Camera],
        splits: Mapping[str, Mapping[str, Sequence[int]]],
        fps: float,
        background: tuple[float, float, float] = (0.0, 0.0, 0.0),
        credit: str = "",
        true_poses: Float[Tensor, "T 24 3"] | None = None,
        true_translations: Float[Tensor, "T 3"] | None = None,
        seconds: Float[Tensor, "T"] | None = None,
        notes: Mapping[str, Any] | None = None,
        thorough: bool = False,
    ) -> None:
        """Writes the small files, last of all, and checks the whole.

        Args:
            name: for titles.
            body: the body model.
            betas: its shape coefficients.
            poses: one frame a row, axis-angle, radians, relative to SMPL's T-pose.
            translations: SMPL's own, metres.
            cameras: by name.
            splits: for each split the times that each camera shows, `{"train": {"cam": [0, 1]}}`.
            fps: frames per second.
            background: colour behind the person, 0..1.
            credit: whom to name when showing it.
            true_poses: where `poses` were disturbed, what they were.
            true_translations: likewise.
            seconds: when each frame was taken, where the rate varies.
            notes: how it was made (numbers, texts, lists). Training needs none of it.
            thorough: also judges the pixels of every image, for images that nobody has looked at yet.

        Raises:
            TwofoldError: what was written is no valid capture; all is removed again.
        """
        folder = self._open()
        motion = {
            "poses": poses, "translations": translations, "betas": betas,
            "true_poses": true_poses, "true_translations": true_translations, "seconds": seconds,
        }  # fmt: skip
        write_npz(folder / BODY, body.arrays())
        write_npz(folder / MOTION, {key: value.cpu().numpy() for key, value in motion.items() if value is not None})
        description: dict[str, Any] = {
            "format": FORMAT,
            "version": VERSION,
            "name": name,
            "fps": fps,
            "background": list(background),
            "credit": credit,
            "cameras": {camera: _camera_entry(cameras[camera]) for camera in cameras},
            "splits": {
                split: [{"camera": c, "times": [int(t) for t in times]} for c, times in splits.get(split, {}).items()]
                for split in SPLITS
            },
        }
        write_json(folder / DESCRIPTION, description | ({"notes": dict(notes)} if notes else {}))
        contents, faults = read_contents(folder)
        faults += quick_faults(contents)
        require(faults + (pixel_faults(contents) if thorough else []), self._folder)
        self._finished = True

    def _may_replace(self) -> bool:
        """Whether an existing folder may be overwritten: only a capture with nothing of the user's own in it."""
        with plain_errors(self._folder):
            found = {path.name for path in self._folder.iterdir()} if self._folder.is_dir() else set[str]()
        if not found:
            return False
        foreign = found - {DESCRIPTION, BODY, MOTION, IMAGES, MASKS, IGNORED, MESHES, CHECK}
        if DESCRIPTION not in found or foreign:
            holds = f"{sorted(foreign)[0]}, which is no part of a capture" if foreign else "files that are no capture"
            raise TwofoldError(f"The folder {self._folder} holds {holds}; choose another name.")
        if not self._overwrite:
            raise TwofoldError(
                f"The folder {self._folder} already holds a capture; choose another name or remove that one first."
            )
        return True

    def _open(self) -> Path:
        if self._partial is None:
            raise RuntimeError("A CaptureWriter is used in a `with` block.")
        return self._partial

    def _image(self, kind: str, camera: str, time: int, pixels: np.ndarray) -> None:
        buffer = io.BytesIO()
        # The lowest level is several times as fast and a fifth larger.
        Image.fromarray(pixels).save(buffer, format="PNG", compress_level=1)
        self._put(f"{kind}/{camera}/{file_stem(time)}.png", buffer.getvalue())

    def _copy(self, kind: str, camera: str, time: int, source: Path) -> None:
        ending = source.suffix.lower()
        if ending not in IMAGE_ENDINGS:
            raise TwofoldError(f"{source} should be one of {', '.join(IMAGE_ENDINGS)}; save it as PNG.")
        require_file(source)  # a device would be copied without end
        self._put(f"{kind}/{camera}/{file_stem(time)}{ending}", source)

    def _put(self, name: str, content: bytes | Path) -> None:
        path = self._open() / name
        with plain_errors(self._folder, self._open()):
            path.parent.mkdir(parents=True, exist_ok=True)
            if isinstance(content, Path):
                shutil.copyfile(content, path)
            else:
                path.write_bytes(content)


def _camera_entry(camera: Camera) -> dict[str, Any]:
    return {
        "world_to_camera": _short_rows(camera.world_to_camera),
        "intrinsics": _short_rows(camera.intrinsics),
        "height": camera.height,
        "width": camera.width,
    }


def _short_rows(matrix: Float[Tensor, "n m"]) -> list[list[float]]:
    """The shortest decimals that read back as the same numbers: 0.1, not 0.10000000149."""
    return [[float(str(number)) for number in row] for row in matrix.cpu().numpy()]
