"""Pickles from outside, without running anything that is in them.

A pickle may run any code when it is opened the usual way. Here every object in one is only written down: what it claims
to be, with which arguments and which state. Arrays and plain containers are then taken out of these records.
"""

import io
import pickle
import pickletools
import re
from collections.abc import Collection, Iterator
from pathlib import Path
from typing import Any, cast

import numpy as np

from twofold.errors import TwofoldError
from twofold.inputs import read_bytes

MAX_OPCODES = 1_000_000
"""Of a pickle, unless a caller allows more; every opcode may make an object."""
MAX_BYTES = 2**30
"""Of a file with a pickle, unpacked."""
NUMPY = (
    r"numpy\.(_?core\.multiarray\.(_reconstruct|scalar)|_?core\.numeric\._frombuffer|ndarray|dtype)"
    r"|_codecs\.encode|copy_?reg\.(_reconstructor|__newobj__)"
)
"""What arrays and numbers are made with."""
CONTAINERS = (
    r"(__builtin__|builtins)\.(object|set|frozenset|dict|list|tuple|bytes|bytearray|slice)"
    r"|collections\.(OrderedDict|defaultdict)"
)
_PLAIN = re.compile(f"{NUMPY}|{CONTAINERS}")
_KINDS = {kind.code.encode("latin1"): kind for kind in pickletools.opcodes}
_COUNTED = {
    pickletools.TAKEN_FROM_ARGUMENT1: 1, pickletools.TAKEN_FROM_ARGUMENT4: 4, pickletools.TAKEN_FROM_ARGUMENT4U: 4,
    pickletools.TAKEN_FROM_ARGUMENT8U: 8,
}  # fmt: skip
"""Bytes that say how long an opcode's argument is."""
_MAX_ORIGINS, _MAX_LEVELS = 100, 40
"""Things that a pickle may name, and containers within each other."""


class ForbiddenError(Exception):
    """A pickle names something that files of its kind do not hold."""


class Record:
    """An object of a pickle, written down and never made.

    Attributes:
        arguments: it would have been made with.
        state: it would have been given.
        items: of dictionary-like and list-like objects.
    """

    origin = ""
    arguments: tuple[Any, ...]
    state: Any
    items: dict[Any, Any]

    def __new__(cls, *arguments: object) -> "Record":
        """An object of any class and any arguments."""
        record = super().__new__(cls)
        record.arguments = arguments
        record.state = {}
        record.items = {}
        return record

    def __init__(self, *arguments: object) -> None:
        """Nothing more than `__new__` has done."""

    def __setstate__(self, state: object) -> None:
        self.state = state

    def __setitem__(self, key: object, value: object) -> None:
        self.items[key] = value

    def append(self, value: object) -> None:
        """Notes an element under its place."""
        self.items[len(self.items)] = value

    def extend(self, values: Collection[object]) -> None:
        """Notes several."""
        for value in values:
            self.append(value)

    def claims(self) -> str:
        """The full name of the class or function that it says it came from."""
        maker = self.arguments[0] if self.origin.endswith("._reconstructor") and self.arguments else None
        return maker.origin if isinstance(maker, type) and issubclass(maker, Record) else self.origin


class Origins:
    """Classes of records for the things that pickles name.

    Args:
        harmless: full names that are recorded; anything else is a `ForbiddenError`.
    """

    def __init__(self, harmless: re.Pattern[str]) -> None:
        self._harmless = harmless
        self._known: dict[str, type[Record]] = {}

    def find(self, module_name: str, global_name: str) -> type[Record]:
        """The class of records for one thing; nothing is imported.

        Raises:
            ForbiddenError: files of this kind do not hold it.
            ValueError: too many things are named.
        """
        origin = f"{module_name}.{global_name}"
        if not self._harmless.fullmatch(origin):
            raise ForbiddenError(origin)
        if origin not in self._known:
            if len(self._known) == _MAX_ORIGINS:
                raise ValueError("it names too many things")
            self._known[origin] = type("_RecordOf", (Record,), {"origin": origin})
        return self._known[origin]


