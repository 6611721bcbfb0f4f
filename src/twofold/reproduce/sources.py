"""Where the subjects of the experiments come from: synthetic ones by their seed, captures by their folder."""

import hashlib
import time
from collections.abc import Generator
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from twofold import __version__
from twofold.capture.folder import read_capture
from twofold.capture.layout import DESCRIPTION
from twofold.capture.types import Capture
from twofold.capture.validate import require, validate
from twofold.errors import TwofoldError
from twofold.files import made_folder
from twofold.studio.generate import StudioConfig, make_studio
from twofold.training.lock import locked

FIRST_SEED = 101
"""Seed of the first synthetic subject: recipes were chosen on lower ones, so these are held out."""
REAL = Path("captures") / "real"
"""Where `--data real` looks for captures of real people."""


@dataclass(frozen=True)
class StudioSource:
    """A synthetic subject, made where it is needed; the defaults are those of the demo.

    Attributes:
        seed: who, wearing what, moving how.
        size: rows and columns of the images.
        frames: how many; the last fifth is the motion that is not trained on.
        cameras: in the ring; the first one trains.
    """

    seed: int
    size: int = 192
    frames: int = 50
    cameras: int = 4

    @property
    def name(self) -> str:
        """For tables."""
        return f"studio {self.seed}"

    def identity(self) -> dict[str, Any]:
        """What decides its content."""
        return {"studio": asdict(self), "version": __version__}

    def capture(self, folder: Path) -> Capture:
        """The capture, kept in `folder`; it is made when it is asked for the first time.

        Raises:
            TwofoldError: the free body is not installed, or the folder cannot be written.
        """
        place = folder / f"studio-{self.seed}-{self.size}-{self.frames}-{self.cameras}"
        with made_folder(folder), _waiting(folder):
            if not (place / DESCRIPTION).is_file():
                config = StudioConfig(seed=self.seed, size=self.size, frames=self.frames, cameras=self.cameras)
                make_studio(config, place, overwrite=place.is_dir())
        return read_capture(place)


@dataclass(frozen=True)
class FolderSource:
    """A capture in a folder.

    Attributes:
        folder: where it lies.
        digest: of its content, see `folder_digest`.
    """

    folder: str
    digest: str

    @property
    def name(self) -> str:
        """For tables."""
        return Path(self.folder).name

    def identity(self) -> dict[str, Any]:
        """What decides its content."""
        return {"digest": self.digest}

    def capture(self, folder: Path) -> Capture:
        """The capture; `folder` is not used.

        Raises:
            TwofoldError: it is faulty, or not the one any more that the experiment was planned with.
        """
        place = Path(self.folder)
        require(validate(place), place)
        if folder_digest(place) != self.digest:
            raise TwofoldError(f"{place} was changed since the experiment was planned; start `twofold reproduce` anew.")
        return read_capture(place)


Source = StudioSource | FolderSource


def folder_digest(folder: Path) -> str:
    """Of the bytes of the files directly in a capture's folder, and of the names and sizes of all others."""
    digest = hashlib.sha256()
    for file in sorted(path for path in folder.rglob("*") if path.is_file()):
        inside = file.relative_to(folder)
        if inside.parts[0] in ("check", "renders") or inside.name.startswith("."):
            continue  # what other commands leave there
        digest.update(f"{inside.as_posix()} {file.stat().st_size}\n".encode())
        if len(inside.parts) == 1:
            digest.update(file.read_bytes())
    return digest.hexdigest()[:16]


def find_sources(data: str, subjects: int | None, size: int | None = None) -> list[Source]:
    """The subjects that `--data` names.

    Args:
        data: "studio", "real" (the captures in `REAL`), a capture folder, or a folder of capture folders.
        subjects: how many, the first ones by name; None for one synthetic subject, or all captures.
        size: rows and columns of the images of synthetic subjects; None for the demo's.

    Raises:
        TwofoldError: there are none, or fewer than asked for.
    """
    if data == "studio":
        sizes = {} if size is None else {"size": size}
        return [StudioSource(FIRST_SEED + number, **sizes) for number in range(subjects or 1)]
    if size is not None:
        raise TwofoldError("--size is for --data studio; a capture's images are as large as they are.")
    folder = REAL if data == "real" else Path(data)
    if not folder.is_dir():
        hint = "put capture folders of real people there (`twofold prepare`)" if data == "real" else "correct --data"
        raise TwofoldError(f"Expected studio, real or a folder of captures; {folder} is not a folder: {hint}.")
    is_capture = (folder / DESCRIPTION).is_file()
    found = [folder] if is_capture else sorted(path.parent for path in folder.glob(f"*/{DESCRIPTION}"))
    if not found:
        raise TwofoldError(
            f"{folder} holds no capture (no {DESCRIPTION}, nor one folder further down); make one with "
            "`twofold prepare` or `twofold import`."
        )
    if subjects is not None and subjects > len(found):
        raise TwofoldError(f"--subjects {subjects} asks for more captures than the {len(found)} in {folder}.")
    return [FolderSource(str(place.resolve()), folder_digest(place)) for place in found[:subjects]]


@contextmanager
def _waiting(folder: Path) -> Generator[None, None, None]:
    """A folder's lock, waited for: several processes may want the same capture at once."""
    while True:
        try:
            lock = locked(folder, "filled")
            lock.__enter__()
            break
        except TwofoldError as error:
            if "another process" not in str(error):
                raise
            time.sleep(0.5)
    try:
        yield
    finally:
        lock.__exit__(None, None, None)
