"""HDF5 from outside: plain arrays of the file itself, sizes looked at first, built-in filters only.

An HDF5 file may name other files (external and virtual arrays, links), hold references and objects, and ask for filters
that are loaded as programs; none of that is followed.
"""

import importlib
import math
from collections.abc import Generator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import UInt8

from twofold.errors import TwofoldError, install_command
from twofold.inputs import is_there, require_file

SIGNATURE = b"\x89HDF\r\n\x1a\n"
_MAX_SMALL = 2**28
"""Bytes of an array that is read whole."""
_MAX_ROW = 2**28
"""Bytes of one image, and of one chunk, which is unpacked whole."""
_FILTERS = {1, 2, 3, 32000}
"""Deflate, shuffle, checksum, LZF: part of the libraries themselves."""


def is_hdf5(path: Path) -> bool:
    """Whether a file begins as HDF5 files do."""
    if not path.is_file():
        return False
    try:
        with path.open("rb") as file:
            return file.read(len(SIGNATURE)) == SIGNATURE
    except OSError:
        return False


@contextmanager
def opened_hdf5(path: Path) -> Generator[Any, None, None]:
    """The file, open for reading.

    Raises:
        TwofoldError: h5py is not installed, or the file is missing or damaged.
    """
    try:
        h5py: Any = importlib.import_module("h5py")
    except ImportError as error:
        raise TwofoldError(
            f"{path} is an HDF5 file, which takes h5py; install it: {install_command('data')}"
        ) from error
    if not is_there(path):
        raise TwofoldError(f"{path} does not exist; correct the path.")
    require_file(path)
    try:
        file = h5py.File(path, "r")
    except OSError as error:
        raise TwofoldError(f"{path} is cut short or no HDF5 file; get it again.") from error
    try:
        yield file
    finally:
        file.close()


def dataset(file: Any, name: str, path: Path) -> Any:
    """An array of the file, not yet read.

    Raises:
        TwofoldError: it is missing, lies elsewhere, holds objects, or needs a filter from elsewhere.
    """
    h5py: Any = importlib.import_module("h5py")
    link = file.get(name, getlink=True)
    if link is None:
        there = ", ".join(sorted(file.keys())[:12]) or "nothing"
        raise TwofoldError(f"{path} lacks {name}; it has {there}.")
    if not isinstance(link, h5py.HardLink):
        raise TwofoldError(f"{name} in {path} is a link to somewhere else, which is not followed; write the file anew.")
    found = file[name]
    if not isinstance(found, h5py.Dataset):
        raise TwofoldError(f"{name} in {path} is a group, expected an array; check that it is the right file.")
    if found.is_virtual or found.external:
        raise TwofoldError(f"{name} in {path} lies in another file, which is not opened; write it into this one.")
    if found.dtype.kind not in "fiubS":
        raise TwofoldError(f"{name} in {path} holds {found.dtype}, expected numbers; write the file anew.")
    layout = found.id.get_create_plist()
    filters = {layout.get_filter(i)[0] for i in range(layout.get_nfilters())}
    if not filters <= _FILTERS:
        raise TwofoldError(f"{name} in {path} is packed by a filter from elsewhere; write it with gzip.")
    if found.chunks is not None and math.prod(found.chunks) * found.dtype.itemsize > _MAX_ROW:
        raise TwofoldError(f"{name} in {path} has chunks of more than {_MAX_ROW >> 20} MiB; write it image by image.")
    return found


def small_array(file: Any, name: str, path: Path) -> np.ndarray:
    """An array read whole.

    Raises:
        TwofoldError: see `dataset`; or it is larger than such arrays are, or damaged.
    """
    found = dataset(file, name, path)
    if math.prod(found.shape) * found.dtype.itemsize > _MAX_SMALL:
        raise TwofoldError(f"{name} in {path} has the shape {found.shape}, which is too large for what it should be.")
    return np.asarray(_read(found, (), name, path))


def image_row(path: Path, name: str, index: int, shape: tuple[int, ...]) -> UInt8[np.ndarray, "h w c"]:
    """One image of an array with a row for each.

    Raises:
        TwofoldError: see `dataset`; or the row is damaged.
    """
    with opened_hdf5(path) as file:
        row = np.asarray(_read(dataset(file, name, path), index, name, path))
    return row.reshape(shape).astype(np.uint8, copy=False)


def require_rows(file: Any, name: str, rows: int, sizes: tuple[int, ...], path: Path) -> None:
    """Refuses an array of images with other shapes than expected.

    Raises:
        TwofoldError: see `dataset`; or its shape or type is another.
    """
    found = dataset(file, name, path)
    count = math.prod(found.shape[1:])
    if not found.shape or found.shape[0] != rows or count != math.prod(sizes):
        words = " x ".join(map(str, found.shape))
        raise TwofoldError(
            f"{name} in {path} has the shape {words}, expected {rows} images of {sizes[1]} x {sizes[0]} pixels and "
            f"{sizes[2]} channels (img_shape); the file does not agree with itself."
        )
    if found.dtype.kind not in "iub":
        raise TwofoldError(f"{name} in {path} holds {found.dtype}, expected 8-bit numbers; write the file anew.")
    if count * found.dtype.itemsize > _MAX_ROW:
        raise TwofoldError(f"{name} in {path} has images of more than {_MAX_ROW >> 20} MiB; make them smaller.")


def has_all(file: Mapping[str, Any], names: tuple[str, ...]) -> bool:
    """Whether all of these arrays are there."""
    return all(name in file for name in names)


def _read(found: Any, index: Any, name: str, path: Path) -> Any:
    try:
        return found[index]
    except (OSError, ValueError, RuntimeError) as error:
        raise TwofoldError(f"{name} in {path} is damaged or cut short; get the file again.") from error