class _RecordingUnpickler(pickle.Unpickler):
    """Makes records instead of objects. It never imports a module and never calls what a pickle names."""

    def __init__(self, raw: bytes, harmless: re.Pattern[str]) -> None:
        """Text of Python 2 is read as latin-1, so that bytes in it stay what they are."""
        super().__init__(io.BytesIO(raw), encoding="latin1")
        self._origins = Origins(harmless)

    def find_class(self, module_name: str, global_name: str, /) -> type[Record]:
        """A class of records for the named thing, or `ForbiddenError`."""
        return self._origins.find(module_name, global_name)

    def persistent_load(self, pid: Any) -> Record:
        """What lies outside of the pickle, noted by its description."""
        return Persistent(pid)


class Persistent(Record):
    """Something that lies outside of the pickle; its description is the one argument."""

    origin = "persistent"


def record(raw: bytes, harmless: re.Pattern[str] = _PLAIN, max_opcodes: int = MAX_OPCODES) -> object:
    """What a pickle holds, with records in place of objects.

    Args:
        raw: the pickle.
        harmless: full names of things that are recorded.
        max_opcodes: a longer one is refused.

    Raises:
        ForbiddenError: it names something else.
        ValueError, EOFError, ...: it is damaged; anything may be raised then.
    """
    _require_modest(raw, max_opcodes)
    return _RecordingUnpickler(raw, harmless).load()


def _require_modest(raw: bytes, max_opcodes: int) -> None:
    """Refuses pickles that would take far more memory than they are large, as no file of numbers does.

    Every opcode may make an object, and one that stores in the memo makes the unpickler's table as long as its number.

    Raises:
        ValueError: there are too many opcodes, a number in the memo is skipped, or it is no pickle.
        EOFError: it ends early.
    """
    stored = 0
    for count, (name, argument) in enumerate(_opcodes(raw)):
        if count > max_opcodes:
            raise ValueError("it has too many parts")
        if name.endswith("PUT"):
            place = int(argument[:12]) if name == "PUT" else int.from_bytes(argument, "little")
            if not 0 <= place <= stored + 1:
                raise ValueError("its memo has holes")
            stored = max(stored, place + 1)


def _opcodes(raw: bytes) -> Iterator[tuple[str, bytes]]:
    """Name and argument of every opcode up to the first STOP.

    As pickletools has them, which itself stumbles over the bytes that Python 2 wrote into text.
    """
    place = 0
    while True:
        opcode = _KINDS.get(raw[place : place + 1])
        if opcode is None:
            raise EOFError if place >= len(raw) else ValueError("an unknown opcode")
        place += 1
        size = 0 if opcode.arg is None else opcode.arg.n
        if size == pickletools.UP_TO_NEWLINE:
            end = place
            for _ in range(2 if opcode.name in ("GLOBAL", "INST") else 1):
                end = raw.index(b"\n", end) + 1
        elif size >= 0:
            end = place + size
        else:
            width = _COUNTED[size]
            place += width
            end = place + int.from_bytes(raw[place - width : place], "little")
        if end > len(raw):
            raise EOFError
        yield opcode.name, raw[place:end]
        if opcode.name == "STOP":
            return
        place = end


def numpy_array(found: Record) -> np.ndarray:
    """The array of numbers that a record stands for.

    Raises:
        ValueError, ...: it stands for something else; records may claim anything.
    """
    claims = found.claims()
    if claims.endswith("._frombuffer"):
        raw, kind, shape, order = found.arguments
        fortran = order == "F"
    elif claims.endswith("._reconstruct"):
        _version, shape, kind, fortran, raw = found.state
    else:
        raise ValueError(f"expected an array, it is a {claims}")
    flat = np.frombuffer(_raw_bytes(raw), numpy_type(kind))
    return flat.reshape([int(n) for n in shape], order="F" if fortran else "C")


def numpy_type(found: Record) -> np.dtype:
    """The type of an array's elements: numbers only, no objects, no fields."""
    code = str(found.arguments[0])
    if not re.fullmatch(r"[fiu][1248]|b1|U\d{1,4}", code):
        raise ValueError(f"expected numbers, it holds the type {code}")
    order = found.state[1] if found.state else "="
    return np.dtype(code).newbyteorder(order)


def _raw_bytes(value: object) -> bytes:
    """Bytes as Python 2 wrote them (read as latin-1 text), as Python 3 writes them for it, or plain."""
    if isinstance(value, Record) and value.origin == "_codecs.encode" and value.arguments[1:] == ("latin1",):
        value = value.arguments[0]
    if isinstance(value, Record) and value.origin.endswith(".bytes") and not value.arguments:
        return b""  # as protocol 2 has it
    if isinstance(value, str):
        return value.encode("latin1")
    if isinstance(value, bytes | bytearray):
        return bytes(value)
    raise ValueError("its bytes are stored in an unknown way")


