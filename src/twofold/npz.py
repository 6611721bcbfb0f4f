"""Arrays from npz files of unknown origin: headers first, only the members that are wanted, nothing ever unpickled.

NumPy's own reader is not used: it loads what a header promises before it looks whether that is there, and evaluates
headers as Python expressions.
"""

import re
import struct
import zipfile
import zlib
from collections.abc import Collection
from pathlib import Path
from typing import BinaryIO

import numpy as np

from twofold.errors import TwofoldError
from twofold.inputs import opened

MAX_BYTES = 2 * 2**30
"""Of all wanted arrays of a file together, unpacked."""
_MAX_HEADER = 10_000
_MAGIC = b"\x93NUMPY"
_KIND = re.compile(r"[<>|=]?([biufcSU])(\d{1,9})")
_ENCRYPTED = 1


def are_moderate(numbers: np.ndarray, largest: float = 1e9) -> bool:
    """Whether all are finite and small enough that single precision can compute with their squares.

    >>> are_moderate(np.array([1.0, -2.0])), are_moderate(np.array([1e300])), are_moderate(np.array([np.nan]))
    (True, False, False)
    """
    if not numbers.size:
        return True
    return bool(np.isfinite(numbers).all() and -largest <= numbers.min() and numbers.max() <= largest)


class _Damaged(Exception):
    """What a member's header says is not what its bytes are."""


_WRONG = (
    _Damaged, OSError, ValueError, EOFError, KeyError, IndexError, AttributeError, NotImplementedError, RuntimeError,
    OverflowError, zipfile.BadZipFile, zipfile.LargeZipFile, zlib.error, struct.error,
)  # fmt: skip


def read_npz(path: Path | str, wanted: Collection[str] | None = None, limit: int = MAX_BYTES) -> dict[str, np.ndarray]:
    """The arrays of an npz file by name; nothing in it is ever run.

    Args:
        path: of the file.
        wanted: names of the arrays that are read where they are there; the rest is not touched. None for all.
        limit: bytes of all these arrays, as their headers say before anything is unpacked.

    Raises:
        TwofoldError: it is missing, unreadable, damaged, encrypted or too large, or one of the arrays holds Python
            objects.
    """
    with opened(path, 2 * limit) as file:
        begins = file.read(len(_MAGIC))
        if begins == _MAGIC:
            raise TwofoldError(f"{path} holds a single array, expected several named ones (np.savez).")
        file.seek(0)
        try:
            return _read(file, path, wanted, limit)
        except TwofoldError:
            raise
        # The archive's own reader has no single error for all that may be wrong with one.
        except _WRONG as error:
            file.seek(0)
            kind = foreign_kind(file.read(64))
            if kind:
                raise TwofoldError(f"{path} is {kind}.") from error
            raise TwofoldError(f"{path} is damaged or no npz file; make it again.") from error


def foreign_kind(begins: bytes) -> str | None:
    r"""What a file is that begins with these bytes and is no npz file, and what to do; None where nobody knows.

    >>> foreign_kind(b"HIERARCHY\nROOT Hips")
    'a BVH motion, expected an npz file; save its poses with np.savez'
    """
    if begins.lstrip(b"\xef\xbb\xbf \r\n\t").startswith(b"HIERARCHY"):
        return "a BVH motion, expected an npz file; save its poses with np.savez"
    if re.match(rb"\x80[\x02-\x05]|ZF0x|\x78[\x01\x5e\x9c\xda]", begins):
        return "a pickle, expected an npz file; save its arrays with np.savez, where it was made"
    if begins.lstrip().startswith((b"{", b"[")):
        return "a JSON file, expected an npz file; save its arrays with np.savez"
    if begins.startswith(b"\x89HDF"):
        return "an HDF5 or MATLAB file, expected an npz file; save its arrays with np.savez"
    return None


def _read(file: BinaryIO, path: Path | str, wanted: Collection[str] | None, limit: int) -> dict[str, np.ndarray]:
    with zipfile.ZipFile(file) as archive:
        members = {info.filename.removesuffix(".npy"): info for info in archive.infolist()}
        chosen = {name: info for name, info in members.items() if wanted is None or name in wanted}
        headers = {name: _header(archive, info, name, path) for name, info in chosen.items()}
        total = sum(size for _, _, _, _, size in headers.values())
        if total > limit:
            raise TwofoldError(
                f"{path} holds {total / 2**30:.3g} GiB of arrays, more than {limit / 2**30:.3g}; check that it is the "
                "right file."
            )
        arrays: dict[str, np.ndarray] = {}
        for name, (kind, shape, fortran, begin, size) in headers.items():
            with archive.open(chosen[name]) as member:
                member.read(begin)
                content = bytearray(member.read(size))
                if len(content) != size or member.read(1):  # Reading to the end compares the checksum, too.
                    raise _Damaged
            arrays[name] = np.frombuffer(content, kind).reshape(shape, order="F" if fortran else "C")
        return arrays


def _header(
    archive: zipfile.ZipFile, info: zipfile.ZipInfo, name: str, path: Path | str
) -> tuple[np.dtype, tuple[int, ...], bool, int, int]:
    """Type, shape and order of a member, where its numbers begin, and how many bytes they take."""
    if info.flag_bits & _ENCRYPTED:
        raise TwofoldError(f"{path} is encrypted; unpack it and write it again with np.savez.")
    if info.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
        raise _Damaged
    with archive.open(info) as member:
        start = member.read(len(_MAGIC) + 2)
        if start[:-2] != _MAGIC or start[-2] not in (1, 2, 3):
            raise TwofoldError(f"{name} in {path} is no array; write it again with np.savez.")
        width = 2 if start[-2] == 1 else 4
        length = int.from_bytes(member.read(width), "little")
        text = member.read(length).decode("latin1") if length <= _MAX_HEADER else ""
    begin = len(start) + width + length
    kind = re.search(r"'descr':\s*(?:'([^']*)'|\[)", text)
    order = re.search(r"'fortran_order':\s*(True|False)", text)
    sizes = re.search(r"'shape':\s*\(([\d,L\s]*)\)", text)
    if kind is None or order is None or sizes is None:
        raise _Damaged
    if "O" in (kind[1] or ""):
        raise TwofoldError(f"{path} holds Python objects, expected plain arrays; make it again.")
    known = _KIND.fullmatch(kind[1] or "")
    if known is None:
        raise TwofoldError(f"{name} in {path} is neither numbers nor text; write it again as such.")
    shape = tuple(int(size) for size in re.findall(r"\d{1,19}", sizes[1]))
    item = int(known[2]) * (4 if known[1] == "U" else 1)
    count = 1
    for size in shape:
        count *= size
    # Arrays without elements may have endless axes, which are refused, too.
    if len(shape) > 32 or max(shape, default=0) > 2**31 or begin + count * item != info.file_size:
        raise _Damaged
    return np.dtype(kind[1]), shape, order[1] == "True", begin, count * item


def not_increasing(numbers: np.ndarray) -> list[int]:
    """Where numbers do not exceed the ones before them.

    >>> not_increasing(np.array([0.0, 0.1, 0.1, 0.2, 0.15]))
    [2, 4]
    """
    return (np.flatnonzero(np.diff(numbers.astype(np.float64)) <= 0) + 1).tolist()
