"""Single arrays from npy files of unknown origin, and the dictionaries that NumPy hides in such files.

NumPy's own reader unpickles plainly, and evaluates headers as Python expressions.
"""

import re
import zipfile
import zlib
from pathlib import Path
from typing import Any

import numpy as np

from twofold.errors import TwofoldError
from twofold.inputs import opened, read_bytes
from twofold.pickles import MAX_BYTES, MAX_OPCODES, pickle_error, unpickled

_MAX_HEADER = 10_000
_MAGIC = b"\x93NUMPY"


def read_npy(path: Path | str, what: str, limit: int = MAX_BYTES, max_opcodes: int = MAX_OPCODES) -> Any:
    """An npy file: an array of numbers, or the containers and arrays of an array of Python objects.

    NumPy's own reader unpickles plainly.

    Args:
        path: of the file.
        what: it is, for the sentences.
        limit: of its size in bytes.
        max_opcodes: see `record`.

    Raises:
        TwofoldError: see `read_pickle`.
    """
    return npy_content(read_bytes(path, limit), path, what, max_opcodes)


def npy_content(raw: bytes, path: Path | str, what: str, max_opcodes: int = MAX_OPCODES) -> Any:
    """The content of npy bytes; see `read_npy`."""
    try:
        return _npy_content(raw, path, what, max_opcodes)
    except Exception as error:  # headers may be damaged in any way
        raise pickle_error(error, path, what) from error


def _npy_content(raw: bytes, path: Path | str, what: str, max_opcodes: int) -> Any:
    if raw[: len(_MAGIC)] != _MAGIC:
        if raw[:2] == b"PK":
            raise TwofoldError(f"{path} is an npz file, expected {what} as npy; check that it is the right one.")
        raise ValueError("no npy file")
    version = raw[len(_MAGIC)]
    width = 2 if version == 1 else 4
    start = len(_MAGIC) + 2
    length = int.from_bytes(raw[start : start + width], "little")
    if version not in (1, 2, 3) or length > _MAX_HEADER:
        raise ValueError("its header is damaged")
    begin = start + width + length
    if begin > len(raw):
        raise EOFError
    text = raw[start + width : begin].decode("latin1")
    kind = re.search(r"'descr':\s*'([^']*)'", text)
    order = re.search(r"'fortran_order':\s*(True|False)", text)
    sizes = re.search(r"'shape':\s*\(([\d,L\s]*)\)", text)
    if kind is None or order is None or sizes is None:
        raise ValueError("its header is damaged")
    if "O" in kind[1]:
        return unpickled(raw[begin:], path, what, max_opcodes)
    if not re.fullmatch(r"[<>|=]?([fiu][1248]|b1)", kind[1]):
        raise ValueError(f"expected numbers, it holds the type {kind[1]}")
    shape = [int(size) for size in re.findall(r"\d{1,12}", sizes[1])]
    item, count = np.dtype(kind[1]), 1
    for size in shape:
        count *= size
    if len(shape) > 8 or len(raw) - begin < count * item.itemsize:
        raise EOFError
    content = np.frombuffer(raw, item, count, begin)
    return content.reshape(shape, order="F" if order[1] == "True" else "C")


def read_npz_object(path: Path | str, name: str, what: str, limit: int = MAX_BYTES, only_names: bool = False) -> Any:
    """One array of an npz file, or the containers and arrays of one of Python objects; None where it is missing.

    Args:
        path: of the file.
        name: of the array.
        what: it is, for the sentences.
        limit: of its size in bytes.
        only_names: whether it is enough to know that it is there: True then.

    Raises:
        TwofoldError: the file is missing, damaged or too large, or holds something else.
    """
    with opened(path, 2 * limit) as file:
        try:
            with zipfile.ZipFile(file) as archive:
                members = {info.filename.removesuffix(".npy"): info for info in archive.infolist()}
                if name not in members or only_names:
                    return True if name in members else None
                if members[name].file_size > limit:
                    raise TwofoldError(f"{name} in {path} is larger than {limit >> 20} MiB, too much for {what}.")
                raw = archive.read(members[name])
        except (zipfile.BadZipFile, zipfile.LargeZipFile, zlib.error, NotImplementedError, RuntimeError) as error:
            if only_names:
                return None
            raise TwofoldError(f"{path} is damaged or cut short, expected {what}; get the file again.") from error
    return npy_content(raw, path, what)