def plain(value: object, level: int = 0, made: dict[int, Any] | None = None) -> Any:
    """Containers, numbers, texts and arrays out of what `record` gave.

    Raises:
        ValueError, ...: something else is in it, or it is nested too deeply.
    """
    if level > _MAX_LEVELS:
        raise ValueError("it is nested too deeply")
    made = {} if made is None else made
    if id(value) in made:
        return made[id(value)]
    below = level + 1
    if isinstance(value, Record):
        out = _plain_record(value, below, made)
    elif isinstance(value, dict):
        out = {key: plain(item, below, made) for key, item in value.items() if not isinstance(key, Record)}
    elif isinstance(value, list | tuple | set | frozenset):
        out = [plain(item, below, made) for item in value]
    elif value is None or isinstance(value, bool | int | float | str | bytes | bytearray | np.ndarray):
        return value
    else:
        raise ValueError(f"expected numbers and containers, it holds a {type(value).__name__}")
    made[id(value)] = out  # Shared parts stay shared, so that they cost no memory.
    return out


def _plain_record(value: Record, level: int, made: dict[int, Any]) -> Any:
    claims = value.claims()
    if claims.endswith(("Dict", "defaultdict", ".dict")):
        return {key: plain(item, level, made) for key, item in value.items.items() if not isinstance(key, Record)}
    if claims.endswith((".list", ".tuple", ".set", ".frozenset")):
        given = [item for argument in value.arguments[:1] for item in argument]
        return [plain(item, level, made) for item in [*given, *value.items.values()]]
    if claims.endswith(".scalar"):
        kind, raw = value.arguments
        return np.frombuffer(_raw_bytes(raw), numpy_type(kind)).item()
    if claims.endswith("._reconstruct") and len(value.state) == 5 and isinstance(value.state[4], list):
        items = [plain(item, level, made) for item in value.state[4]]  # an array of Python objects
        return items[0] if value.state[1] == () and len(items) == 1 else items
    return numpy_array(value)


def read_pickle(path: Path | str, what: str, limit: int = MAX_BYTES, max_opcodes: int = MAX_OPCODES) -> Any:
    """The containers, numbers and arrays of a pickle file; nothing in it is run.

    Args:
        path: of the file.
        what: it is, for the sentences: "cameras of HumanNeRF".
        limit: of its size in bytes.
        max_opcodes: see `record`.

    Raises:
        TwofoldError: it is missing, damaged, no pickle, too large, or holds something else.
    """
    return unpickled(read_bytes(path, limit), path, what, max_opcodes)


def unpickled(raw: bytes, path: Path | str, what: str, max_opcodes: int = MAX_OPCODES) -> Any:
    """The containers, numbers and arrays of a pickle; see `read_pickle`."""
    try:
        return plain(record(raw, max_opcodes=max_opcodes))
    except Exception as error:  # a damaged pickle may fail in any way
        raise pickle_error(error, path, what) from error


def pickle_error(error: Exception, path: Path | str, what: str) -> TwofoldError:
    """The sentence about a pickle that could not be read."""
    if isinstance(error, TwofoldError):
        return error
    if isinstance(error, ForbiddenError):
        return TwofoldError(
            f"{path} would run {error} when opened as usual, which {what} never do; nothing was run, do not trust it."
        )
    if isinstance(error, EOFError) or "truncated" in str(error):
        return TwofoldError(f"{path} is cut short, expected {what}; get the file again.")
    reason = str(error) if isinstance(error, ValueError) and str(error).startswith(("expected", "it ")) else ""
    return TwofoldError(f"{path} is damaged or not {what}{f' ({reason})' if reason else ''}; get the file again.")


def as_dict(value: Any, path: Path | str, what: str) -> dict[Any, Any]:
    """`value` as a dictionary; an array of one object is that object.

    Raises:
        TwofoldError: it is none.
    """
    if isinstance(value, list) and len(value) == 1:
        value = value[0]
    if not isinstance(value, dict):
        raise TwofoldError(f"{path} holds a {type(value).__name__}, expected {what}; get the file again.")
    return cast("dict[Any, Any]", value)
