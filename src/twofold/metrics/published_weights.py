"""Weights of trained networks that others have published: where they are looked for, how they are recognised.

They do not come with this package. A file counts as published where its SHA-256 begins as its publisher says; another
one is refused unless the user says that it is meant, and then every number made with it is marked. Files are read as
tensors only, so none runs code.
"""

import hashlib
import importlib.util
import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

from twofold.errors import TwofoldError
from twofold.inputs import opened

_MAX_BYTES = 2 * 2**30
_PUBLISHED = "TWOFOLD_UNVERIFIED_WEIGHTS"
"""Set to 1 where other weights than the published ones are meant."""


@dataclass(frozen=True)
class WeightFile:
    """A published file.

    Attributes:
        name: of the file.
        sha256: first hexadecimal digits of its hash, as many as its publisher tells.
        what: it is, for sentences.
        address: where it is published.
        packages: files inside installed Python packages that hold the same.
    """

    name: str
    sha256: str
    what: str
    address: str
    packages: tuple[str, ...] = ()


@dataclass(frozen=True)
class FoundFile:
    """A file of weights on this machine; `verified` where it is the published one."""

    file: WeightFile
    path: Path
    verified: bool


def weights_folder() -> Path:
    """Where weights are looked for first: $TWOFOLD_WEIGHTS, or twofold/weights in the user's cache folder."""
    given = os.environ.get("TWOFOLD_WEIGHTS")
    return Path(given) if given else _cache() / "twofold" / "weights"


def _cache() -> Path:
    cache = os.environ.get("XDG_CACHE_HOME")
    return Path(cache) if cache else Path.home() / ".cache"


def find_weights(file: WeightFile, folder: Path | None = None, unverified: bool | None = None) -> FoundFile | None:
    """The file in a folder or, where none is given, also in the caches of torch and of installed packages; or None.

    Args:
        file: which.
        folder: the only place to look; `weights_folder()` and the caches if None.
        unverified: accept another file of that name in the folder; None as $TWOFOLD_UNVERIFIED_WEIGHTS says.

    Raises:
        TwofoldError: the folder holds another file under that name, or one that cannot be read.
    """
    if unverified is None:
        unverified = os.environ.get(_PUBLISHED, "") not in ("", "0")
    own = (folder or weights_folder()) / file.name
    if own.is_file():
        digest = _sha256(own)
        if digest.startswith(file.sha256):
            return FoundFile(file, own, True)
        if unverified:
            return FoundFile(file, own, False)
        raise TwofoldError(
            f"{own} is not the published {file.what}: its SHA-256 begins with {digest[: min(len(file.sha256), 16)]}, "
            f"expected {file.sha256[:16]}; get it from {file.address}, or allow other weights "
            f"(--unverified-weights, or {_PUBLISHED}=1)."
        )
    for path in _in_caches(file) if folder is None else ():
        if path.is_file() and _sha256(path).startswith(file.sha256):
            return FoundFile(file, path, True)
    return None


def _in_caches(file: WeightFile) -> list[Path]:
    hub = Path(os.environ["TORCH_HOME"]) if os.environ.get("TORCH_HOME") else _cache() / "torch"
    paths = [hub / "hub" / "checkpoints" / file.name]
    for inside in file.packages:
        package, _, rest = inside.partition("/")
        spec = importlib.util.find_spec(package)  # Finds it without running it.
        paths += [Path(place) / rest for place in (spec.submodule_search_locations or () if spec else ())]
    return paths


def _sha256(path: Path) -> str:
    digest = hashlib.sha256()
    with opened(path, _MAX_BYTES) as file:
        while block := file.read(2**20):
            digest.update(block)
    return digest.hexdigest()


def missing_cell(files: tuple[WeightFile, ...], folder: Path | None = None) -> str:
    """What stands in a table in place of a number that needs the files: which of them are absent.

    >>> missing_cell((WeightFile("a.pth", "00", "A", "https://example.org/a.pth"),), Path("weights"))
    'n/a (put a.pth in weights)'
    """
    place = folder or weights_folder()
    absent = [
        file.name
        for file in files
        if not any(path.is_file() for path in (place / file.name, *(() if folder else _in_caches(file))))
    ]
    return f"n/a (put {' and '.join(absent or [file.name for file in files])} in {place})"


def missing_sentence(name: str, files: tuple[WeightFile, ...], folder: Path | None = None) -> str:
    """One sentence: which files a figure needs, where they are published and where to put them."""
    wanted = " and ".join(f"{file.name} from {file.address}" for file in files)
    return (
        f"{name} is left out, because its weights are not in {folder or weights_folder()}; put {wanted} there, or name "
        "their folder in TWOFOLD_WEIGHTS."
    )


def read_weights(found: FoundFile, shapes: Mapping[str, tuple[int, ...]]) -> dict[str, Tensor]:
    """The tensors of a file, by name, in the wanted shapes; axes of length one may be missing or more.

    Raises:
        TwofoldError: the file cannot be read, or a tensor is missing or has another shape.
    """
    path, what = found.path, found.file.what
    try:
        # Others publish these files in this format; weights_only reads tensors and runs no code.
        stored = torch.load(path, map_location="cpu", weights_only=True)  # noqa: TID251
    except MemoryError:
        raise
    except Exception as error:  # a damaged archive may fail in any way
        raise TwofoldError(f"{path} cannot be read as {what}; download it again.") from error
    tensors: dict[str, Tensor] = {}
    for name, shape in shapes.items():
        tensor = stored.get(name) if isinstance(stored, dict) else None
        if not isinstance(tensor, Tensor) or [n for n in tensor.shape if n > 1] != [n for n in shape if n > 1]:
            has = f"of shape {tuple(tensor.shape)}" if isinstance(tensor, Tensor) else "missing"
            raise TwofoldError(
                f"{path} should be {what}, but {name} is {has}, not of shape {shape}; put the right file there."
            )
        tensors[name] = tensor.reshape(shape).float()
    return tensors
