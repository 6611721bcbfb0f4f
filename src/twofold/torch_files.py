"""Tensors in files of `torch.save`, without running anything that is in them.

Such a file is a zip archive: a pickle that describes containers and tensors, and the bytes of each tensor beside it.
Only what is wanted is taken out.
"""

import math
import re
import struct
import zipfile
import zlib
from collections.abc import Collection
from pathlib import Path
from typing import Any

import numpy as np

from twofold.errors import TwofoldError
from twofold.inputs import opened
from twofold.pickles import CONTAINERS, MAX_BYTES, NUMPY, Persistent, Record, pickle_error, plain, record

_HARMLESS = re.compile(
    rf"torch\._utils\._rebuild_(tensor_v2|parameter)|torch\.\w+Storage|torch\.storage\.\w+|torch\.(Size|device)"
    rf"|{NUMPY}|{CONTAINERS}"
)
_TYPES = {
    "FloatStorage": "<f4", "DoubleStorage": "<f8", "HalfStorage": "<f2", "LongStorage": "<i8", "IntStorage": "<i4",
    "ShortStorage": "<i2", "CharStorage": "i1", "ByteStorage": "u1", "BoolStorage": "b1",
}  # fmt: skip
_WRONG = (zipfile.BadZipFile, zipfile.LargeZipFile, zlib.error, struct.error, NotImplementedError)


def read_torch(path: Path | str, what: str, wanted: Collection[str], limit: int = MAX_BYTES) -> dict[str, Any]:
    """Entries of a dictionary that `torch.save` wrote; tensors become arrays.

    Args:
        path: of the file.
        what: it is, for the sentences.
        wanted: keys of the entries; the others are not touched.
        limit: bytes of all tensors that are taken out together.

    Raises:
        TwofoldError: it is missing, damaged, of another kind, too large, or holds something else.
    """
    with opened(path, 2**40) as file:
        if file.read(2) != b"PK":
            raise TwofoldError(f"{path} is no file of torch.save (or of an old version), expected {what}.")
        file.seek(0)
        try:
            with zipfile.ZipFile(file) as archive:
                return _entries(archive, wanted, limit)
        except _WRONG as error:
            raise TwofoldError(f"{path} is damaged or cut short, expected {what}; get the file again.") from error
        except Exception as error:  # a damaged pickle may fail in any way
            raise pickle_error(error, path, what) from error


def _entries(archive: zipfile.ZipFile, wanted: Collection[str], limit: int) -> dict[str, Any]:
    members = {info.filename: info for info in archive.infolist()}
    pickles = [name for name in members if name.endswith("/data.pkl") or name == "data.pkl"]
    if len(pickles) != 1:
        raise ValueError("no tensors")
    if members[pickles[0]].file_size > limit:
        raise ValueError("it is too large")
    content = record(archive.read(pickles[0]), _HARMLESS)
    if not isinstance(content, dict):
        raise ValueError(f"expected a dictionary, it is a {type(content).__name__}")
    tensors = _Tensors(archive, members, pickles[0].removesuffix("data.pkl"), limit)
    return {key: plain(tensors.replaced(value)) for key, value in content.items() if key in wanted}


class _Tensors:
    """Arrays in place of the records of tensors, up to a limit of bytes."""

    def __init__(self, archive: zipfile.ZipFile, members: dict[str, zipfile.ZipInfo], root: str, limit: int) -> None:
        self._archive, self._members, self._root, self._left = archive, members, root, limit

    def replaced(self, value: Any, level: int = 0) -> Any:
        """The value with arrays in place of tensors."""
        if level > 20:
            raise ValueError("it is nested too deeply")
        if isinstance(value, dict):
            return {key: self.replaced(item, level + 1) for key, item in value.items()}
        if isinstance(value, list | tuple):
            return [self.replaced(item, level + 1) for item in value]
        if isinstance(value, Record) and value.claims().endswith("_rebuild_parameter"):
            return self.replaced(value.arguments[0], level + 1)
        if isinstance(value, Record) and value.claims().endswith("_rebuild_tensor_v2"):
            return self._tensor(*value.arguments[:4])
        return value

    def _tensor(self, storage: Any, offset: int, size: Any, stride: Any) -> np.ndarray:
        if not isinstance(storage, Persistent):
            raise ValueError("expected a tensor, its numbers are not there")
        _, kind, key, _, count = storage.arguments[0]
        code = _TYPES.get(kind.origin.rpartition(".")[2])
        if code is None:
            raise ValueError(f"expected numbers, it holds {kind.origin}")
        shape, steps = [int(n) for n in size], [int(n) for n in stride]
        whole = math.prod(shape)
        if min([offset, *shape, *steps], default=0) < 0 or len(shape) != len(steps) or len(shape) > 8:
            raise ValueError("expected a tensor, its shape is damaged")
        last = offset + sum((n - 1) * step for n, step in zip(shape, steps, strict=True))
        if whole and last >= count:
            raise ValueError("expected a tensor, it reaches beyond its numbers")
        item = np.dtype(code)
        self._left -= max(whole, count) * item.itemsize
        info = self._members[f"{self._root}data/{key}"]
        if self._left < 0 or info.file_size != count * item.itemsize:
            raise ValueError("it is too large or its tensors are damaged")
        flat = np.frombuffer(self._archive.read(info), item)
        if not whole:
            return np.zeros(shape, item)
        strides = [step * item.itemsize for step in steps]
        return np.lib.stride_tricks.as_strided(flat[offset:], shape, strides).copy()
