"""Files of joblib, without running anything that is in them.

joblib writes a pickle in which the bytes of each array follow its description, and may pack the whole by zlib. joblib's
own reader unpickles plainly.
"""

import io
import math
import pickle
import re
import zlib
from pathlib import Path
from typing import Any, cast, final

import numpy as np

from twofold.errors import TwofoldError
from twofold.inputs import read_bytes
from twofold.pickles import CONTAINERS, MAX_BYTES, NUMPY, Origins, Record, numpy_type, pickle_error, plain

_WRAPPER = "joblib.numpy_pickle.NumpyArrayWrapper"
_HARMLESS = re.compile(f"{NUMPY}|{CONTAINERS}|{re.escape(_WRAPPER)}")

_BUILD = pickle.BUILD[0]
_Slow: Any = getattr(pickle, "_Unpickler")  # noqa: B009 - the form in Python, which has no public name


@final
class _JoblibUnpickler(_Slow):
    """Makes records instead of objects, and takes arrays out of the stream. Never imports, never calls."""

    dispatch: dict[int, Any] = dict(_Slow.dispatch)  # noqa: RUF012 - as its base has it

    def __init__(self, stream: io.BytesIO) -> None:
        super().__init__(stream, encoding="latin1")
        self._stream = stream
        self._origins = Origins(_HARMLESS)

    def find_class(self, module: str, name: str) -> type[Record]:
        """A class of records for the named thing, or `ForbiddenError`."""
        return self._origins.find(module, name)

    def load_build(self) -> None:
        """Sets the state of a record; an array's bytes follow."""
        _Slow.load_build(self)
        stack = cast("list[Any]", self.stack)
        found = stack[-1]
        if isinstance(found, Record) and found.claims() == _WRAPPER:
            stack[-1] = self._array(found.state)

    dispatch[_BUILD] = load_build

    def _array(self, state: dict[str, Any]) -> np.ndarray:
        kind = numpy_type(state["dtype"])
        shape = [int(n) for n in state["shape"]]
        if min(shape, default=0) < 0:
            raise ValueError("expected an array, it has a negative size")
        if state.get("numpy_array_alignment_bytes") is not None:
            self._stream.read(self._stream.read(1)[0])
        size = math.prod(shape) * kind.itemsize
        if size > MAX_BYTES:
            raise ValueError("it holds an array that is too large")
        raw = self._stream.read(size)
        if len(raw) != size:
            raise EOFError
        flat = np.frombuffer(raw, kind)
        return flat.reshape(shape, order="F" if state.get("order") == "F" else "C")


def read_joblib(path: Path | str, what: str, limit: int = MAX_BYTES) -> Any:
    """The containers, numbers and arrays of a file that joblib (or pickle) wrote; nothing in it is run.

    Args:
        path: of the file.
        what: it is, for the sentences.
        limit: bytes of the file, and of what it unpacks to.

    Raises:
        TwofoldError: it is missing, damaged, too large, packed in another way, or holds something else.
    """
    raw = read_bytes(path, limit)
    try:
        return plain(_JoblibUnpickler(io.BytesIO(_unpacked(raw, path, what, limit))).load())
    except Exception as error:  # a damaged pickle may fail in any way
        raise pickle_error(error, path, what) from error


def _unpacked(raw: bytes, path: Path | str, what: str, limit: int) -> bytes:
    if raw[:1] == b"\x80":
        return raw
    if raw[:2] in (b"\x78\x01", b"\x78\x5e", b"\x78\x9c", b"\x78\xda"):
        unpacker = zlib.decompressobj()
        content = unpacker.decompress(raw, limit)
        if unpacker.unconsumed_tail:
            raise TwofoldError(f"{path} unpacks to more than {limit >> 20} MiB, too much for {what}.")
        if not unpacker.eof:
            raise EOFError
        return content
    if raw[:2] in (b"\x1f\x8b", b"BZ") or raw[:6] == b"\xfd7zXZ\0" or raw[:4] == b"\x04\x22\x4d\x18":
        raise TwofoldError(f"{path} is packed in a way that is not read; write {what} by joblib.dump without compress.")
    raise ValueError("no pickle")
