"""What baking a run's avatar made, kept in the run's folder, so that commands share it and none bakes twice.

A file is named after its kind, the checkpoint and the settings it was made from. One that cannot be read is said,
and made again; those of older checkpoints are removed when new ones are written.
"""

import hashlib
import json
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Generic, TypeVar

import numpy as np

from twofold import __version__
from twofold.capture.types import Capture
from twofold.errors import TwofoldError
from twofold.files import made_folder, write_npz
from twofold.npz import read_npz
from twofold.training.run import CHECKPOINT, RECIPE, SUBJECT

FOLDER = "bakes"
"""In the run's folder."""
FORMAT = 1
"""To be raised with any change to what is baked or how it is stored."""

Arrays = dict[str, np.ndarray]
Value = TypeVar("Value")


@dataclass(frozen=True)
class Codec(Generic[Value]):
    """How one kind of value is stored.

    Attributes:
        encode: as named arrays.
        decode: back; raises KeyError or ValueError where these arrays cannot be its own.
    """

    encode: Callable[[Value], Arrays]
    decode: Callable[[Arrays], Value]


@dataclass(frozen=True)
class BakeCache:
    """The bakes of one checkpoint.

    Attributes:
        folder: where they lie.
        source: what they are made from, a hexadecimal digest.
        note: called with a sentence where something stored could not be used, or could not be stored.
    """

    folder: Path
    source: str
    note: Callable[[str], None]

    def path(self, kind: str, settings: Mapping[str, object]) -> Path:
        """Where the value of a kind with these settings (plain values) lies."""
        return self.folder / f"{kind}-{self.source[:16]}-{_digest(json.dumps(settings, sort_keys=True).encode())}.npz"

    def fetch(self, kind: str, settings: Mapping[str, object], codec: Codec[Value], make: Callable[[], Value]) -> Value:
        """The stored value, or a new one from `make`, which is then stored.

        A folder that cannot be written to is noted and does no harm.
        """
        path = self.path(kind, settings)
        if path.is_file():
            try:
                return codec.decode(read_npz(path))
            except (TwofoldError, KeyError, ValueError, IndexError, TypeError):
                self.note(f"The stored bake {path} is damaged; it is made again.")
        value = make()
        try:
            with made_folder(self.folder):
                write_npz(path, codec.encode(value))
        except TwofoldError as error:
            self.note(f"{error} The next command bakes again.")
        self._remove_older()
        return value

    def _remove_older(self) -> None:
        for file in self.folder.glob("*-*-*.npz"):
            if file.stem.split("-")[1] != self.source[:16] and not file.name.startswith("."):
                with suppress(OSError):
                    file.unlink()


def open_cache(run: Path, capture: Capture, note: Callable[[str], None] = lambda _: None) -> BakeCache:
    """The cache of a run's newest checkpoint.

    Args:
        run: its folder.
        capture: that it was trained on, whose cameras tell what was observed.
        note: see `BakeCache`.

    Raises:
        TwofoldError: the run has no checkpoint.
    """
    state = hashlib.sha256(f"{__version__} {FORMAT}".encode())
    for name in (RECIPE, SUBJECT, CHECKPOINT):
        try:
            with (run / name).open("rb") as file:
                while block := file.read(1 << 22):
                    state.update(block)
        except OSError as error:
            raise TwofoldError(f"{run / name} cannot be read; train first, or name another run.") from error
    for frame in capture.train:
        camera = frame.camera
        state.update(f"{frame.frame_index} {camera.height} {camera.width}".encode())
        state.update(camera.world_to_camera.numpy().tobytes() + camera.intrinsics.numpy().tobytes())
    return BakeCache(run / FOLDER, state.hexdigest(), note)


def _digest(data: bytes) -> str:
    return hashlib.sha256(data).hexdigest()[:16]


def kept(
    cache: BakeCache | None, kind: str, settings: Mapping[str, object], codec: Codec[Value], make: Callable[[], Value]
) -> Value:
    """`BakeCache.fetch`, or a new value where there is no cache."""
    return make() if cache is None else cache.fetch(kind, settings, codec, make)
